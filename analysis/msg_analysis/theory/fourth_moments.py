# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Fourth moments of a jump linear system: their steps, and whether they are finite.

S_i = E[y y y y; mode i] follow S_j(k+1) = sum_i P_ij E[A_i^(4)] S_i(k) + terms of lower moments, with A_i the random
matrix of a step and A^(4) its Kronecker power. They stay finite if the spectral radius of this map is below 1 (as for
second moments: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, Section 3.4).

The matrix of a step comes in stages, in each of which some messages may be lost: z becomes
(M + sum_e eta_e u_e v_e^T) z + noise, with eta_e = p_e if message e arrives and p_e - 1 if it is lost, with probability
p_e. M is the mean, u_e what the message acts on, v_e the difference between what it brings and what takes its place;
see docs/theory.md, "Messages one by one".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse.linalg

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.message_steps import Move, message_steps


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Messages that are used, or lost, at the same time; E of them may be lost."""

    rows: IntArray  # (r,) entries of z that change
    matrix: FloatArray  # (r, k) M, these rows
    into: FloatArray  # (E, k) u
    differences: FloatArray  # (E, k) v
    losses: FloatArray  # (E,) p
    noise: FloatArray  # (r, r) covariance of what is added to these rows, its mean over the losses
    heard: float  # variance of the noise in what a message that arrives brings: a loss also takes its part of ``noise``

    def whole(self) -> tuple[FloatArray, FloatArray]:
        """(k, k) M and covariance of the noise."""
        size = self.matrix.shape[1]
        matrix, noise = np.eye(size), np.zeros((size, size))
        matrix[self.rows], noise[np.ix_(self.rows, self.rows)] = self.matrix, self.noise
        return matrix, noise


@dataclass(frozen=True, slots=True, eq=False)
class RandomSteps:
    """Steps of a jump linear system: y (d,) is embedded as z (k,), goes through the stages, and is read again."""

    chain: FloatArray  # (n, n) P
    stages: list[list[Stage]]  # of each mode
    embedding: FloatArray  # (k, d) with orthonormal columns: z = embedding @ y before, y = embedding^T z after


def random_steps(step: StepModel, system: JumpSystem) -> RandomSteps:
    """The steps of ``system``, made of ``step`` by ``jump_system.emulated``, in its coordinates y."""
    if step.by_message:
        whole = message_steps(step)
        embedding = np.zeros((whole.entries, system.dimension))
        embedding[whole.kept] = system.lift
        stages = [[_stage(move, whole.entries, step.link**2) for move in moves] for moves in whole.moves]
        return RandomSteps(system.chain, stages, embedding)
    lift, d, m = system.lift, system.dimension, step.agents
    older = len(lift) - m  # the states that others use come last; without a delay they are the only ones
    # Who loses a message also loses the noise in it, which all who hear it share: one number more for every sender.
    spoken = m if step.broadcast and step.loss else 0
    size = d + spoken
    nothing, rows = np.empty((0, size)), np.arange(size)
    added = step.broadcast**2 * np.eye(spoken)
    before = Stage(rows[d:], np.eye(size)[d:], nothing, nothing, np.empty(0), added, 0.0)
    stages = []
    for mode, matrix in enumerate(system.matrices):
        possible = step.loss_variance[mode] > 0.0
        if step.whole_link:  # the other direction is lost at the same time
            possible &= np.triu(possible) | ~possible.T
        i, j = np.nonzero(possible)
        into, differences = np.zeros((2, len(i), size))
        into[:, :d] = step.nominal[mode][possible][:, None] * lift[i]
        if step.whole_link:
            into[:, :d] -= step.nominal[mode].T[possible][:, None] * lift[j]
        differences[:, :d] = lift[older + j] - lift[i]
        both, noise = np.zeros((2, size, size))
        both[:d, :d], noise[:d, :d] = matrix, system.noise[mode]
        if spoken:
            heard = step.nominal[mode] * ~np.eye(m, dtype=np.bool_)
            both[:d, d:] = lift[:m].T @ ((1.0 - step.losses) * heard)
            own = step.noise_gain[mode] @ step.noise_gain[mode].T
            own += step.link**2 * np.diag(((1.0 - step.losses) * heard**2).sum(axis=1))
            noise[:d, :d] = lift[:m].T @ own @ lift[:m]
            differences[range(len(j)), d + j] = 1.0
        one = Stage(rows, both, into, differences, step.losses[possible], noise, step.link**2)
        stages.append([before, one] if spoken else [one])
    return RandomSteps(system.chain, stages, np.eye(size)[:, :d])


def _stage(move: Move, size: int, heard: float) -> Stage:
    into, differences = np.zeros((2, len(move.losses), size))
    for event, (entry, brings, instead, _, weight) in enumerate(move.losses):
        into[event, entry] = weight
        differences[event, brings] += 1.0
        differences[event, instead] -= 1.0
    losses = np.array([loss[3] for loss in move.losses])
    return Stage(np.array(move.rows, dtype=np.int64), move.matrix, into, differences, losses, move.noise, heard)


MAX_WORK = 3e7  # multiplications of one step of all fourth moments, at most: a second for the radius
SMALL_WORK = 1e6  # the same where it is known before that they are finite
BOUND_FORMS = 30  # that are tried for the upper bound
BOUND_FLOOR = 0.03  # added to them, so that they are positive
SECOND_WORK = 3e6  # multiplications of one step of all second moments, at most, for their radius
ROUNDING = 1e-12  # of sums of rows


@dataclass(frozen=True, slots=True)
class FourthMoment:
    """Spectral radius of the map of the fourth moments over a step, and what follows from it; None: not known."""

    radius: float | None  # exact
    lower: float | None  # bounds of it, equal to ``radius`` where that is known
    upper: float | None
    finite: bool | None  # whether the fourth moments of the states are finite in the steady state

    @classmethod
    def between(cls, lower: float | None, upper: float | None) -> FourthMoment:
        """Of bounds that are not exact."""
        finite = None
        if upper is not None and upper < 1.0:
            finite = True
        elif lower is not None and lower >= 1.0:
            finite = False
        return cls(None, lower, upper, finite)

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return asdict(self)


def fourth_moment(step: StepModel, system: JumpSystem) -> FourthMoment:
    """The spectral radius of the fourth moments of the steps of a run, exact where that takes about a second.

    Otherwise bounded: from below by r^2, r the radius of the second moments, since E[a^4] >= E[a^2]^2. From above by r
    where every agent takes a mean with weights that are not negative: then no step, whatever is lost, makes the largest
    difference between agents (or deviation from the reference) larger, so that E[a(k)^4] <= a(0)^2 E[a(k)^2]. Without
    losses also by ``lyapunov_bound``. ``step``: in real time that of the sequential law; ``system``: reduced.
    """
    means = bool((step.nominal >= 0.0).all() and (step.nominal.sum(axis=2) <= 1.0 + ROUNDING).all())
    steps = _affordable(step, system, SMALL_WORK if means else MAX_WORK)
    radius = fourth_radius(steps) if steps else None
    if radius is not None:
        return FourthMoment(radius, radius, radius, radius < 1.0)
    second = second_radius(system) if system.modes * system.dimension**3 <= SECOND_WORK else None
    lower = None if second is None else second**2
    if means:
        return FourthMoment(None, lower, second, finite=True)
    return FourthMoment.between(lower, None if system.lossy else lyapunov_bound(system))


def fourth_radius(steps: RandomSteps) -> float | None:
    """Spectral radius of the map of the fourth moments, by Arnoldi on tensors (n, d, d, d, d); None: not found."""
    n, d = len(steps.chain), steps.embedding.shape[1]
    start = _symmetric(np.multiply.outer(np.eye(d), np.eye(d)))
    return _positive_radius(lambda stack: advance(steps, stack), np.broadcast_to(start, (n, d, d, d, d)))


def second_radius(system: JumpSystem) -> float | None:
    """Spectral radius of the second moments, C_j -> sum_i P_ij K_i[C_i]; None: not found."""
    start = np.broadcast_to(np.eye(system.dimension), system.matrices.shape)
    return _positive_radius(lambda stack: np.tensordot(system.chain, system.propagate(stack), axes=(0, 0)), start)


def advance(steps: RandomSteps, stack: FloatArray) -> FloatArray:
    """(n, d, d, d, d): the symmetric tensors S_i = E[y y y y; mode i], ``stack``, one step later, without noise."""
    return np.asarray(np.tensordot(steps.chain, before_jump(steps, stack), axes=(0, 0)))


def before_jump(
    steps: RandomSteps, stack: FloatArray, second: FloatArray | None = None, law: FloatArray | None = None
) -> FloatArray:
    """(n, d, d, d, d): ``stack`` after the messages of a step, before the mode jumps.

    S_i = E[y y y y; mode i] without noise. Or, with noise, T_i = E[M M; mode i] of the covariance M of y given all
    modes and losses so far, where the first two places can be swapped, the last two, and these pairs; then ``second``
    (n, d, d) are E[M; mode i], and ``law`` (n,) the probabilities of the modes.
    """
    after = np.empty_like(stack)
    embedding = steps.embedding
    for mode, stages in enumerate(steps.stages):
        tensor, mean, share = _along_all_axes(embedding, stack[mode]), None, 0.0
        if second is not None and law is not None:
            mean, share = embedding @ second[mode] @ embedding.T, float(law[mode])
        for stage in stages:
            tensor, mean = _through(stage, tensor, mean, share)
        after[mode] = _along_all_axes(embedding.T, tensor)
    return after


def _through(
    stage: Stage, tensor: FloatArray, mean: FloatArray | None, share: float
) -> tuple[FloatArray, FloatArray | None]:
    """E[A^(4)] T of A = M + sum_e eta_e u_e v_e^T, eta_e independent of mean 0; and what noise adds, beside ``mean``.

    Only products in which no eta_e occurs once are left: M four times; M twice and e twice; M once and e three times;
    e four times; e twice and another f twice. The two places of e are in one pair of the tensor, or in both.
    """
    matrix, noise = stage.whole()
    size, events = len(matrix), len(stage.losses)
    shape = (size,) * 4
    moved = _along_all_axes(matrix, tensor)
    u, v, p = stage.into, stage.differences, stage.losses
    second = p * (1.0 - p)  # moments of eta
    third, fourth = second * (2.0 * p - 1.0), second * (1.0 - 3.0 * second)
    pairs = (u[:, :, None] * u[:, None, :]).reshape(events, size**2)
    if events:
        differences = (v[:, :, None] * v[:, None, :]).reshape(pairs.shape)
        inside = differences @ tensor.reshape(size**2, -1)
        inside = inside.reshape(events, size, size)  # T(v_e, v_e; ., .)
        across = np.einsum("ebcd,ec->ebd", (v @ tensor.reshape(size, -1)).reshape(events, *shape[1:]), v)
        once = np.einsum("eab,eb->ea", inside, v) @ matrix.T
        beside, apart = (seen.reshape(pairs.shape) @ differences.T for seen in (inside, across))  # (E, E)
        weights = np.outer(second, second)
        np.fill_diagonal(weights, fourth)
        rest = second[:, None, None] * (matrix @ inside @ matrix.T) + third[:, None, None] * _both(u, once)
        half = pairs.T @ (rest.reshape(pairs.shape) + 0.5 * (weights * beside) @ pairs)
        moved += (half + half.T).reshape(shape)
        np.fill_diagonal(weights, 0.0)
        rest = second[:, None, None] * (matrix @ across @ matrix.T)
        half = pairs.T @ (rest.reshape(pairs.shape) + 0.5 * (weights * apart) @ pairs)
        other = (half + half.T).reshape(shape)
        moved += other.transpose(0, 2, 1, 3) + other.transpose(0, 2, 3, 1)
    if mean is None:
        return moved, None
    carried, felt = matrix @ mean @ matrix.T, v @ mean
    squares = (felt * v).sum(axis=1)
    carried += (u.T * (second * squares)) @ u
    if events and stage.heard:
        rest = (second[:, None, None] * _both(u, felt @ matrix.T)).reshape(pairs.shape)
        rest += (third * squares + 0.5 * second * stage.heard * share)[:, None] * pairs
        half = stage.heard * pairs.T @ rest
        moved += (half + half.T).reshape(shape)
    added = np.multiply.outer(carried + 0.5 * share * noise, noise)
    return moved + added + added.transpose(2, 3, 0, 1), carried + share * noise


def _both(a: FloatArray, b: FloatArray) -> FloatArray:
    """(E, k, k): a b^T + b a^T of (E, k)."""
    product = a[:, :, None] * b[:, None, :]
    return np.asarray(product + product.swapaxes(1, 2))


def lyapunov_bound(system: JumpSystem) -> float:
    """Upper bound of the radius of the fourth moments, without losses.

    With forms X_i > 0, E[(y'^T X_g' y')^2 | y, g = i] <= bound (y^T X_i y)^2 for the largest
    sum_j P_ij lambda_max(X_i^-1 W_i^T X_j W_i)^2. X are tried in which X_i is nearly r^-1 W_i^T (sum_j P_ij X_j) W_i.
    """
    forms = np.broadcast_to(np.eye(system.dimension), system.matrices.shape)
    transposed = system.matrices.transpose(0, 2, 1)
    best = math.inf
    for _ in range(BOUND_FORMS):
        inverse = np.linalg.inv(np.linalg.cholesky(forms))
        after = transposed[:, None] @ forms[None] @ system.matrices[:, None]
        grown = inverse[:, None] @ after @ inverse.transpose(0, 2, 1)[:, None]
        largest = np.linalg.eigvalsh(grown)[..., -1]  # (n, n) of i and j
        best = min(best, float((system.chain * largest**2).sum(axis=1).max()))
        forms = transposed @ np.tensordot(system.chain, forms, axes=1) @ system.matrices
        size = np.trace(forms, axis1=1, axis2=2).max()
        if size == 0.0:
            break
        forms = forms / size + BOUND_FLOOR * np.eye(system.dimension)
    return best


def _affordable(step: StepModel, system: JumpSystem, work: float) -> RandomSteps | None:
    """The random steps, where one step of all fourth moments takes at most ``work`` multiplications."""
    if system.modes * float(system.dimension) ** 5 > work:
        return None
    steps = random_steps(step, system)
    size = len(steps.embedding)
    stages = [stage for stages in steps.stages for stage in stages]
    needed = sum(4.0 * size + 2.0 * len(stage.losses) for stage in stages) * float(size) ** 4
    return steps if needed <= work else None


def _along_all_axes(matrix: FloatArray, tensor: FloatArray) -> FloatArray:
    """(r, r, r, r): sum_efgh M_ae M_bf M_cg M_dh S_efgh; each product takes the first axis and adds the last."""
    r, k = matrix.shape
    for _ in range(4):
        tensor = tensor.reshape(k, -1).T @ matrix.T
    return tensor.reshape(r, r, r, r)


def _symmetric(tensor: FloatArray) -> FloatArray:
    """The mean over all orders of the axes."""
    orders = list(itertools.permutations(range(4)))
    return np.asarray(sum(tensor.transpose(order) for order in orders) / len(orders))


def _positive_radius(after: Callable[[FloatArray], FloatArray], start: FloatArray) -> float | None:
    """Largest eigenvalue in size of a positive map of stacks of this shape; None: not found."""
    size = start.size  # since the map is positive, no other eigenvalue is larger
    if not np.any(after(start)):
        return 0.0
    if size <= 4:
        return float(np.abs(np.linalg.eigvals([after(one.reshape(start.shape)).ravel() for one in np.eye(size)])).max())

    def step(packed: FloatArray) -> FloatArray:
        return after(packed.reshape(start.shape)).ravel()

    operator, begin = scipy.sparse.linalg.LinearOperator((size, size), matvec=step, dtype=float), start.ravel()
    try:
        values = scipy.sparse.linalg.eigs(operator, k=1, v0=begin, tol=1e-9, maxiter=1000, return_eigenvectors=False)
    except scipy.sparse.linalg.ArpackError:  # also where it does not converge
        return None
    return float(np.abs(values).max())
