# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The coupled equations solved matrix-free, by preconditioned Krylov iterations and refinement.

Every cycle starts from the residual of the equations as given, in double precision: so neither the Krylov recurrences
nor the eigenvectors limit the accuracy. A solution is accepted when the correction by one more preconditioned step is
small in every graph: unlike the residual, this is not hidden by the rounding of large rates. See docs/accuracy.md.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.theory.solvers.averaged_equations import AveragedEquations, suitable
from msg_analysis.theory.solvers.coupled_equations import CoupledEquations
from msg_analysis.theory.solvers.krylov import (
    Equations,
    conjugate_gradients,
    gmres,
    norms,
    plain_conjugate_gradients,
    weighted_norm,
)
from msg_analysis.theory.solvers.solver_report import (
    MAX_RELATIVE_ERROR,
    Method,
    Preconditioner,
    SolverReport,
    singular_message,
)
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.types import FloatArray

TOLERANCE = 1e-12  # estimated relative error at which a solve stops
MAX_ITERATIONS = 600
MAX_CHEAP = 30  # most iterations of one cycle with the averaged preconditioner
FINEST = 5e-7  # least relative residual asked of such a cycle, in single precision: two cycles suffice
MAX_AMPLIFICATION = 1e14  # largest ratio of (averaged decay * solution) to right-hand side: a condition number
CHUNK = 1_000_000  # numbers in a stack of right-hand sides that are solved together: small enough for the caches


class IterativeSolver:
    """Steady moments and duals of one system; starts from ``guess`` (n, d, d), steady moments of a similar one."""

    def __init__(self, system: JumpSystem, guess: FloatArray | None = None) -> None:
        self._equations = CoupledEquations(system)
        self._averaged = _averaged(self._equations)
        self._adjoint: CoupledEquations | None = None
        self._averaged_adjoint: AveragedEquations | None = None
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
        x, self.report = _solve(self._equations, self._averaged, right, guess)
        return np.asarray(np.multiply(weights, x[0], out=x[0]))

    def dual(self, forms: FloatArray) -> FloatArray:
        """See ``MomentSolver.dual``."""
        system = self._equations.system
        if self._adjoint is None:
            self._adjoint = self._equations.adjoint()
            self._averaged_adjoint = _averaged(self._adjoint)
        result = np.empty((len(forms), *system.matrices.shape))
        together = max(1, CHUNK // system.matrices.size)
        for first in range(0, len(forms), together):
            chunk = forms[first : first + together, None]
            right = np.broadcast_to(chunk, (len(chunk), *system.matrices.shape)).copy()
            y, _ = _solve(self._adjoint, self._averaged_adjoint, right, None)
            if system.time == "discrete":
                y = right + self._adjoint.moved(y)
            result[first : first + together] = y
        return result


def _averaged(equations: CoupledEquations) -> AveragedEquations | None:
    """The cheaper preconditioner, where it promises to be better."""
    if not (equations.one_level and equations.large) or equations.system.lossy:
        return None
    return AveragedEquations(equations) if suitable(equations) else None


def _solve(
    equations: CoupledEquations, averaged: AveragedEquations | None, right: FloatArray, guess: FloatArray | None
) -> tuple[FloatArray, SolverReport]:
    """Solve A X = B for (q, n, d, d) right-hand sides."""
    x = None if guess is None or not guess.any() else 0.5 * (guess + guess.swapaxes(-1, -2))
    if averaged is not None:
        x, report = _by_average(equations, averaged, right, x)
        if not report.error <= TOLERANCE:
            x, report = _by_graphs(equations, right, x if np.isfinite(x).all() else None, report.iterations)
    else:
        x, report = _by_graphs(equations, right, x, 0)
    # Not ">": NaN must be refused, too.
    if not report.error <= MAX_RELATIVE_ERROR:
        raise InputError(singular_message(f", or too ill-conditioned ({report.iterations} iterations do not converge)"))
    size = (equations.decay * np.abs(np.diagonal(x, axis1=2, axis2=3))).max(initial=0.0)
    if not size <= MAX_AMPLIFICATION * np.abs(right).max(initial=0.0):
        raise InputError(singular_message(f" (amplification {size / np.abs(right).max():.1e})"))
    for place in np.ndindex(x.shape[:2]):
        x[place] = 0.5 * (x[place] + x[place].T)
    return x, report


def _by_average(
    equations: CoupledEquations, averaged: AveragedEquations, right: FloatArray, guess: FloatArray | None
) -> tuple[FloatArray, SolverReport]:
    """With the averaged preconditioner, until the error is small or a cycle gains less than three digits."""
    method, iterations, before = _method(definite=averaged.definite), 0, np.inf
    x, known = np.zeros_like(right) if guess is None else guess, guess is not None
    while True:
        residual, left, backward = _residual(equations, right, x) if known else (right, 1.0, 1.0)
        scale = _scale(residual)
        inside, error = averaged.enter(residual, scale), np.ones(len(x))
        del residual  # its memory is used again, and fresh memory would have to be cleared
        if known:
            error = _error(averaged.solution(inside), x, scale)
            iterations += 1
        worst = float(error.max(initial=0.0))
        if worst <= TOLERANCE or not worst <= 1e-3 * before:
            return x, SolverReport(method, "averaged", iterations, left, backward, worst)
        enough = np.clip(0.5 * TOLERANCE / np.maximum(error, TOLERANCE), FINEST, 0.1)
        if averaged.definite:
            change, used = plain_conjugate_gradients(averaged.apply, inside, enough, MAX_CHEAP)
        else:
            change, used = gmres(averaged, inside, enough, MAX_CHEAP)
        averaged.leave(change, scale, x)
        iterations, before, known = iterations + used, worst, True


def _by_graphs(
    equations: CoupledEquations, right: FloatArray, x: FloatArray | None, iterations: int
) -> tuple[FloatArray, SolverReport]:
    """With the two-level preconditioner, until the error is small, a cycle hardly reduces it, or iterations run out."""
    inner = equations.inner
    method: Method = "direct" if equations.direct else _method(definite=inner.definite)
    preconditioner: Preconditioner = "none" if equations.direct else "two-level"
    known = x is not None
    x = np.zeros_like(right) if x is None else x
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
            if worst <= TOLERANCE or iterations >= MAX_ITERATIONS or not worst <= 0.7 * before:
                return x, SolverReport(method, preconditioner, iterations, left, backward, worst)
            before = worst
        known = True
        scaled, scale = _scaled(residual)
        scaled = scaled.astype(inner.drift.dtype)
        if equations.direct:
            change, used = inner.precondition(scaled)[0], 1
        else:
            size = weighted_norm(x, equations.weights) / scale[:, 0, 0, 0]
            change, used = _improved(inner, scaled, size, error, MAX_ITERATIONS)
        x, iterations = x + change * scale, iterations + used


def _improved(
    equations: Equations, right: FloatArray, size: FloatArray, error: FloatArray, most: int
) -> tuple[FloatArray, int]:
    """(X, iterations) for A X = B, as accurate as the precision allows and the error requires."""
    finest = 1e-6 if right.dtype == np.float32 else 1e-14
    if equations.definite:
        small = 0.3 * TOLERANCE
        return conjugate_gradients(equations, right, small * size, max(small, finest), most)
    return gmres(equations, right, np.clip(0.1 * TOLERANCE / np.maximum(error, TOLERANCE), finest, 0.1), most)


def _residual(equations: CoupledEquations, right: FloatArray, x: FloatArray) -> tuple[FloatArray, float, float]:
    """B - A X, in double precision; its norm relative to B, and to the sum of the norms of all terms."""
    residual, terms = equations.apply(x)
    np.subtract(right, residual, out=residual)
    given, left = norms(right), norms(residual)
    return residual, float(_ratio(left, given).max(initial=0.0)), float(_ratio(left, terms + given).max(initial=0.0))


def _error(step: FloatArray, x: FloatArray, scale: FloatArray | float = 1.0) -> FloatArray:
    """(q,): norm of the step (times the scale) relative to X, in the graph where it is largest."""
    size = norms(x)
    size = np.maximum(size, 1e-6 * size.max(axis=1, keepdims=True))
    return np.asarray(_ratio(norms(step), size).max(axis=1) * scale)


def _method(*, definite: bool) -> Method:
    return "cg" if definite else "gmres"


def _scale(residual: FloatArray) -> FloatArray:
    """(q,): largest absolute entries; 1 where all are 0."""
    axes = (1, 2, 3)
    scale = np.maximum(residual.max(axis=axes, initial=0.0), -residual.min(axis=axes, initial=0.0))
    scale[scale == 0.0] = 1.0
    return np.asarray(scale)


def _scaled(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right-hand sides with largest entry 1, and their (q, 1, 1, 1) scales."""
    scale = _scale(residual)[:, None, None, None]
    return residual / scale, scale


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    """Part / whole, where 0 / 0 is 0."""
    return np.divide(part, whole, out=np.where(part > 0.0, np.inf, 0.0), where=whole > 0.0)
