# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Second moments of jump linear systems: steady, dual (adjoint) and transient.

Propositions 2, 3, 7 and 8 of the paper; in general, Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear
Systems (2005).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.coupled_equations import MAX_RELATIVE_ERROR, SolverReport, singular_message
from msg_analysis.theory.first_steps import Start
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.solvers import MAX_ITERATIONS, DenseSolver, IterativeSolver

MARGIN = 8.0  # of the estimated errors, see docs/accuracy.md
MAX_KEPT = 10_000_000  # numbers of adjoint solutions that a solver keeps, at most
MAX_BOUNDED = 5_000  # numbers of second moments whose error is bounded: it takes a second solve
MAX_FALLBACK = 1000  # unknowns up to which equations that do not converge are solved densely


class MomentSolver:
    """The coupled equations of the steady second moments C_i (Propositions 2, 3, 7 and 8 of the paper).

        continuous: Z_i C_i + C_i Z_i^T - sum_j Gamma_ji C_j = pi_i Q_i
        discrete:   C_i - sum_j P_ji K_j[C_j] = sum_j P_ji pi_j N_j

    Matrix-free: time grows as n d^3, memory as n d^2. Equations that are small and do not converge are solved densely.
    ``guess``: (n, d, d) steady moments of a similar system (the last one of a sweep), to start from. InputError, here
    and from all methods: no steady second moments, or too ill-conditioned to be trusted.
    """

    def __init__(
        self,
        system: JumpSystem,
        *,
        guess: FloatArray | None = None,
        most_dense: int = MAX_FALLBACK,
        most_bounded: int = MAX_BOUNDED,
        most_kept: int = MAX_KEPT,
        most_iterations: int = MAX_ITERATIONS,
    ) -> None:
        if guess is not None and guess.shape != system.matrices.shape:
            raise InputError(
                f"guess: shape {guess.shape}, but the second moments of this system have {system.matrices.shape}: "
                "give those of a system with the same graphs and agents"
            )
        self.system = system
        self.report: SolverReport | None = None  # how the steady state was found
        self._most_bounded = most_bounded
        self._most_kept, self._duals = most_kept, dict[bytes, FloatArray]()
        unknowns = system.modes * packed_symmetric.size(system.dimension)
        self._dense_too = unknowns <= most_dense
        self._solver: DenseSolver | IterativeSolver
        if unknowns:
            self._solver = IterativeSolver(system, guess, most_iterations=most_iterations)
        else:
            self._solver = DenseSolver(system)

    def steady(self) -> FloatArray:
        """(n, d, d): C_i = E[y y^T; mode i] in the steady state."""
        moments = self._solved(lambda solver: solver.steady())
        least = np.linalg.eigvalsh(moments).min(initial=0.0)
        # Not "<": NaN must be refused, too.
        if not least >= -MAX_RELATIVE_ERROR * np.abs(moments).max(initial=0.0):
            raise InputError(
                "second moments: the equations have no positive solution, so the errors grow without bound: "
                "lower run.dt, or add edges until the union of the graphs connects all agents"
            )
        report = self._solver.report
        assert report is not None
        self.report = report = replace(report, error=max(MARGIN * report.error, self._rounding(moments)))
        # Not ">": NaN must be refused, too.
        if not report.error <= MAX_RELATIVE_ERROR:
            raise InputError(singular_message(f" (rounding may leave a relative error of {report.error:.1e})"))
        return moments

    def _rounding(self, moments: FloatArray) -> float:
        """Relative error that rounding of Z_i or W_i may leave, whatever the method, in the worst graph.

        The rounding of a term of the equations is at most r_i I, and the solution is monotone in the noise: so what it
        changes is at most the solution for the noise r_i I. Where this takes long, the ratio of the noises is taken.
        """
        system, law = self.system, self.system.stationary
        if not system.noise.any():
            return 0.0
        sizes = np.linalg.norm(moments, 2, axis=(1, 2))
        terms = 2.0 * np.linalg.norm(system.matrices, 2, axis=(1, 2)) * sizes / law
        if system.lossy:
            terms += np.linalg.norm(system.lost(moments), 2, axis=(1, 2)) / law
        rounded = MARGIN * float(np.finfo(float).eps) * terms
        if moments.size > self._most_bounded:
            return float(law @ rounded / (law @ np.linalg.norm(system.noise, axis=(1, 2))))
        left = self._solved(lambda solver: solver.steady(rounded[:, None, None] * np.eye(system.dimension)))
        return float((np.linalg.norm(left, 2, axis=(1, 2)) / sizes).max())

    def dual(self, forms: FloatArray) -> FloatArray:
        """(q, n, d, d): the adjoint solutions Y of the symmetric forms H (q, d, d); read-only where they are kept.

        continuous: Z_i^T Y_i + Y_i Z_i - sum_j Gamma_ij Y_j = H,     E[y^T H y] = sum_i pi_i tr(Y_i Q_i)
        discrete:   Y_i = H + K_i^*[sum_j P_ij Y_j],                  E[y^T H y] = sum_ij pi_i P_ij tr(Y_j N_i)
        """
        key = forms.tobytes()
        found = self._duals.get(key)  # every comparison of a run with the same prediction asks for the same forms
        if found is None:
            found = self._solved(lambda solver: solver.dual(forms))
            if sum(kept.size for kept in self._duals.values()) + found.size <= self._most_kept:
                found.setflags(write=False)
                self._duals[key] = found
        return found

    def _solved(self, solve: Callable[[DenseSolver | IterativeSolver], FloatArray]) -> FloatArray:
        """By the solver, and if that fails for a small system, densely from then on."""
        try:
            return solve(self._solver)
        except InputError:
            if not self._dense_too or isinstance(self._solver, DenseSolver):
                raise
        self._solver = DenseSolver(self.system)
        return solve(self._solver)


def mode_potential(system: JumpSystem, dual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(q,) steady means of y^T H y, and the (q, n) potential kappa of the graph, of pi-mean zero. Discrete time.

    kappa solves the Poisson equation of the chain: with it, f(y, g) = y^T Y_g y + kappa_g satisfies f - E[f(next) |
    now] = y^T H y - (its steady mean), for the adjoint solutions Y (q, n, d, d) of ``MomentSolver.dual``.
    """
    ahead = np.einsum("ij,qjab->qiab", system.chain, dual)
    gained = np.einsum("qiab,iab->qi", ahead, system.noise)
    means = gained @ system.stationary
    chain = np.eye(system.modes) - system.chain + system.stationary
    return means, np.linalg.solve(chain, (gained - means[:, None]).T).T


def transient_mean(system: JumpSystem, steady: FloatArray, start: Start, steps: int) -> FloatArray:
    """(d, d) exact mean over the steps 0..steps-1 of E[y(k) y(k)^T] from a known start. Discrete time.

    ``steady``: (n, d, d). The distance to the steady state is stepped (equations of Proposition 6), until nothing is
    left of it.
    """
    total = np.zeros_like(steady)
    for now in start[: min(steps, len(start) - 1)]:
        total += now.moments - steady
    away, law_away = start[-1].moments - steady, start[-1].law - system.stationary
    scale = max(np.abs(steady).max(initial=0.0), np.abs(start[-1].moments).max(initial=0.0))
    for step in range(len(start) - 1, steps, 8):  # not looked at every time: a look takes as long as a step
        if np.abs(away).max(initial=0.0) <= 1e-17 * scale and np.abs(law_away).max() <= 1e-17:
            break
        for _ in range(min(8, steps - step)):
            total += away
            away, law_away = system.advance(away, law_away)
            law_away -= law_away.sum() * system.stationary  # the rounding of its sum, 0, would stay for ever
    return np.asarray(steady.sum(axis=0) + total.sum(axis=0) / steps)
