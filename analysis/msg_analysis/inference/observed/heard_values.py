"""What the agents heard in the steps of a run: where something becomes of values on the air, and in real time.

From the log follows, for every step, what each agent used: which values of its neighbours, and in real time of which
step they were and under which graph. Given that, the innovations are normal and independent, with a covariance that is
known exactly: process noise, by the graph that each agent used, plus the link noise of the messages that came.
Broadcast noise, losses and delays are in what was used; they are tested, or reported, by themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import stats

from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.step_model import StepModel, Wiring
from msg_analysis.types import FloatArray, IntArray

NO_NOISE = 1e-13
"""Directions with less variance than this, relative to the noisiest one, count as free of noise."""


@lru_cache(maxsize=4)
def neighbour_weights(step: StepModel) -> FloatArray:
    """(n, m, D): nominal weights of the neighbours' values; 0 beyond their number.

    Parameters
    ----------
    step
        compiled experiment
    """
    tables = neighbour_tables(step)
    there = np.arange(step.most_neighbours) < tables.count[:, :, None]
    return np.where(there, np.take_along_axis(step.nominal, tables.senders, axis=2), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Reception:
    """What was heard in a block of b steps.

    Attributes
    ----------
    modes
        (b,) graphs of the network
    graphs
        (b, m) graphs that the agents used; in lockstep those of the network
    states
        (b, m, R) x
    published
        (N + 1, m, R) what the agents published, of all steps
    used
        (b, m, D) step of the value of the d-th neighbour that was used; any where none came
    senders
        (b, m, D) who that neighbour is
    weights
        (b, m, D) nominal weights of what came; 0 for others
    own
        (b, m) weight of an agent's own state, which stands for what did not come too
    link_variance
        (b, m) of the link noise in what each agent heard
    """

    modes: IntArray
    graphs: IntArray
    states: FloatArray
    published: FloatArray
    used: IntArray
    senders: IntArray
    weights: FloatArray
    own: FloatArray
    link_variance: FloatArray

    @classmethod
    def of(cls, observation: Observation, first: int, last: int) -> Reception:
        """Of the steps first..last-1.

        Parameters
        ----------
        observation
            of a run whose log says what was heard
        first
            step
        last
            step behind the last one
        """
        step, modes, timers = observation.step, observation.modes[first:last], observation.timers
        tables, agents = neighbour_tables(step), np.arange(step.agents)
        if timers is None:
            graphs = np.repeat(modes[:, None], step.agents, axis=1)
            used = np.broadcast_to(np.arange(first, last)[:, None, None], (*graphs.shape, step.most_neighbours))
        else:
            graphs, used = timers.graphs[first:last], timers.used[first:last]
        weights = neighbour_weights(step)[graphs, agents]
        if observation.lost is not None:
            weights = np.where(observation.lost[first:last], 0.0, weights)
        weights = np.where(used >= 0, weights, 0.0)
        published = observation.states if observation.published is None else observation.published
        return cls(
            modes=modes,
            graphs=graphs,
            states=observation.states[first:last],
            published=published,
            used=used,
            senders=tables.senders[graphs, agents],
            weights=weights,
            own=step.nominal.sum(axis=2)[graphs, agents] - weights.sum(axis=2),
            link_variance=observation.prediction.experiment.noise.link**2 * (weights**2).sum(axis=2),
        )

    def heard(self, at: IntArray, agents: IntArray, which: IntArray) -> FloatArray:
        """(len(at), a, R): in some steps of the block, what these agents (a,) used for these neighbours (a,).

        Parameters
        ----------
        at
            (k,) steps, counted from the first of the block
        agents
            (a,) receivers, from 0
        which
            (a,) places of the senders among their neighbours
        """
        index = at[:, None], agents, which
        return np.asarray(self.published[self.used[index], self.senders[index]])

    def mean(self) -> FloatArray:
        """(b, m, R): what these steps lead to without noise and without what the reference adds."""
        total = self.own[:, :, None] * self.states
        every, agents = np.arange(len(self.modes)), np.arange(self.states.shape[1])
        for d in range(self.weights.shape[2]):
            total += self.weights[:, :, d, None] * self.heard(every, agents, np.full(len(agents), d))
        return np.asarray(total)

    def patterns(self, order: IntArray | None = None) -> Iterator[tuple[IntArray, IntArray | None, IntArray]]:
        """Steps of the block that are alike: (graphs (m,) of the agents, their order (m,) if it counts, steps (a,)).

        Parameters
        ----------
        order
            (b, m) agents of each step, first to last
        """
        if order is None and (self.graphs == self.modes[:, None]).all():
            for mode in np.unique(self.modes):
                at = np.flatnonzero(self.modes == mode)
                yield self.graphs[at[0]], None, at
            return
        keys = self.graphs if order is None else np.column_stack([self.graphs, order])
        found, owner = np.unique(keys, axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        steps = np.argsort(owner, kind="stable")
        ends = np.searchsorted(owner[steps], np.arange(len(found) + 1))
        m = self.graphs.shape[1]
        for number, pattern in enumerate(found):
            at = steps[ends[number] : ends[number + 1]]
            yield pattern[:m], None if order is None else pattern[m:], at


def mode_links(step: Wiring, mode: int) -> tuple[IntArray, IntArray, IntArray]:
    """Receiver, sender, and place of the sender among the receiver's neighbours, of every link of a graph.

    Parameters
    ----------
    step
        wiring
    mode
        graph, from 0

    Returns
    -------
    tuple[IntArray, IntArray, IntArray]
        (links,) each, by receiver and then by sender
    """
    tables = neighbour_tables(step)
    receiver, which = np.nonzero(np.arange(step.most_neighbours) < tables.count[mode][:, None])
    return receiver, tables.senders[mode, receiver, which], which


def full_reception_noise(observation: Observation) -> FloatArray:
    """(n, m, m): covariance of the innovations of a step in which nothing is lost.

    Parameters
    ----------
    observation
        of a run
    """
    step = observation.step
    link = observation.prediction.experiment.noise.link**2 * (neighbour_weights(step) ** 2).sum(axis=2)
    process = step.noise_gain @ step.noise_gain.transpose(0, 2, 1)
    return np.asarray(process + link[:, :, None] * np.eye(step.agents))


def process_noise(step: StepModel, graphs: IntArray) -> FloatArray:
    """(m, m): covariance of the process noise of a step in which the agents use these graphs (m,).

    Parameters
    ----------
    step
        compiled experiment
    graphs
        (m,) that the agents use, from 0
    """
    gain = step.noise_gain[graphs, np.arange(step.agents)]
    return np.asarray(gain @ gain.T)


class Equalizer:
    """Innovations of steps of unequal covariance, brought to that of steps in which all is as it should be.

    With N the covariance of a step and M that of a step of the network's graph in which all messages came and everybody
    knew the graph, M^1/2 N^-1/2 e has the covariance M. Where a step has not as many directions with noise as M (an
    agent without process noise has heard nobody), it cannot be brought there: then only the total size of all
    innovations is left to test.

    Parameters
    ----------
    step
        compiled experiment
    full
        (n, m, m) of ``full_reception_noise``

    Attributes
    ----------
    possible
        whether every step so far could be brought there
    chi2, dof
        sum of e^T N^+ e, and how many numbers have gone into it
    quiet
        largest innovation in directions without noise
    """

    def __init__(self, step: StepModel, full: FloatArray) -> None:
        self._step = step
        self._roots = [_root(matrix, 0.5) for matrix in full]
        self._ranks = [rank for _, rank in self._roots]
        self.possible = True
        self.chi2, self.dof, self.quiet = 0.0, 0, 0.0

    def equalize(self, innovations: FloatArray, reception: Reception) -> FloatArray:
        """(b, m, R) of (b, m, R).

        Parameters
        ----------
        innovations
            (b, m, R) of the steps of a block
        reception
            of the same block
        """
        m = innovations.shape[1]
        keys = np.column_stack([reception.modes, reception.graphs, reception.link_variance])
        patterns, owner = np.unique(keys, axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        equal = np.empty_like(innovations)
        order = np.argsort(owner, kind="stable")
        ends = np.searchsorted(owner[order], np.arange(len(patterns) + 1))
        for number, pattern in enumerate(patterns):
            at = order[ends[number] : ends[number + 1]]
            mode, graphs, e = int(pattern[0]), pattern[1 : m + 1].astype(np.int64), innovations[at]
            inverse, rank = _root(process_noise(self._step, graphs) + np.diag(pattern[m + 1 :]), -0.5)
            white = inverse @ e
            self.possible &= rank == self._ranks[mode]
            self.chi2 += float((white**2).sum())
            self.dof += rank * e.shape[0] * e.shape[2]
            if rank < len(inverse):
                projector = inverse @ np.linalg.pinv(inverse, hermitian=True)
                self.quiet = max(self.quiet, float(np.abs(e - projector @ e).max()))
            equal[at] = self._roots[mode][0] @ white
        return equal

    def merge(self, other: Equalizer) -> None:
        """Take what another one has of another run of the same experiment.

        Parameters
        ----------
        other
            of another run, with another seed
        """
        self.possible &= other.possible
        self.chi2, self.dof, self.quiet = self.chi2 + other.chi2, self.dof + other.dof, max(self.quiet, other.quiet)

    def p_size(self) -> float | None:
        """Two-sided p-value of the total size of all innovations; None without noise."""
        if not self.dof:
            return None
        law = stats.chi2(self.dof)
        return float(min(1.0, 2.0 * min(law.sf(self.chi2), law.cdf(self.chi2))))


def _root(matrix: FloatArray, power: float) -> tuple[FloatArray, int]:
    """Symmetric power of a covariance on its noisy directions, and how many these are."""
    if not (matrix - np.diag(np.diag(matrix))).any():
        variances = np.diag(matrix)
        noisy = variances > NO_NOISE * variances.max()
        return np.diag(np.where(noisy, variances, 1.0) ** power * noisy), int(noisy.sum())
    values, vectors = np.linalg.eigh(matrix)
    noisy = values > NO_NOISE * values[-1]
    return (vectors[:, noisy] * values[noisy] ** power) @ vectors[:, noisy].T, int(noisy.sum())
