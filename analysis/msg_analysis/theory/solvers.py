# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Solvers of the moment equations (Propositions 2 and 3 of the paper, 7 and 8 in discrete time).

Small systems: one dense LU factorisation on the p = d (d + 1) / 2 free entries of every moment (``packed_symmetric``)
serves the steady moments and every dual; the cost grows as (n p)^3. The same matrices, the paper's M and N (in discrete
time A and H), propagate transients. Large systems: preconditioned Krylov iterations without the matrix, and refinement.

Every cycle of refinement starts from the residual of the equations as given, in double precision, so neither the Krylov
recurrences nor the eigenvectors limit the accuracy. A solution is accepted when the correction by one more
preconditioned step is small in every graph: unlike the residual, this is not hidden by the rounding of large rates. See
docs/accuracy.md.
"""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.coupled_equations import (
    MAX_RELATIVE_ERROR,
    SINGLE_FROM,
    CoupledEquations,
    Method,
    Preconditioner,
    SolverReport,
    singular_message,
)
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.krylov import gmres, norms
from msg_analysis.theory.propagator import Propagator


def mode_operators(system: JumpSystem) -> FloatArray:
    """(n, p, p) matrices of C -> Z_i C + C Z_i^T (continuous time) or of C -> C - K_i[C] (discrete time)."""
    if system.time == "continuous":
        return np.stack([packed_symmetric.lyapunov(z) for z in system.matrices])
    p = packed_symmetric.size(system.dimension)
    operators = np.zeros((system.modes, p, p))
    for k, entry in enumerate(np.eye(p)):
        basis = np.broadcast_to(packed_symmetric.unpack(entry, system.dimension), system.matrices.shape)
        operators[:, :, k] = entry - packed_symmetric.pack(system.propagate(basis))
    return operators


def second_moment_propagator(system: JumpSystem) -> Propagator:
    """Of the stack (n, p + 1) of packed C_i beside pi_i: the equations for c(t) and pi(t) in one, noise included."""
    n, p = system.modes, packed_symmetric.size(system.dimension)
    local = np.zeros((n, p + 1, p + 1))
    local[:, :p, :p] = -mode_operators(system)
    local[:, :p, p] = packed_symmetric.pack(system.noise)
    return Propagator(system.time, system.chain, system.stationary, local)


def homogeneous_propagator(system: JumpSystem) -> Propagator:
    """Of the stack (n, p) of packed C_i without noise: exp(-M t), or A^k."""
    return Propagator(system.time, system.chain, system.stationary, -mode_operators(system))


def mean_propagator(system: JumpSystem) -> Propagator:
    """Of the stack nu (n, d) of means: exp(-N t), or H^k."""
    discrete = system.time == "discrete"
    local = system.matrices - np.eye(system.dimension) if discrete else -system.matrices
    return Propagator(system.time, system.chain, system.stationary, local)


class DenseSolver:
    """The coupled equations of ``MomentSolver``, factorised. InputError: singular or too ill-conditioned."""

    # The last block row is replaced by the sum of all of them, in which the chain cancels exactly, and rows are scaled
    # to largest entry 1: so the equations stay well conditioned however fast the graphs switch.

    def __init__(self, system: JumpSystem) -> None:
        self._system = system
        n, p = system.modes, packed_symmetric.size(system.dimension)
        local, flow = mode_operators(system), system.chain.T
        matrix = np.zeros((n, p, n, p))
        for j in range(n):
            if system.time == "continuous":
                matrix[:, range(p), j, range(p)] = -flow[:, j, None]
                matrix[j, :, j, :] += local[j]
            else:
                matrix[:, :, j, :] = flow[:, j, None, None] * (local[j] - np.eye(p))
                matrix[j, range(p), j, range(p)] += 1.0
            matrix[-1, :, j, :] = local[j]
        self._matrix = matrix.reshape(n * p, n * p)
        scale = np.maximum(self._matrix.max(axis=1, initial=0.0), -self._matrix.min(axis=1, initial=0.0))
        self._scale = 1.0 / np.where(scale > 0.0, scale, 1.0)
        self._matrix *= self._scale[:, None]
        self._factors, self._norm, self._condition = (self._matrix, np.empty(0, np.int32)), 0.0, 1.0
        if self._matrix.size:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # the condition is judged below
                self._factors = scipy.linalg.lu_factor(self._matrix)
            self._norm = float(np.linalg.norm(self._matrix, 1))
            self._condition = float(scipy.linalg.lapack.dgecon(self._factors[0], self._norm)[0])
        self._shape = (n, p)
        self.report: SolverReport | None = None
        self._check(float(np.finfo(float).eps))

    def steady(self, noise: FloatArray | None = None) -> FloatArray:
        """See ``IterativeSolver.steady``."""
        system = self._system
        noise = system.noise if noise is None else noise
        weighted = packed_symmetric.pack(system.stationary[:, None, None] * noise)
        right = weighted.copy() if system.time == "continuous" else system.chain.T @ weighted
        right[-1] = weighted.sum(axis=0)
        solution, self.report = self._solve(right.reshape(-1, 1) * self._scale[:, None], trans=0)
        return packed_symmetric.unpack(solution.reshape(self._shape), system.dimension)

    def dual(self, forms: FloatArray) -> FloatArray:
        """See ``MomentSolver.dual``."""
        n, p = self._shape
        right = np.tile(packed_symmetric.pack(forms), (1, n)).T
        solution, _ = self._solve(right, trans=1)
        blocks = (solution * self._scale[:, None]).reshape(n, p, -1)
        blocks[:-1] += blocks[-1]  # transpose of "replace the last row by the sum"
        return packed_symmetric.unpack(np.moveaxis(blocks, 2, 0), self._system.dimension)

    def _solve(self, right: FloatArray, *, trans: Literal[0, 1]) -> tuple[FloatArray, SolverReport]:
        matrix = self._matrix.T if trans else self._matrix
        solution = right
        if right.size:
            solution = scipy.linalg.lu_solve(self._factors, right, trans=trans)
            solution += scipy.linalg.lu_solve(self._factors, right - matrix @ solution, trans=trans)
        residual = np.abs(right - matrix @ solution).max(initial=0.0)
        given = np.abs(right).max(initial=0.0)
        size = self._norm * np.abs(solution).max(initial=0.0) + given
        backward = float(residual / size) if size > 0.0 else 0.0
        self._check(backward)
        relative = float(residual / given) if given > 0.0 else 0.0
        return np.asarray(solution), SolverReport("dense", "none", 1, relative, backward, backward / self._condition)

    def _check(self, backward: float) -> None:
        """Refuse equations that are too ill-conditioned for this backward error."""
        # Not ">": NaN must be refused, too.
        if self._matrix.size and not backward <= MAX_RELATIVE_ERROR * self._condition:
            raise InputError(singular_message(f" (reciprocal condition {self._condition:.1e})"))


TOLERANCE = 1e-12  # estimated relative error at which a solve stops
MAX_ITERATIONS = 600
MAX_AMPLIFICATION = 1e14  # largest ratio of (averaged decay * solution) to right-hand side: a condition number
CHUNK = 1_000_000  # numbers in a stack of right-hand sides that are solved together: small enough for the caches


class IterativeSolver:
    """Steady moments and duals of one system; starts from ``guess`` (n, d, d), steady moments of a similar one."""

    def __init__(
        self,
        system: JumpSystem,
        guess: FloatArray | None = None,
        *,
        chunk: int = CHUNK,
        single_from: int = SINGLE_FROM,
        most_iterations: int = MAX_ITERATIONS,
    ) -> None:
        self._chunk, self._equations = chunk, CoupledEquations(system, single_from=single_from)
        self._most_iterations = most_iterations
        self._adjoint: CoupledEquations | None = None
        self._guess = guess
        self.report: SolverReport | None = None

    def steady(self, noise: FloatArray | None = None) -> FloatArray:
        """See ``MomentSolver.steady``; ``noise``: (n, d, d), another one than that of the system."""
        system = self._equations.system
        right = (system.noise if noise is None else noise)[None]
        if system.time == "discrete":
            right = self._equations.after_jump(right)
        weights = system.stationary[:, None, None]
        guess = None if self._guess is None else self._guess[None] / weights
        x, self.report = _solve(self._equations, right, guess, self._most_iterations)
        return np.asarray(np.multiply(weights, x[0], out=x[0]))

    def dual(self, forms: FloatArray) -> FloatArray:
        """See ``MomentSolver.dual``."""
        system = self._equations.system
        if self._adjoint is None:
            self._adjoint = CoupledEquations(system, self._equations)
        result = np.empty((len(forms), *system.matrices.shape))
        together = max(1, self._chunk // system.matrices.size)
        for first in range(0, len(forms), together):
            chunk = forms[first : first + together, None]
            right = np.broadcast_to(chunk, (len(chunk), *system.matrices.shape)).copy()
            y, _ = _solve(self._adjoint, right, None, self._most_iterations)
            if system.time == "discrete":
                y = right + self._adjoint.moved(y)
            result[first : first + together] = y
        return result


def _solve(
    equations: CoupledEquations, right: FloatArray, guess: FloatArray | None, most: int
) -> tuple[FloatArray, SolverReport]:
    """Solve A X = B for (q, n, d, d) right-hand sides, in about so many iterations at most."""
    x, report = _refined(equations, right, guess, most)
    # Not ">": NaN must be refused, too.
    if not report.error <= MAX_RELATIVE_ERROR:
        raise InputError(singular_message(f", or too ill-conditioned ({report.iterations} iterations do not converge)"))
    size = (equations.decay * np.abs(np.diagonal(x, axis1=2, axis2=3))).max(initial=0.0)
    if not size <= MAX_AMPLIFICATION * np.abs(right).max(initial=0.0):
        raise InputError(singular_message(f" (amplification {size / np.abs(right).max():.1e})"))
    for place in np.ndindex(x.shape[:2]):
        x[place] = 0.5 * (x[place] + x[place].T)
    return x, report


def _refined(
    equations: CoupledEquations, right: FloatArray, guess: FloatArray | None, most: int
) -> tuple[FloatArray, SolverReport]:
    """Refine until the error is small, a cycle hardly reduces it, or iterations run out."""
    inner, iterations = equations.inner, 0
    how: tuple[Method, Preconditioner] = ("direct", "none") if equations.direct else ("gmres", "two-level")
    known = guess is not None and bool(guess.any())
    x = np.zeros_like(right) if guess is None else 0.5 * (guess + guess.swapaxes(-1, -2))
    residual, error, before = right, np.ones(len(right)), np.inf
    while True:
        if known:
            residual, left, backward = _residual(equations, right, x)
            scaled, scale = _scaled(residual)
            step, moved = (part * scale for part in inner.precondition(scaled.astype(inner.drift.dtype)))
            x, residual = x + step, residual - moved
            error = _error(step, x)
            worst = float(error.max(initial=0.0))
            iterations += 1
            if worst <= TOLERANCE or iterations >= most or not worst <= 0.7 * before:
                return x, SolverReport(*how, iterations, left, backward, worst)
            before = worst
        known = True
        scaled, scale = _scaled(residual)
        scaled = scaled.astype(inner.drift.dtype)
        if equations.direct:
            change, used = inner.precondition(scaled)[0], 1
        else:
            finest = 1e-6 if scaled.dtype == np.float32 else 1e-14
            enough = np.clip(0.1 * TOLERANCE / np.maximum(error, TOLERANCE), finest, 0.1)
            change, used = gmres(inner, scaled, enough, most)
        x, iterations = x + 0.5 * scale * (change + change.swapaxes(-1, -2)), iterations + used


def _residual(equations: CoupledEquations, right: FloatArray, x: FloatArray) -> tuple[FloatArray, float, float]:
    """B - A X, in double precision; its norm relative to B, and to the sum of the norms of all terms."""
    residual, terms = equations.apply(x)
    np.subtract(right, residual, out=residual)
    given, left = norms(right), norms(residual)
    return residual, float(_ratio(left, given).max(initial=0.0)), float(_ratio(left, terms + given).max(initial=0.0))


def _error(step: FloatArray, x: FloatArray) -> FloatArray:
    """(q,): norm of the step relative to X, in the graph where it is largest."""
    size = norms(x)
    size = np.maximum(size, 1e-6 * size.max(axis=1, keepdims=True))
    return np.asarray(_ratio(norms(step), size).max(axis=1))


def _scaled(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right-hand sides with largest entry 1, and their (q, 1, 1, 1) scales."""
    axes = (1, 2, 3)
    scale = np.maximum(residual.max(axis=axes, initial=0.0), -residual.min(axis=axes, initial=0.0))
    scale[scale == 0.0] = 1.0
    return residual / scale[:, None, None, None], scale[:, None, None, None]


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    """Part / whole, where 0 / 0 is 0."""
    return np.divide(part, whole, out=np.where(part > 0.0, np.inf, 0.0), where=whole > 0.0)
