# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The coupled equations of second moments without their matrix: the operator, and its preconditioner.

docs/accuracy.md, "How the equations are solved", has both.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from msg_analysis.common.arrays import BoolArray, FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.krylov import norms
from msg_analysis.theory.lyapunov import LocalSolves, single

MAX_RELATIVE_ERROR = 1e-6  # largest estimated relative error that is accepted; usual is 1e-13

Method = Literal["gmres", "direct", "dense"]

Preconditioner = Literal["two-level", "none"]


@dataclass(frozen=True, slots=True)
class SolverReport:
    """How the coupled equations were solved."""

    method: Method  # "direct" for one graph without loss; "dense": LU
    preconditioner: Preconditioner  # "two-level": every graph, then their average
    iterations: int  # Krylov iterations, direct solves and steps of refinement
    residual: float  # norm of a graph's residual over that of its right-hand side, in the worst graph
    backward_error: float  # the same over the sum of the norms of the terms that the residual consists of
    # Estimated relative error: the larger of what rounding of the law may leave (in the report of ``MomentSolver``) and
    # the correction that one preconditioned step makes; "dense": the backward error times the condition number.
    error: float

    def to_json(self) -> dict[str, Any]:
        """As in ``msg-analysis predict --json``."""
        return asdict(self)


def singular_message(reason: str = "") -> str:
    """The error message for equations that have no solution that can be trusted; ``reason`` follows "singular"."""
    return (
        f"second moments: the equations are (nearly) singular{reason}, so the errors grow without bound or cannot be "
        "computed: check that the union of the graphs connects all agents and that the rates do not differ by many "
        "orders of magnitude"
    )


# Amplification of relative errors of the averaged matrix from which rounding alone makes its inverse worthless.
MAX_AMPLIFICATION = MAX_RELATIVE_ERROR / float(np.finfo(float).eps)
FAST = 10.0  # above this rate of leaving, relative to the mean decay, differences are taken before rates multiply them
SINGLE_FROM = 80  # smallest dimension at which single precision is faster
SEPARATION = 10.0  # least ratio of the rate that holds a group together to the rate at which it is left


class Level(NamedTuple):
    """Disjoint groups of graphs that are averaged."""

    average: FloatArray  # (g, n) law of the graph, given the group
    members: FloatArray  # (g, n) 1.0 where a graph belongs to the group
    solves: LocalSolves  # of the averaged equations, one for each group


class CoupledEquations:
    """A X = B for the steady moments of one system, or its adjoint; stacks (q, n, d, d) hold q right-hand sides.

    Per unit of probability, X_i = C_i / pi_i, steady moments and adjoints obey the same equations, for the chain run
    backwards and forwards (Propositions 2 and 3 of the paper; 7 and 8 in discrete time):

        continuous: A X_i = D_i X_i + X_i D_i^T - sum_j T_ij X_j,       D = Z,      T a generator
        discrete:   A X_i = X_i - sum_j T_ij K_j[X_j],                  D = I - W,  T a transition matrix

    Both are local[X]_i - sum_j T_ij (Y_j - Y_i) over j != i, with Y_j = X_j or K_j[X_j] and local[X] = D X + X D^T or
    X - K[X]. With fast switching it is these differences that are evaluated: they are small and lose no digits.

    The preconditioner first solves every graph alone, left at its rate, and then, on the residual of that, one averaged
    equation for what is common to all graphs (two-level, "A-DEF2" of Tang, Nabben, Vuik, Erlangga 2009). The first
    alone fails for fast switching, the second alone for slow. Groups of graphs that switch among themselves much
    faster than they are left get averaged equations of their own, smaller groups first.

    ``forward``: the equations of C_i / pi_i, to get their adjoint (of Y_i, or sum_j P_ij Y_j in discrete time: see
    ``MomentSolver.dual``); None to get these themselves. InputError: D, averaged over all graphs, is nearly singular.
    """

    def __init__(
        self, system: JumpSystem, forward: CoupledEquations | None = None, *, single_from: int = SINGLE_FROM
    ) -> None:
        self.system, self.weights, self._forward = system, system.stationary, forward  # weights: (n,) pi
        # Whether single precision is faster.
        self.large: bool = forward.large if forward else system.dimension >= single_from
        flow = system.stationary[:, None] * system.chain  # of probability, between graphs
        # drift: (n, d, d) D; rates: (n, n) T off the diagonal, 0 on it; leaving: (n,) its row sums
        if forward is None:
            self.drift, self.rates = _drift(system), _off_diagonal(flow.T / system.stationary[:, None])
        else:
            self.drift, self.rates = forward.drift.transpose(0, 2, 1), _off_diagonal(system.chain)
        self.leaving = self.rates.sum(axis=1)
        # Whether the preconditioner is A^-1.
        self.direct = system.modes == 1 and not system.lossy
        self.symmetric = np.array_equal(self.drift, self.drift.transpose(0, 2, 1))
        # With messages one by one, matrices are large and often defective, and solves only precondition.
        self._nearly = system.losses is not None
        self._levels = self._averages() if system.modes > 1 else []
        self.whole = self._levels[-1].solves if self._levels else self.modes
        if self.whole.amplification > MAX_AMPLIFICATION:
            raise InputError(singular_message())

    @cached_property
    def modes(self) -> LocalSolves:
        """The solves of single graphs."""
        if self._forward is None:
            return LocalSolves(self.system.time, self.drift, self.leaving, nearly=self._nearly)
        return self._forward.modes if self.symmetric else self._forward.modes.transposed()

    @cached_property
    def inner(self) -> CoupledEquations:
        """These equations to iterate with, in single precision if that suffices (residuals are taken in double)."""
        mild = self.modes.mild and all(level.solves.mild for level in self._levels)
        other = copy.copy(self)
        if not (mild and self.large):
            return other
        other.modes = self.modes.single()
        other.drift, other.rates, other.leaving = other.modes.drift, single(self.rates), single(self.leaving)
        other._levels = [Level(single(law), single(members), solves.single()) for law, members, solves in self._levels]
        return other

    @property
    def decay(self) -> FloatArray:
        """(d,) rates at which the averaged graph pulls every coordinate back, to compare solutions with."""
        return np.asarray(np.abs(np.diagonal(self.whole.drift[0])))

    def apply(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(A X, (q, n) sums of the norms of the terms), as accurate as rounding allows."""
        total, moved = self._local(x)
        if self.leaving.max() <= FAST * self.decay.mean():
            total -= _combined(self.rates - np.diag(self.leaving), moved)
        else:
            for i in range(self.system.modes):
                for j in np.flatnonzero(self.rates[i]):
                    total[:, i] -= self.rates[i, j] * (moved[:, j] - moved[:, i])
        size = 2.0 * norms(self.drift[None])[0] + self.leaving
        given = norms(x)
        return total, size * given + given @ self.rates.T

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for Z near A^-1 R."""
        z, moved = self.modes(right)
        rest = self._mixed(moved)  # R - A Z
        if self.system.lossy:
            rest += self.after_jump(self._lost(z))
        for level in self._levels:
            correction, _ = level.solves(_combined(level.average, rest))
            spread = _combined(level.members.T, correction)
            local, moved = self._local(spread)
            rest -= local
            if self.system.time == "discrete" or not level.members.all():
                rest += self._mixed(moved) - self.leaving[:, None, None] * moved
            z = z + spread
        return z, right - rest

    def _averages(self) -> list[Level]:
        """Small groups first; the last level is the average of all graphs."""
        levels = []
        for groups in [*_groups(self.rates, self.weights), [np.ones(len(self.weights), dtype=bool)]]:
            members = np.array(groups, dtype=float)
            average = members * self.weights
            average /= average.sum(axis=1, keepdims=True)
            drift = np.tensordot(average, self.drift, axes=1)
            if self.symmetric:
                drift = 0.5 * (drift + drift.transpose(0, 2, 1))  # to the last bit
            pairs = zip(average, groups, strict=True)
            leaving = np.array([law[g] @ self.rates[np.ix_(g, ~g)].sum(axis=1) for law, g in pairs])
            levels.append(Level(average, members, LocalSolves(self.system.time, drift, leaving, nearly=self._nearly)))
        return levels

    def _local(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """local[X] and Y."""
        drift = self.drift
        half = drift @ x
        if "modes" in self.__dict__:
            half = self.modes.without_null(half)
        if self.system.time == "continuous":
            return half + half.swapaxes(-1, -2), x
        half -= 0.5 * (half @ drift.transpose(0, 2, 1))
        local = half + half.swapaxes(-1, -2)
        if self.system.lossy:
            local -= self._lost(x)
        return local, x - local

    def moved(self, x: FloatArray) -> FloatArray:
        """(q, n, d, d) K[X], or its adjoint. Discrete time."""
        return self._local(x)[1]

    def after_jump(self, y: FloatArray) -> FloatArray:
        """(q, n, d, d) sum_j T_ij Y_j. Discrete time."""
        if (y == y[:, :1]).all():
            return y
        return np.asarray(self._mixed(y) + (1.0 - self.leaving)[:, None, None] * y)

    def _mixed(self, y: FloatArray) -> FloatArray:
        """sum_j T_ij Y_j over j != i."""
        return _combined(self.rates, y)

    def _lost(self, x: FloatArray) -> FloatArray:
        """What lost messages add to K[X], or to its adjoint."""
        return self.system.lost(x) if self._forward is None else self.system.lost_adjoint(x)


def _combined(factors: FloatArray, stack: FloatArray) -> FloatArray:
    """(q, g, d, d): sum_j factors[i, j] stack[:, j]."""
    q, n, d, _ = stack.shape
    return np.asarray(factors @ stack.reshape(q, n, d * d)).reshape(q, len(factors), d, d)


def _off_diagonal(chain: FloatArray) -> FloatArray:
    rates = chain.copy()
    np.fill_diagonal(rates, 0.0)
    return rates


def _drift(system: JumpSystem) -> FloatArray:
    """(n, d, d) Z or I - W, made symmetric to the last bit if only rounding keeps it from being so."""
    matrices = system.matrices
    d = system.dimension
    drift = matrices.copy() if system.time == "continuous" else np.eye(d) - matrices
    rows = 16.0 * np.sqrt(d) * float(np.finfo(float).eps) * np.linalg.norm(matrices, axis=2)
    # One matrix after the other, to stay in the caches.
    if all((np.abs(w - w.T) <= rounding[:, None] + rounding).all() for w, rounding in zip(matrices, rows, strict=True)):
        for matrix in drift:
            matrix[:] = 0.5 * (matrix + matrix.T)
    return drift


def _groups(rates: FloatArray, stationary: FloatArray) -> list[list[BoolArray]]:
    """Disjoint groups at every level, each strongly connected by rates far above the rate at which it is left."""
    positive = rates[rates > 0.0]
    levels: list[list[BoolArray]] = []
    if len(rates) < 3 or positive.max() < SEPARATION * positive.min():
        return levels
    found: set[bytes] = set()
    decades = np.arange(np.floor(np.log10(positive.max())), np.log10(positive.min()), -1.0)
    for threshold in 10.0**decades:
        _, labels = connected_components(rates >= threshold, connection="strong")
        level = []
        for label in np.unique(labels):
            group = labels == label
            leaving = stationary[group] @ rates[np.ix_(group, ~group)].sum(axis=1) / stationary[group].sum()
            held = 1 < group.sum() < len(rates) and SEPARATION * leaving <= threshold
            if held and group.tobytes() not in found:
                found.add(group.tobytes())
                level.append(group)
        if level:
            levels.append(level)
    return levels
