# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The coupled equations of second moments without their matrix: the operator, and two preconditioners for it.

The "averaged" one replaces every graph by the average of all graphs: for symmetric graphs that do not switch slowly. It
needs more iterations than the "two-level" one, but each costs a quarter as much or less, and no eigenvectors of single
graphs. docs/accuracy.md, "How the equations are solved", says when which is used.
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
from msg_analysis.theory.krylov import STRIP, flat, norms, strips
from msg_analysis.theory.lyapunov import LocalSolves, single

MAX_RELATIVE_ERROR = 1e-6  # largest estimated relative error that is accepted; usual is 1e-13

Method = Literal["cg", "gmres", "direct", "dense"]

Preconditioner = Literal["two-level", "averaged", "none"]


@dataclass(frozen=True, slots=True)
class SolverReport:
    """How the coupled equations were solved."""

    # "cg" where the preconditioned equations are symmetric and positive definite (symmetric graphs, reversible chain;
    # in discrete time only with "averaged"), else "gmres"; "direct" for one graph without loss; "dense": LU.
    method: Method
    preconditioner: Preconditioner  # "two-level": every graph, then their average; "averaged": the average only
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
        flow = flow - np.diag(np.diag(flow))
        self.reversible = bool((np.abs(flow - flow.T) <= 1e-13 * (flow + flow.T)).all())
        # In the inner product with the weights; ``inner.definite`` checks that every graph is symmetric, too.
        symmetric = system.time == "continuous" and self.reversible
        self.definite = symmetric and len(self._levels) == 1 and self.whole.definite

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
        other._levels = [Level(single(law), single(members), solves.single()) for law, members, solves in self._levels]
        return other

    @property
    def levels(self) -> int:
        """Number of averages; 1: only that of all graphs."""
        return len(self._levels)

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


SLOWEST = 0.1  # least rate of leaving a graph, relative to the mean decay, from which this pays
LARGEST_INVERSE = 100.0  # largest norm of the inverse of the transition matrix that single precision allows
NEGLIGIBLE = 3.0  # d_i X d_i is left out where the error allowed is this many times its usual contribution


def averaged_equations(equations: CoupledEquations) -> AveragedEquations | None:
    """The cheaper preconditioner, where it promises to be better; None elsewhere."""
    # M must be positive, single precision suffice, and every graph be left fast enough for this to pay.
    whole = equations.whole
    if not (equations.levels == 1 and equations.large and equations.symmetric) or equations.system.lossy:
        return None
    if not (whole.mild and whole.definite and equations.leaving.min() >= SLOWEST * equations.decay.mean()):
        return None
    if whole.time == "discrete":
        smallest = np.linalg.svd(_transition(equations), compute_uv=False)[-1]
        if not smallest * LARGEST_INVERSE > 1.0:
            return None
    rates = np.linalg.eigvalsh(_flow(equations)[0])
    return AveragedEquations(equations) if rates[0] >= -1e-10 * rates[-1] else None


class AveragedEquations:
    """The preconditioned equations I + S. Unknowns: U = M^1/2 X; right-hand sides: M^-1/2 B. All in single precision.

    For equal graphs, the eigenvectors of the average and of the chain (its reversible part) make the equations
    diagonal: this diagonal is the preconditioner M. S is what distinguishes the graphs from their average: in the
    eigenvectors of the average, L its eigenvalues and d_i = D_i - L, the map X -> G + G^T with

        continuous: G = d_i X
        discrete:   G = d_i X (I - L - d_i / 2)

    In discrete time the equations are first multiplied by the inverse of the transition matrix T: T^-1 X - K[X] =
    T^-1 B has the form of continuous time, and is self-adjoint if the chain is reversible. What of the chain is not
    reversible is a part of S, too.
    """

    def __init__(self, equations: CoupledEquations) -> None:
        whole = equations.whole
        assert whole.eigenvectors is not None
        self.definite = equations.reversible  # I + S is symmetric then, and positive definite if moments stay bounded
        self._discrete = whole.time == "discrete"
        values, vectors = whole.eigenvectors.values[0], whole.eigenvectors.vectors[0]
        n, d = len(equations.weights), len(values)
        self._vectors, diagonal, k = single(vectors), np.arange(d), d // 2
        self._distance = np.empty((n, d, d), np.float32)
        for distance, drift in zip(self._distance, equations.drift, strict=True):
            distance[:] = self._inside(drift)
        self._distance[:, diagonal, diagonal] -= single(values)
        self._strips = strips(d * d)
        self._buffers: list[FloatArray] = []

        flow, circulation = _flow(equations)
        rates, modes = np.linalg.eigh(flow)
        root = np.sqrt(equations.weights)
        forth = modes.T * root
        self._forth, self._back = single(forth), single(modes / root[:, None])
        self._circulation = None if equations.reversible else single(0.5 * modes.T @ circulation @ modes)
        self._enter = single(forth @ np.linalg.inv(_transition(equations)) if self._discrete else forth)
        divisor = values[:, None] + values
        if self._discrete:
            divisor -= values[:, None] * values
        self._scale = np.empty((n, d * d), np.float32)
        for scale, rate in zip(self._scale, rates, strict=True):
            scale[:] = 1.0 / np.sqrt(divisor.ravel() + max(rate, 0.0))

        if self._discrete:
            self._kept = single(1.0 - values)
            step = -0.5 * self._distance
            self._usual = float(np.square(self._distance).sum(axis=(1, 2)).max() / d * np.square(self._scale).mean())
            self._upper, self._lower = step[:, :, :k].copy(), step
            self._lower[:, :, :k] *= 2.0
            self._upper[:, diagonal[:k], diagonal[:k]] += self._kept[:k]
            self._lower[:, diagonal, diagonal] += self._kept

    def enter(self, matrices: FloatArray, scale: FloatArray) -> FloatArray:
        """M^-1/2 B / scale, (q, n, d, d), from right-hand sides B (q, n, d, d) of the equations and scales (q,)."""
        given = matrices[:, :1] if (matrices == matrices[:, :1]).all() else matrices
        factors = self._enter if given is matrices else self._enter.sum(axis=1, keepdims=True)
        inside = self._workspace(matrices.shape)[0][:, : given.shape[1]]
        for place in np.ndindex(given.shape[:2]):
            inside[place] = self._inside(given[place] / scale[place[0]])
        right: FloatArray = np.empty(matrices.shape, np.float32)
        for part in self._strips:
            np.multiply(factors @ flat(inside)[..., part], self._scale[:, part], out=flat(right)[..., part])
        return right

    def solution(self, scaled: FloatArray) -> FloatArray:
        """X = M^-1/2 U, (q, n, d, d), in the eigenvectors of the average; the next call of any method overwrites it."""
        x = self._workspace(scaled.shape)[0]
        for part in self._strips:
            np.matmul(self._back, self._scale[:, part] * flat(scaled)[..., part], out=flat(x)[..., part])
        return x

    def leave(self, scaled: FloatArray, scale: FloatArray, total: FloatArray) -> None:
        """Add scale * X, symmetrised and in the coordinates of the equations, to ``total`` (q, n, d, d), in place."""
        solution = self.solution(scaled)
        for place in np.ndindex(solution.shape[:2]):
            moved = self._vectors @ solution[place] @ self._vectors.T
            total[place] += 0.5 * scale[place[0]] * (moved + moved.T).astype(float)

    def apply(self, x: FloatArray, accuracy: float = 0.0) -> FloatArray:
        """(I + S) X, (q, n, d, d), to about the relative error ``accuracy``; the next call overwrites it."""
        z, half = self.solution(x), self._workspace(x.shape)[1]
        np.matmul(self._distance, z, out=half)
        if self._discrete:
            half, z = self._second(half, z, accuracy), half
        for part in self._strips:
            found = self._forth @ flat(half)[..., part]
            if self._circulation is not None:
                found += self._circulation @ (self._scale[:, part] * flat(x)[..., part])
            np.multiply(found, self._scale[:, part], out=flat(z)[..., part])
        np.add(z, z.swapaxes(-1, -2), out=half)
        half += x
        return half

    def precondition(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(R, (I + S) R): the equations are preconditioned already."""
        return right, self.apply(right)

    def _second(self, half: FloatArray, out: FloatArray, accuracy: float) -> FloatArray:
        """G from ``half`` = d_i X, up to an antisymmetric part. Discrete time."""
        # d_i X d_i is symmetric, so its upper right block is not computed: the lower left one counts twice.
        if accuracy > NEGLIGIBLE * self._usual:
            return np.multiply(half, self._kept, out=out)
        k = half.shape[-1] // 2
        np.matmul(half[..., :k, :], self._upper, out=out[..., :k, :k])
        np.matmul(half[..., k:, :], self._lower, out=out[..., k:, :])
        np.multiply(half[..., :k, k:], self._kept[k:], out=out[..., :k, k:])
        return out

    def _inside(self, matrix: FloatArray) -> FloatArray:
        """The matrix in the eigenvectors of the average."""
        return np.asarray(self._vectors.T @ single(matrix) @ self._vectors)

    def _workspace(self, shape: tuple[int, ...]) -> list[FloatArray]:
        """Two stacks that are kept between calls: fresh memory costs as much as a product."""
        if not self._buffers or self._buffers[0].shape != shape:
            self._buffers = [np.empty(shape, np.float32) for _ in range(2)]
        return self._buffers


def _transition(equations: CoupledEquations) -> FloatArray:
    """(n, n) T. Discrete time."""
    return np.asarray(np.diag(1.0 - equations.leaving) + equations.rates)


def _flow(equations: CoupledEquations) -> tuple[FloatArray, FloatArray]:
    """(n, n) symmetric part and antisymmetric part of -T (continuous time) or T^-1 - I, symmetrised by the weights."""
    flow = np.diag(equations.leaving) - equations.rates
    if equations.system.time == "discrete":
        flow = np.linalg.inv(_transition(equations)) - np.eye(len(flow))
    root = np.sqrt(equations.weights)
    flow = root[:, None] * flow / root
    return 0.5 * (flow + flow.T), 0.5 * (flow - flow.T)
