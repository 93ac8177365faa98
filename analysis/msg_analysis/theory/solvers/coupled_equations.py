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

"""The coupled equations of second moments, matrix-free: the operator, and the "two-level" preconditioner for it.

docs/accuracy.md, "How the equations are solved", says when which preconditioner is used.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from msg_analysis.errors import InputError
from msg_analysis.theory.solvers.krylov import STRIP, flat, norms, strips
from msg_analysis.theory.solvers.lyapunov import LocalSolves, single
from msg_analysis.theory.solvers.solver_report import MAX_RELATIVE_ERROR, singular_message
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.types import BoolArray, FloatArray

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

    ``forward``: the equations of C_i / pi_i, to get their adjoint; None to get these themselves. InputError: D,
    averaged over all graphs, is singular up to rounding.
    """

    def __init__(self, system: JumpSystem, forward: CoupledEquations | None = None) -> None:
        self.system, self.weights, self._forward = system, system.stationary, forward  # weights: (n,) pi
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
        flow = flow - np.diag(np.diag(flow))
        self.reversible = bool((np.abs(flow - flow.T) <= 1e-13 * (flow + flow.T)).all())
        # In the inner product with the weights; ``inner.definite`` checks that every graph is symmetric, too.
        self.definite = (
            system.time == "continuous" and self.reversible and len(self._levels) == 1 and self.whole.definite
        )

    def adjoint(self) -> CoupledEquations:
        """The equations of Y_i (continuous time), or of sum_j P_ij Y_j (discrete time); see ``MomentSolver.dual``."""
        return CoupledEquations(self.system, self)

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
        other.definite = self.definite and self.modes.definite
        if not (mild and self.large):
            return other
        other.modes = self.modes.single()
        other.drift, other.rates, other.leaving = other.modes.drift, single(self.rates), single(self.leaving)
        other._levels = [
            Level(single(level.average), single(level.members), level.solves.single()) for level in self._levels
        ]
        return other

    @property
    def large(self) -> bool:
        """Whether single precision is faster."""
        return self.system.dimension >= SINGLE_FROM

    @property
    def one_level(self) -> bool:
        """Whether the only average is the one of all graphs."""
        return len(self._levels) == 1

    @property
    def decay(self) -> FloatArray:
        """(d,) rates at which the averaged graph pulls every coordinate back, to compare solutions with."""
        return np.asarray(np.abs(np.diagonal(self.whole.drift[0])))

    def apply(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(A X, (q, n) sums of the norms of the terms), as accurate as rounding allows."""
        total, moved = self._local(x)
        if self.leaving.max() <= FAST * self.decay.mean():
            _subtract_combined(total, self.rates - np.diag(self.leaving), moved)
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
        return self._averaged(z, rest, right)

    def average(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(Z, A Z) for the Z common to all graphs that leaves a residual of mean zero."""
        return self._averaged(np.zeros_like(right), right.copy(), right)

    def _averaged(self, z: FloatArray, rest: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
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
            return _plus_transposes(half), x
        squared = half @ drift.transpose(0, 2, 1)
        squared *= -0.5
        squared += half
        local = _plus_transposes(squared)
        if self.system.lossy:
            local -= self._lost(x)
        return local, np.subtract(x, local, out=half)

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


def _plus_transposes(stack: FloatArray) -> FloatArray:
    """X + X^T of every matrix; large ones in place, one after the other, to stay in the caches."""
    if stack[0, 0].size <= STRIP:
        return stack + stack.swapaxes(-1, -2)
    for place in np.ndindex(stack.shape[:2]):
        stack[place] += stack[place].T
    return stack


def _subtract_combined(total: FloatArray, factors: FloatArray, stack: FloatArray) -> None:
    """Subtract sum_j factors[i, j] stack[:, j], in place and in strips: fresh memory costs as much as a product."""
    total, stack = flat(total), flat(stack)
    for part in strips(total.shape[-1]):
        total[..., part] -= factors @ stack[..., part]


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
