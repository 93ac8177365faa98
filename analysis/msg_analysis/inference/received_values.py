# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What the agents received in the steps of a run, with noise or loss of messages, and in real time.

Given that, the residuals are normal and independent, with an exactly known covariance: process noise, by the graph that
each agent used, plus the link noise of the received messages. The rest is part of what was used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.statistics import add_sums
from msg_analysis.model.reception import neighbour_tables
from msg_analysis.model.step_model import StepModel, Wiring
from msg_analysis.theory.prediction import Prediction

NO_NOISE = 1e-13  # directions with a smaller eigenvalue of the correlations, relative to the largest: without noise
DIGITS = 100.0  # of the rounding of a state; an agent with less noise in a step cannot be told from one without
QUIET_ROUNDING = 1e-12  # of the terms of a step of an agent: what counts as rounding where there is no noise
HIDDEN = 10.0  # standard deviations of a noise that counts as none


@lru_cache(maxsize=4)
def neighbour_weights(step: StepModel) -> FloatArray:
    """(n, m, D): nominal weights of the neighbours' values; 0 beyond their number."""
    tables = neighbour_tables(step)
    there = np.arange(step.most_neighbours) < tables.count[:, :, None]
    return np.where(there, np.take_along_axis(step.nominal, tables.senders, axis=2), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedValues:
    """What was received in a block of b steps."""

    modes: IntArray  # (b,) graphs of the network
    graphs: IntArray  # (b, m) graphs that the agents used; in lockstep those of the network
    states: FloatArray  # (b, m, R) x
    published: FloatArray  # (N + 1, m, R) what the agents published, of all steps
    used: IntArray  # (b, m, D) step of the used value of the d-th neighbour; arbitrary where none arrived
    senders: IntArray  # (b, m, D) that neighbour
    weights: FloatArray  # (b, m, D) nominal weights of received values; 0 for others
    own: FloatArray  # (b, m) weight of an agent's own state, which also replaces values that did not arrive
    link_variance: FloatArray  # (b, m) of the link noise in what each agent received, unless it is partly known

    @classmethod
    def of(cls, observation: Observation, first: int, last: int) -> ReceivedValues:
        """Reception of the steps first..last-1."""
        step, modes, timers = observation.step, observation.modes[first:last], observation.timers
        if timers is None:
            graphs = np.repeat(modes[:, None], step.agents, axis=1)
            used = np.broadcast_to(np.arange(first, last)[:, None, None], (*graphs.shape, step.most_neighbours))
            if observation.used is not None:
                used = observation.used[first:last]
            elif observation.lost is not None:
                used = np.where(observation.lost[first:last], -1, used)
        else:
            graphs, used = timers.graphs[first:last], timers.used[first:last]
        published = observation.states if observation.published is None else observation.published
        return cls.by(step, modes, graphs, used, observation.states[first:last], published)

    @classmethod
    def by(
        cls,
        step: StepModel,
        modes: IntArray,
        graphs: IntArray,
        used: IntArray,
        states: FloatArray,
        published: FloatArray,
    ) -> ReceivedValues:
        """Reception by what was used (b, m, D), at places in ``published``, -1: the own value; the rest as above."""
        tables, agents = neighbour_tables(step), np.arange(step.agents)
        weights = neighbour_weights(step)[graphs, agents]
        weights = np.where(used >= 0, weights, 0.0)
        return cls(
            modes=modes,
            graphs=graphs,
            states=states,
            published=published,
            used=used,
            senders=tables.senders[graphs, agents],
            weights=weights,
            own=step.nominal.sum(axis=2)[graphs, agents] - weights.sum(axis=2),
            link_variance=step.link**2 * (weights**2).sum(axis=2),
        )

    def part(self, first: int, last: int) -> ReceivedValues:
        """Of the steps first..last-1 of the block."""
        names = [each.name for each in fields(self) if each.name != "published"]
        return replace(self, **{name: getattr(self, name)[first:last] for name in names})

    def received(self, at: IntArray, agents: IntArray, which: IntArray) -> FloatArray:
        """(k, a, R): what ``agents`` (a,) used of neighbours ``which`` (a,) in the steps ``at`` (k,) of the block."""
        index = at[:, None], agents, which
        return np.asarray(self.published[self.used[index], self.senders[index]])

    def mean(self, centre: FloatArray | float) -> FloatArray:
        """(b, m, R): the next states without noise and without the term of the reference, as if ``centre`` were 0."""
        total = self.own[:, :, None] * (self.states - centre)
        every, agents = np.arange(len(self.modes)), np.arange(self.states.shape[1])
        for d in np.flatnonzero(self.weights.any(axis=(0, 1))).tolist():
            received = self.received(every, agents, np.full(len(agents), d))
            total += self.weights[:, :, d, None] * (received - centre)
        return np.asarray(total)

    def size(self) -> FloatArray:
        """(b, m): largest sum, of all replicas, of the sizes of the terms of ``mean``."""
        total = np.abs(self.own)[:, :, None] * np.abs(self.states)
        every, agents = np.arange(len(self.modes)), np.arange(self.states.shape[1])
        for d in range(self.weights.shape[2]):
            received = self.received(every, agents, np.full(len(agents), d))
            total += np.abs(self.weights[:, :, d, None] * received)
        return np.asarray(total.max(axis=2))

    def allowed(self, deviations: FloatArray) -> FloatArray:
        """(b, m): largest residuals that rounding leaves, and noise of these deviations (b, m) that counts as none."""
        return QUIET_ROUNDING * self.size() + HIDDEN * deviations

    def patterns(self, order: IntArray | None = None) -> Iterator[tuple[IntArray, IntArray | None, IntArray]]:
        """Groups of like steps: graphs (m,) and order (m,) of the agents, by ``order`` (b, m), and steps (a,)."""
        m = self.graphs.shape[1]
        for pattern, at in _like_rows(self.graphs if order is None else np.column_stack([self.graphs, order])):
            yield pattern[:m], None if order is None else pattern[m:], at


def _like_rows(keys: AnyArray) -> Iterator[tuple[AnyArray, IntArray]]:
    """Each row that there is, and where, ascending."""
    found, owner = np.unique(keys, axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    order = np.argsort(owner, kind="stable")
    yield from zip(found, np.split(order, np.cumsum(np.bincount(owner))[:-1]), strict=True)


def mode_links(step: Wiring, mode: int) -> tuple[IntArray, IntArray, IntArray]:
    """Receiver, sender, and place among the receiver's neighbours, (links,) each, of a graph; sorted."""
    tables = neighbour_tables(step)
    receiver, which = np.nonzero(np.arange(step.most_neighbours) < tables.count[mode][:, None])
    return receiver, tables.senders[mode, receiver, which], which


def full_reception_noise(step: StepModel) -> FloatArray:
    """(n, m, m): covariance of the residuals of a step in which nothing is lost."""
    link = step.link**2 * (neighbour_weights(step) ** 2).sum(axis=2)
    process = step.noise_gain @ step.noise_gain.transpose(0, 2, 1)
    return np.asarray(process + link[:, :, None] * np.eye(step.agents))


def process_noise(step: StepModel, graphs: IntArray) -> FloatArray:
    """(m, m): covariance of the process noise of a step in which the agents use these graphs (m,)."""
    gain = step.noise_gain[graphs, np.arange(step.agents)]
    return np.asarray(gain @ gain.T)


def state_rounding(prediction: Prediction) -> float:
    """Half a unit in the last digit of the states: of the start, the reference, or what noise may have added."""
    experiment, step = prediction.experiment, prediction.step
    start = experiment.run.start
    given = 0.0 if isinstance(start, str) else float(np.abs(np.array(start, dtype=float)).max(initial=0.0))
    variance = float(np.diagonal(full_reception_noise(step), axis1=1, axis2=2).max(initial=0.0))
    return float(np.finfo(float).eps) * max(given, abs(step.reference), math.sqrt(experiment.steps * variance))


def without_digits(prediction: Prediction) -> IntArray:
    """Agents, from 0, with noise that is not large against the rounding of the states, in some graph."""
    variances = np.diagonal(full_reception_noise(prediction.step), axis1=1, axis2=2)
    floor = (DIGITS * state_rounding(prediction)) ** 2
    return np.flatnonzero(((variances > 0.0) & (variances <= floor)).any(axis=0))


def errors_have_digits(prediction: Prediction) -> bool:
    """Whether the noise of all agents together is large against the rounding of the states."""
    step, noise = prediction.step, full_reception_noise(prediction.step)
    heard = step.broadcast**2 * (neighbour_weights(step) ** 2).sum(axis=(1, 2))
    total = float(step.stationary @ (np.trace(noise, axis1=1, axis2=2) + heard))
    return not total or total > step.agents * (DIGITS * state_rounding(prediction)) ** 2


class Correlations:
    """A covariance (m, m) of residuals as its correlations: every agent has a scale of its own.

    Agents with a variance of ``floor`` or less count as without noise.
    """

    def __init__(self, covariance: FloatArray, floor: float) -> None:
        variances = np.diag(covariance)
        noisy = variances > floor
        # (m,) scale of every agent
        self.scale: FloatArray = np.sqrt(np.where(noisy, variances, floor or 1.0))
        matrix = np.where(np.outer(noisy, noisy), covariance, 0.0) / np.outer(self.scale, self.scale)
        if np.count_nonzero(matrix) == np.count_nonzero(noisy):
            self._values, self._vectors = np.ones(int(noisy.sum())), np.eye(len(noisy))[:, noisy]
        else:
            values, vectors = np.linalg.eigh(matrix)
            kept = (values > NO_NOISE * values[-1])[::-1]
            self._values, self._vectors = values[::-1][kept], vectors[:, ::-1][:, kept]
        self.rank = len(self._values)  # r
        # (m,) what noise that counts as none may do
        self._hidden = HIDDEN * np.where(noisy, NO_NOISE**0.5 * self.scale, np.sqrt(variances))

    def root(self) -> FloatArray:
        """(m, m): R with R R^T = the covariance."""
        return np.asarray(self.scale[:, None] * (self._vectors * self._values**0.5) @ self._vectors.T)

    def inverse(self) -> FloatArray:
        """(m, m): the pseudo-inverse of ``root``."""
        return np.asarray((self._vectors * self._values**-0.5) @ self._vectors.T / self.scale)

    def whitener(self) -> FloatArray:
        """(r, m): to independent N(0, 1), the directions with the most noise first."""
        return np.asarray((self._vectors / np.sqrt(self._values)).T / self.scale)

    def excess(self, residuals: FloatArray, sizes: FloatArray) -> float:
        """Largest part of residuals (b, m, R) without noise, over what rounding and hidden noise may leave.

        ``sizes``: (b, m) of the terms of the steps.
        """
        quiet = self.scale[:, None] * (np.eye(len(self.scale)) - self._vectors @ self._vectors.T) / self.scale
        allowed = QUIET_ROUNDING * sizes @ np.abs(quiet).T + self._hidden
        moved = np.abs(quiet @ residuals).max(axis=2)
        return float(np.divide(moved, allowed, out=np.where(moved > 0.0, np.inf, 0.0), where=allowed > 0.0).max())


class Equalizer:
    """Transforms residuals of steps with covariance N to that of a regular step, M (``full``): M^1/2 N^-1/2 e."""

    def __init__(self, step: StepModel, full: FloatArray, floor: float) -> None:
        self._step, self._floor = step, floor
        regular = [Correlations(matrix, floor) for matrix in full]
        self._roots = [(each.root(), each.rank) for each in regular]
        self._ranks = [rank for _, rank in self._roots]
        # False after a step whose N and M differ in rank (an agent without process noise received nothing): then only
        # the total size of all residuals can be tested.
        self.possible = True
        # Sum of e^T N^+ e, its degrees of freedom, and the largest of ``Correlations.excess``.
        self.chi2, self.dof, self.quiet = 0.0, 0, 0.0

    def equalize(self, residuals: FloatArray, reception: ReceivedValues) -> FloatArray:
        """(b, m, R): transformed residuals (b, m, R) of the steps of a block."""
        m = residuals.shape[1]
        keys = np.column_stack([reception.modes, reception.graphs, reception.link_variance])
        equal = np.empty_like(residuals)
        sizes: FloatArray | None = None
        for pattern, at in _like_rows(keys):
            mode, graphs, e = int(pattern[0]), pattern[1 : m + 1].astype(np.int64), residuals[at]
            noise = Correlations(process_noise(self._step, graphs) + np.diag(pattern[m + 1 :]), self._floor)
            white, rank = noise.inverse() @ e, noise.rank
            self.possible &= rank == self._ranks[mode]
            self.chi2 += float((white**2).sum())
            self.dof += rank * e.shape[0] * e.shape[2]
            if rank < m:
                sizes = reception.size() if sizes is None else sizes
                self.quiet = max(self.quiet, noise.excess(e, sizes[at]))
            equal[at] = self._roots[mode][0] @ white
        return equal

    def merge(self, other: Equalizer) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        add_sums(self, other, "chi2", "dof")
        self.possible, self.quiet = self.possible and other.possible, max(self.quiet, other.quiet)


NEVER = -2


class RepeatedNoise:
    """Frees the residuals, block after block, of what earlier ones say about the noise in them.

    The noise of a link belongs to the message: used again, because a newer one was lost or late, it is the same; with a
    delay d, that of x(0) is used in the steps 0..d. The noises of an agent's newest messages are a Gaussian vector, of
    which every step observes one combination, w^T noise + process noise: a Kalman filter. Exact for each agent; for all
    together where their process noise is independent.
    """

    def __init__(self, step: StepModel, replicas: int, *, realtime: bool) -> None:
        m = step.agents
        # From this step on, every message is used once.
        self.end = None if realtime or step.holds else step.delay + 1
        listens = step.listens()
        most = int(listens.sum(axis=1).max(initial=1)) or 1
        places = np.cumsum(listens, axis=1) - 1  # (m, m) place of a sender among all that an agent ever receives
        self._place = places[np.arange(m)[:, None], neighbour_tables(step).senders]  # (n, m, D)
        self._variance = step.link**2
        self._process = np.square(step.noise_gain).sum(axis=2)  # (n, m)
        self._message = np.full((m, most), NEVER, dtype=np.int64)
        self._mean, self._covariance = np.zeros((m, most, replicas)), np.zeros((m, most, most))

    @classmethod
    def of(cls, observation: Observation) -> RepeatedNoise | None:
        """None where there is no link noise, or no message is used again."""
        step, realtime = observation.step, observation.timers is not None
        if not step.link or not (realtime or step.holds or step.delay):
            return None
        return cls(step, observation.replicas, realtime=realtime)

    def free(self, first: int, residuals: FloatArray, reception: ReceivedValues) -> tuple[FloatArray, ReceivedValues]:
        """Residuals (b, m, R) of the next steps, from ``first`` on, less what is known of them.

        With them, the reception with the variance (b, m) of the link noise that is not known.
        """
        count = len(residuals) if self.end is None else min(max(self.end - first, 0), len(residuals))
        if not count:
            return residuals, reception
        found, variances = residuals.copy(), reception.link_variance.copy()
        agents = np.arange(residuals.shape[1])[:, None]
        places = self._place[reception.graphs, agents.T]  # (b, m, D)
        process = self._process[reception.graphs, agents.T]
        for k, e in enumerate(residuals[:count]):
            there = reception.weights[k] != 0.0
            self._renew(reception.used[k], places[k], there)
            weights = np.zeros(self._message.shape)
            np.add.at(
                weights, (np.broadcast_to(agents, there.shape)[there], places[k][there]), reception.weights[k][there]
            )
            across = (self._covariance @ weights[:, :, None])[:, :, 0]
            variances[k] = (weights * across).sum(axis=1)
            found[k] = e - (weights[:, None] @ self._mean)[:, 0]
            total = variances[k] + process[k]
            gain = np.divide(across, total[:, None], out=np.zeros_like(across), where=total[:, None] > 0.0)
            self._mean += gain[:, :, None] * found[k][:, None]
            self._covariance -= gain[:, :, None] * across[:, None]
        return found, replace(reception, link_variance=variances)

    def _renew(self, used: IntArray, places: IntArray, there: BoolArray) -> None:
        """Forget the noise of messages that newer ones have replaced."""
        agent, d = np.nonzero(there)
        place = places[agent, d]
        new = self._message[agent, place] != used[agent, d]
        agent, place = agent[new], place[new]
        self._message[agent, place] = used[agent, d[new]]
        self._mean[agent, place] = 0.0
        self._covariance[agent, place] = self._covariance[agent, :, place] = 0.0
        self._covariance[agent, place, place] = self._variance
