"""Second moments of jump linear systems: steady, dual (adjoint) and transient.

Dense solver on the half-vectorised coupled Lyapunov (continuous) or Stein (discrete) equations: one LU
factorisation serves the steady moments and every dual. ``MomentSolver`` is all that other modules see of it.
"""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
import scipy.linalg

from msg_analysis.errors import InputError
from msg_analysis.theory import symmetric
from msg_analysis.theory.system import JumpSystem
from msg_analysis.types import FloatArray

MAX_UNKNOWNS = 10_000
"""Largest dense system that is tried: 2.4 GB and about a minute."""

MAX_RELATIVE_ERROR = 1e-6
"""Largest estimated relative error that is let through; usual is 1e-12."""


class MomentSolver:
    """The coupled equations of one system, factorised.

        continuous: Z_i C_i + C_i Z_i^T - sum_j Gamma_ji C_j = pi_i Q_i
        discrete:   C_i - sum_j P_ji K_j[C_j] = sum_j P_ji pi_j N_j

    The last block row is replaced by the sum of all of them, in which the chain cancels exactly, and rows are
    scaled to largest entry 1: so the equations stay well conditioned however fast the graphs switch.

    Parameters
    ----------
    system : what to solve for

    Raises
    ------
    InputError : too large for a dense solve, no steady second moments, or too ill-conditioned to be trusted
    """

    def __init__(self, system: JumpSystem) -> None:
        self._system = system
        n, p = system.modes, symmetric.size(system.dimension)
        if n * p > MAX_UNKNOWNS:
            raise InputError(
                f"second moments: {n} graphs of {len(system.lift)} agents give {n * p} coupled unknowns, for "
                f"which a dense solve needs about {24e-9 * (n * p) ** 2:.1f} GB; at most {MAX_UNKNOWNS} are "
                "solved: use fewer agents or graphs"
            )
        local, flow = _local_operators(system), system.chain.T
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
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # the condition is judged below
            self._factors = scipy.linalg.lu_factor(self._matrix)
        self._norm = float(np.linalg.norm(self._matrix, 1)) if self._matrix.size else 0.0
        self._condition = _reciprocal_condition(self._factors[0], self._norm)
        self._shape = (n, p)
        self._check(float(np.finfo(float).eps))

    @property
    def system(self) -> JumpSystem:
        """The system whose equations these are."""
        return self._system

    def steady(self) -> FloatArray:
        """(n, d, d): C_i = E[y y^T; mode i] in the steady state (the paper's second-moment propositions)."""
        system = self._system
        weighted = symmetric.pack(system.stationary[:, None, None] * system.noise)
        right = weighted.copy() if system.time == "continuous" else system.chain.T @ weighted
        right[-1] = weighted.sum(axis=0)
        solution = self._solve(right.reshape(-1, 1) * self._scale[:, None], trans=0)
        moments = symmetric.unpack(solution.reshape(self._shape), system.dimension)
        least = np.linalg.eigvalsh(moments).min(initial=0.0) if system.dimension else 0.0
        if least < -MAX_RELATIVE_ERROR * np.abs(moments).max(initial=0.0):
            raise InputError(
                "second moments: the equations have no positive solution, so the errors grow without bound: "
                "lower run.dt, or add edges until the union of the graphs connects everybody"
            )
        return moments

    def dual(self, forms: FloatArray) -> FloatArray:
        """Adjoint solutions for many quadratic forms at once.

        E[y^T H y] = sum_i pi_i tr(Y_i Q) in continuous time, sum_ij pi_i P_ij tr(Y_j N_i) in discrete time.

            continuous: Z_i^T Y_i + Y_i Z_i - sum_j Gamma_ij Y_j = H
            discrete:   Y_i = H + K_i^*[sum_j P_ij Y_j]

        Parameters
        ----------
        forms : (q, d, d) symmetric H

        Returns
        -------
        (q, n, d, d)
        """
        n, p = self._shape
        right = np.tile(symmetric.pack(forms), (1, n)).T
        solution = self._solve(right, trans=1) * self._scale[:, None]
        blocks = solution.reshape(n, p, -1)
        blocks[:-1] += blocks[-1]  # transpose of "replace the last row by the sum"
        return symmetric.unpack(np.moveaxis(blocks, 2, 0), self._system.dimension)

    def _solve(self, right: FloatArray, *, trans: Literal[0, 1]) -> FloatArray:
        matrix = self._matrix.T if trans else self._matrix
        solution = scipy.linalg.lu_solve(self._factors, right, trans=trans)
        residual = right - matrix @ solution
        solution += scipy.linalg.lu_solve(self._factors, residual, trans=trans)
        residual = np.abs(right - matrix @ solution).max(initial=0.0)
        size = self._norm * np.abs(solution).max(initial=0.0) + np.abs(right).max(initial=0.0)
        self._check(float(residual / size) if size > 0.0 else 0.0)
        return np.asarray(solution)

    def _check(self, backward: float) -> None:
        """Refuse what is too ill-conditioned for a backward error."""
        # Not ">": a number that is not finite must not pass.
        if self._matrix.size and not backward <= MAX_RELATIVE_ERROR * self._condition:
            raise InputError(
                "second moments: the equations are (nearly) singular (reciprocal condition "
                f"{self._condition:.1e}), so the errors grow without bound or cannot be computed: check "
                "that the union of the graphs connects everybody and that the rates do not differ by many "
                "orders of magnitude"
            )


def _local_operators(system: JumpSystem) -> FloatArray:
    """(n, p, p) matrices of C -> Z C + C Z^T, or of C -> C - K[C]."""
    if system.time == "continuous":
        return np.stack([symmetric.lyapunov(z) for z in system.matrices])
    return np.eye(symmetric.size(system.dimension)) - step_operators(system)


def step_operators(system: JumpSystem) -> FloatArray:
    """(n, p, p) matrices of C -> K_j[C] = E[W C W^T | mode j] on packed C. Discrete time."""
    operators = np.stack([symmetric.congruence(w) for w in system.matrices])
    if system.loss_variance is not None:
        lift = system.lift
        entering = symmetric.pack(lift[:, :, None] * lift[:, None, :])  # (m, p): e_i e_i^T in reduced coordinates
        differences = lift[:, None, :] - lift[None, :, :]
        for mode, variance in enumerate(system.loss_variance):
            seen = np.einsum("ij,ija,ijb->iab", variance, differences, differences)
            operators[mode] += entering.T @ symmetric.pack(seen)
    return operators


def _reciprocal_condition(factors: FloatArray, norm: float) -> float:
    if factors.size == 0:
        return 1.0
    reciprocal, _ = scipy.linalg.lapack.dgecon(factors, norm)
    return float(reciprocal)


def mode_potential(system: JumpSystem, dual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the graph alone contributes: the Poisson equation of the chain. Discrete time.

    With it f(y, g) = y^T Y_g y + kappa_g satisfies f - E[f(next) | now] = y^T H y - (its steady mean).

    Parameters
    ----------
    system : discrete time
    dual : (q, n, d, d) from ``MomentSolver.dual``

    Returns
    -------
    means : (q,) steady means of y^T H y
    kappa : (q, n), pi-mean zero
    """
    ahead = np.einsum("ij,qjab->qiab", system.chain, dual)
    gained = np.einsum("qiab,iab->qi", ahead, system.noise)
    means = gained @ system.stationary
    chain = np.eye(system.modes) - system.chain + system.stationary
    return means, np.linalg.solve(chain, (gained - means[:, None]).T).T


def transient_mean(
    system: JumpSystem, steady: FloatArray, initial: FloatArray, law: FloatArray, steps: int
) -> FloatArray:
    """Exact mean over the steps 0..steps-1 of E[y(k) y(k)^T] from a known start. Discrete time.

    The distance to the steady state is what is stepped, until nothing is left of it.

    Parameters
    ----------
    system : discrete time
    steady : (n, d, d) steady moments
    initial : (n, d, d) E[y(0) y(0)^T; mode i]
    law : (n,) of g(0)
    steps : > 0

    Returns
    -------
    (d, d)
    """
    away, law_away = initial - steady, law - system.stationary
    scale = max(np.abs(steady).max(initial=0.0), np.abs(initial).max(initial=0.0))
    total = np.zeros_like(steady)
    for _ in range(steps):
        if np.abs(away).max(initial=0.0) <= 1e-17 * scale and np.abs(law_away).max() <= 1e-17:
            break
        total += away
        away, law_away = system.advance(away, law_away)
    return np.asarray(steady.sum(axis=0) + total.sum(axis=0) / steps)
