# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Variance of the time mean of the system error over a run, before any run. Discrete time.

Given the path (graphs and losses), a stationary state is y ~ N(0, M), and replicas are independent. M obeys
m' = A_g m + n_g for the packed m, so X_i = E[m m^T; g = i] solves the equation that the second moments of y solve
(Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005), with m in place of y:

    X_j = sum_i P_ij (A_i X_i A_i^T + A_i c_i n_i^T + n_i c_i^T A_i^T + pi_i n_i n_i^T),    c_i = E[m; g = i]

It has all fourth moments of y, for E[(y^T S y)^2 | M] = tr(S M)^2 + 2 tr(S M S M).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver, mode_potential
from msg_analysis.theory.prediction import Prediction

MAX_WORK = 3e7  # n p^3 for p packed moments: up to it, M is followed along the path
MAX_ROUNDS = 300  # in which what losses add is found
ROUND_TOLERANCE = 1e-10
DIVERGED = 1e10
HEAVY = (
    "system error: its time mean has no finite variance, because fourth moments of the states do not exist; lower the "
    "weights, losses or run.dt, or look at the innovations only"
)


@dataclass(frozen=True, slots=True)
class MeanVariance:
    """N times the variance of the time mean over N steps, for large N: path + replica / R with R replicas."""

    path: float  # of graphs and losses, which replicas share
    replica: float  # of the noise, independent in every replica
    followed: bool  # whether M is followed along the path; else on its principal axes alone

    def of(self, replicas: float) -> float:
        """With so many replicas."""
        return self.path + self.replica / replicas


def mean_variance(prediction: Prediction, *, most_work: float = MAX_WORK) -> MeanVariance:
    """Asymptotic variance of the time mean of the system error, from its Poisson equation.

    The martingale difference of a step (docs/statistics.md, "Standard errors") has a part of the noise, of each loss
    and of the jump, which are uncorrelated. With the adjoint solutions Y and the potential kappa of the graphs, their
    means Z_i = sum_j P_ij Y_j, the surprises S_ij = Y_j - Z_i and s_ij alike for kappa, and M' = K_i[M] + N_i:

        noise:  2 tr(Z N Z (N + 2 K[M])) / R
        loss e: 4 (b^T M v)^2 + 4 ((b^T M b)(v^T M v) + (b^T M v)^2) / R,    b = W^T Z u
        jump:   sum_j P_ij ((tr(S M') + s)^2 + 2 tr(S M' S M') / R)

    Noise and jump are exact. Of a loss the first order is taken, which adds u v^T y to W y; noise on the air has its
    mean over the losses. In a large system (``most_work``) M is its mean given the graph; what following it changes is
    added for the principal axes of the stationary covariance. InputError: the variance is not finite.
    """
    system, solver, losses = prediction.system, prediction.solver, prediction.step.losses
    if not system.dimension:
        return MeanVariance(0.0, 0.0, True)
    # The largest dimension whose M is followed along the path, with so many graphs.
    largest = next(d for d in range(1, 1000) if system.modes * float(packed_symmetric.size(d + 1)) ** 3 > most_work)
    if system.dimension <= largest:
        return MeanVariance(*_variance(solver, prediction.steady, losses, follow=True), followed=True)
    rough = _variance(solver, prediction.steady, losses, follow=False)
    principal = MomentSolver(_principal(system, prediction.steady, largest))
    steady = principal.steady()
    exact, near = (_variance(principal, steady, losses, follow=follow) for follow in (True, False))
    path, replica = (max(a + b - c, 0.0) for a, b, c in zip(rough, exact, near, strict=True))
    return MeanVariance(path, replica, followed=False)


def _principal(system: JumpSystem, steady: FloatArray, rank: int) -> JumpSystem:
    """The system projected on so many principal axes of its stationary covariance."""
    axes = np.linalg.eigh(steady.sum(axis=0))[1][:, -rank:]
    return replace(
        system,
        matrices=axes.T @ system.matrices @ axes,
        noise=axes.T @ system.noise @ axes,
        lift=system.lift @ axes,
        readout=None if system.readout is None else system.readout @ axes,
        losses=system.losses and system.losses.projected(axes),
        unreduced=None,
        unreduced_losses=None,
        messages=None,
    )


def _variance(solver: MomentSolver, steady: FloatArray, links: FloatArray, *, follow: bool) -> tuple[float, float]:
    """Due to the path, and to the noise of one replica; ``links`` (m, m): probabilities of losses."""
    system = solver.system
    values = solver.dual((system.output.T @ system.output)[None])  # (1, n, d, d)
    kappa = mode_potential(system, values)[1][0]
    values = values[0]
    means, levels = np.einsum("ij,jab->iab", system.chain, values), system.chain @ kappa
    moved = system.propagate(steady)
    losses = [_losses(system, links, i) for i in range(system.modes)]
    law = system.stationary
    before: _Followed | _Averaged = _Averaged(steady, law)
    after: _Followed | _Averaged = _Averaged(moved + law[:, None, None] * system.noise, law)
    if follow:
        before, after = _moments_of_path(system, moved, losses)
    path = replica = 0.0
    for i, share in enumerate(system.stationary.tolist()):
        mean, noise = means[i], system.noise[i]
        seen = mean @ noise
        replica += 2.0 * float(np.trace(seen @ seen) * share + 2.0 * np.trace(seen @ mean @ moved[i]))
        for loss in losses[i]:
            felt = system.matrices[i].T @ mean @ loss.into
            cross = _symmetric(felt, loss.difference)
            own, seen_alone = _symmetric(felt, felt), _symmetric(loss.difference, loss.difference)
            both = before.product(i, cross, cross)
            path += 4.0 * both
            replica += 4.0 * (before.product(i, own, seen_alone) + both)
        reached = moved[i] + share * noise
        for j in np.flatnonzero(system.chain[i]).tolist():
            surprise, level = values[j] - mean, float(kappa[j] - levels[i])
            probability = float(system.chain[i, j])
            linear = 2.0 * level * float((surprise * reached).sum()) + level**2 * share
            path += probability * (after.product(i, surprise, surprise) + linear)
            replica += probability * 2.0 * after.quartic(i, surprise)
    return max(path, 0.0), max(replica, 0.0)


def _symmetric(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((np.outer(a, b) + np.outer(b, a)) / 2.0)


@dataclass(frozen=True, slots=True)
class _Loss:
    """A loss that adds xi u v^T y to W y; xi has mean 0 and variance 1."""

    into: FloatArray  # (d,) u
    difference: FloatArray  # (d,) v
    probability: float | None  # of being lost; None: not known here


def _losses(system: JumpSystem, losses: FloatArray, mode: int) -> list[_Loss]:
    """Those under a graph; ``losses`` (m, m) are the probabilities of the links."""
    if system.losses is not None:
        pairs = zip(system.losses.into[mode], system.losses.differences[mode], strict=True)
        return [_Loss(into, difference, None) for into, difference in pairs if into.any()]
    if system.loss_variance is None:
        return []
    variance, m = system.loss_variance[mode], len(losses)
    return [
        _Loss(np.sqrt(variance[i, j]) * system.lift[i], system.lift[i] - system.lift[j], float(losses[i, j % m]))
        for i, j in np.argwhere(variance > 0.0).tolist()
    ]


class _LossSpread:
    """What losses under a graph add to A X A^T: E[(A' - A) X (A' - A)^T] for the random A' with them.

    With W' = W + sum_e xi_e u_e v_e^T this is a sum over losses and pairs of losses, exactly; the first order in xi
    where their probabilities are not known, or they are many.
    """

    def __init__(self, step: FloatArray, losses: list[_Loss]) -> None:
        effects = [np.outer(loss.into, loss.difference) for loss in losses]
        self._first = [2.0 * packed_symmetric.product(step, effect) for effect in effects]
        self._second: list[tuple[FloatArray, float, float]] = []  # map, and moments 3 and 4 - 1 of xi
        self._pairs: list[FloatArray] = []
        size = float(packed_symmetric.size(len(step)))
        if len(losses) ** 2 * size**3 > MAX_WORK:
            return
        for loss, effect in zip(losses, effects, strict=True):
            if loss.probability is None:
                return
            variance = loss.probability * (1.0 - loss.probability)
            skewness, excess = (1.0 - 2.0 * loss.probability) / np.sqrt(variance), (1.0 - 4.0 * variance) / variance
            self._second.append((packed_symmetric.product(effect, effect), float(skewness), float(excess)))
        for a, left in enumerate(effects):
            self._pairs += [2.0 * packed_symmetric.product(left, right) for right in effects[:a]]

    def of(self, moments: FloatArray) -> FloatArray:
        """(p, p) of X (p, p)."""
        total = np.zeros_like(moments)
        for first in self._first:
            total += first @ moments @ first.T
        for first, (second, skewness, excess) in zip(self._first, self._second, strict=False):
            mixed = skewness * (first @ moments @ second.T)
            total += mixed + mixed.T + excess * (second @ moments @ second.T)
        for pair in self._pairs:
            total += pair @ moments @ pair.T
        return total


class _Followed:
    """Second moments of M given the graph i, times pi_i: X of ``m`` along the path."""

    def __init__(self, moments: FloatArray) -> None:
        self._moments = moments  # (n, p, p)

    def product(self, mode: int, left: FloatArray, right: FloatArray) -> float:
        """E[tr(A M) tr(B M); i] of symmetric A and B."""
        return float(packed_symmetric.pack(left) @ self._moments[mode] @ packed_symmetric.pack(right))

    def quartic(self, mode: int, form: FloatArray) -> float:
        """E[tr(S M S M); i] of a symmetric S."""
        return float((packed_symmetric.product(form, form) * self._moments[mode]).sum())


class _Averaged:
    """The same where M is its mean given the graph."""

    def __init__(self, moments: FloatArray, law: FloatArray) -> None:
        self._moments, self._law = moments, law  # (n, d, d), (n,)

    def product(self, mode: int, left: FloatArray, right: FloatArray) -> float:
        moments = self._moments[mode]
        return float((left * moments).sum() * (right * moments).sum() / self._law[mode])

    def quartic(self, mode: int, form: FloatArray) -> float:
        seen = form @ self._moments[mode]
        return float((seen * seen.T).sum() / self._law[mode])


def _moments_of_path(system: JumpSystem, moved: FloatArray, losses: list[list[_Loss]]) -> tuple[_Followed, _Followed]:
    """Of M before the step, and after it, before the jump."""
    law = system.stationary[:, None, None]
    n, p = system.modes, packed_symmetric.size(system.dimension)
    basis = packed_symmetric.unpack(np.eye(p), system.dimension)[:, None]  # (p, 1, d, d)
    images = packed_symmetric.pack(system.propagate(np.broadcast_to(basis, (p, n, *basis.shape[2:]))))
    maps = np.ascontiguousarray(images.transpose(1, 2, 0))  # (n, p, p) A
    noise = packed_symmetric.pack(system.noise)  # (n, p)
    cross = packed_symmetric.pack(moved)[:, :, None] * noise[:, None, :]
    added = cross + cross.transpose(0, 2, 1) + law * noise[:, :, None] * noise[:, None, :]
    pairs = zip(system.matrices, losses, strict=True) if system.lossy else ()
    spreads = [_LossSpread(step, some) for step, some in pairs]
    moments, spread = np.zeros_like(added), np.zeros_like(added)
    for _ in range(MAX_ROUNDS):
        twice = JumpSystem(
            time="discrete",
            matrices=maps,
            noise=(added + spread) / law,
            chain=system.chain,
            stationary=system.stationary,
            lift=np.eye(p),
        )
        try:
            moments = MomentSolver(twice, guess=moments if spreads else None).steady()
        except InputError as error:
            raise InputError(HEAVY) from error
        if not spreads:
            break
        before, spread = spread, np.stack([each.of(one) for each, one in zip(spreads, moments, strict=True)])
        if np.abs(spread - before).max() <= ROUND_TOLERANCE * np.abs(added + spread).max():
            break
        if not np.abs(spread).max() < DIVERGED * np.abs(added).max():
            raise InputError(HEAVY)
    else:
        raise InputError(HEAVY)
    return _Followed(moments), _Followed(maps @ moments @ maps.transpose(0, 2, 1) + added + spread)
