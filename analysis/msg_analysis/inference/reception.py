"""What the agents heard in the steps of a run, where something becomes of values on the air.

From what was published and which messages were lost follows, for every step, what each agent used. Given that, the
innovations are normal and independent, with a covariance that is known exactly: process noise plus the link noise of
the messages that came. Broadcast noise and losses are in what was used; they are tested by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from msg_analysis.inference.observation import Observation
from msg_analysis.model.step import StepModel, Wiring
from msg_analysis.types import FloatArray, IntArray

NO_NOISE = 1e-13
"""Directions with less variance than this, relative to the noisiest one, count as free of noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Reception:
    """What was heard in a block of b steps.

    Attributes
    ----------
    modes : (b,) graphs
    states : (b, m, R) x
    values : (b, m, R) what the agents published
    weights : (b, m, m) nominal weights of the messages that came; 0 for others, and on the diagonal
    own : (b, m) weight of an agent's own state, which stands for the messages that were lost too
    link_variance : (b, m) of the link noise in what each agent heard
    """

    modes: IntArray
    states: FloatArray
    values: FloatArray
    weights: FloatArray
    own: FloatArray
    link_variance: FloatArray

    @classmethod
    def of(cls, observation: Observation, first: int, last: int) -> Reception:
        """Of the steps first..last-1."""
        step, modes = observation.step, observation.modes[first:last]
        coupling = step.nominal * ~np.eye(step.agents, dtype=bool)
        weights = coupling[modes]
        if observation.lost is not None:
            lost = observation.lost[first:last]
            for mode in range(step.modes):
                at = np.flatnonzero(modes == mode)
                receiver, sender, which = mode_links(step, mode)
                weights[at[:, None], receiver, sender] *= ~lost[at[:, None], receiver, which]
        published = observation.states if observation.published is None else observation.published
        return cls(
            modes=modes,
            states=observation.states[first:last],
            values=published[first:last],
            weights=weights,
            own=step.nominal.sum(axis=2)[modes] - weights.sum(axis=2),
            link_variance=observation.prediction.experiment.noise.link**2 * (weights**2).sum(axis=2),
        )

    def mean(self) -> FloatArray:
        """(b, m, R): what these steps lead to without noise and without what the reference adds."""
        return np.asarray(self.own[:, :, None] * self.states + self.weights @ self.values)


def mode_links(step: Wiring, mode: int) -> tuple[IntArray, IntArray, IntArray]:
    """Receiver, sender, and place of the sender among the receiver's neighbours, of every link of a graph."""
    links = [(i, j, d) for i in range(step.agents) for d, j in enumerate(step.neighbours(mode, i).tolist())]
    receiver, sender, which = np.array(links, dtype=np.int64).reshape(-1, 3).T
    return receiver, sender, which


def full_reception_noise(observation: Observation) -> FloatArray:
    """(n, m, m): covariance of the innovations of a step in which nothing is lost."""
    step = observation.step
    coupling = step.nominal * ~np.eye(step.agents, dtype=bool)
    link = observation.prediction.experiment.noise.link**2 * (coupling**2).sum(axis=2)
    return np.asarray(process_noise(step) + link[:, :, None] * np.eye(step.agents))


def process_noise(step: StepModel) -> FloatArray:
    """(n, m, m): covariance of the process noise of a step."""
    return np.asarray(step.noise_gain @ step.noise_gain.transpose(0, 2, 1))


class Equalizer:
    """Innovations of steps in which link noise is lost, brought to the covariance of those in which nothing is.

    With N the covariance of a step and M that of a step with the same graph in which all messages came, M^1/2 N^-1/2 e
    has the covariance M. Where a step has less directions with noise than M (an agent without process noise has heard
    nobody), it cannot be brought there: then only the total size of all innovations is left to test.

    Attributes
    ----------
    possible : whether every step so far could be brought there
    chi2, dof : sum of e^T N^+ e, and how many numbers have gone into it
    quiet : largest innovation in directions without noise
    """

    def __init__(self, process: FloatArray, full: FloatArray) -> None:
        self._process = process
        self._roots = [_root(matrix, 0.5) for matrix in full]
        self._ranks = [rank for _, rank in self._roots]
        self.possible = True
        self.chi2, self.dof, self.quiet = 0.0, 0, 0.0

    def equalize(self, innovations: FloatArray, modes: IntArray, link_variance: FloatArray) -> FloatArray:
        """(b, m, R) of (b, m, R), with graphs (b,) and variances (b, m) of the link noise."""
        patterns, owner = np.unique(np.column_stack([modes, link_variance]), axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        equal = np.empty_like(innovations)
        order = np.argsort(owner, kind="stable")
        ends = np.searchsorted(owner[order], np.arange(len(patterns) + 1))
        for number, pattern in enumerate(patterns):
            at = order[ends[number] : ends[number + 1]]
            mode, e = int(pattern[0]), innovations[at]
            inverse, rank = _root(self._process[mode] + np.diag(pattern[1:]), -0.5)
            white = inverse @ e
            self.possible &= rank == self._ranks[mode]
            self.chi2 += float((white**2).sum())
            self.dof += rank * e.shape[0] * e.shape[2]
            if rank < len(inverse):
                projector = inverse @ np.linalg.pinv(inverse, hermitian=True)
                self.quiet = max(self.quiet, float(np.abs(e - projector @ e).max()))
            equal[at] = self._roots[mode][0] @ white
        return equal

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


class HeardRegression:
    """Score test: innovations do not depend on what the agents heard, with the weights it was used with.

    As without noise on the air, see ``innovations``; but the differences that row i uses are y_j - x_i of the messages
    that came, with y_j as published, and the covariance of the innovations is that of each step.
    """

    def __init__(self, observation: Observation, most: int) -> None:
        step = observation.step
        self._step, self._process = step, process_noise(step)
        self._replicas = observation.replicas
        n, m = step.modes, step.agents
        # What is added to a state by itself: the leaders' own pull.
        self._pull = step.nominal.sum(axis=2) - 1.0
        leaders = [np.flatnonzero(np.abs(pull) > 1e-12) for pull in self._pull]
        links = [mode_links(step, mode)[:2] for mode in range(n)]
        count = m + sum(len(receiver) for receiver, _ in links) + sum(map(len, leaders))
        self._each = count <= most
        self._by_graph = n * m + m <= most
        if self._each:
            rows = [np.concatenate([links[g][0], leaders[g]]) for g in range(n)]
            senders = [np.concatenate([links[g][1], leaders[g]]) for g in range(n)]
        else:
            rows = senders = [np.arange(m)] * (n if self._by_graph else 1)
        starts = np.cumsum([m, *map(len, rows)])
        groups = range(n) if self._each or self._by_graph else [0] * n
        #: For each graph: places of its regressors, their rows, and (each) whose value they compare with
        self._places = [np.concatenate([np.arange(m), np.arange(starts[g], starts[g + 1])]) for g in groups]
        self._rows = [np.concatenate([np.arange(m), rows[g]]) for g in groups]
        self._senders = [senders[g] for g in groups]
        self._score, self._covariance = np.zeros(starts[-1]), np.zeros((starts[-1], starts[-1]))

    @property
    def numbers_per_step(self) -> int:
        """Size of the largest temporary array: regressors, or the weights of all messages."""
        return max(max(map(len, self._rows)) * self._replicas, self._step.agents**2)

    def statistic(self) -> tuple[FloatArray, FloatArray]:
        """Scores (K,) and their covariance (K, K)."""
        return self._score, self._covariance

    def add(self, reception: Reception, innovations: FloatArray) -> None:
        """Take a block of steps with their innovations (b, m, R)."""
        for mode in range(self._step.modes):
            at = np.flatnonzero(reception.modes == mode)
            if not at.size:
                continue
            places, rows, e = self._places[mode], self._rows[mode], innovations[at]
            phi = self._regressors(reception, at, mode)
            self._score[places] += np.einsum("kar,kar->a", e[:, rows], phi)
            block = np.ix_(places, places)
            flat = phi.transpose(1, 0, 2).reshape(len(rows), -1)
            self._covariance[block] += self._process[mode][np.ix_(rows, rows)] * (flat @ flat.T)
            if reception.link_variance.any():
                phi = phi * np.sqrt(reception.link_variance[at])[:, rows, None]
                flat = phi.transpose(1, 0, 2).reshape(len(rows), -1)
                self._covariance[block] += (rows[:, None] == rows) * (flat @ flat.T)

    def _regressors(self, reception: Reception, at: IntArray, mode: int) -> FloatArray:
        """(len(at), a, R): constants of all agents, then what their rows use."""
        m, rows, senders = self._step.agents, self._rows[mode], self._senders[mode]
        x, y = reception.states[at], reception.values[at]
        deviation = x - self._step.reference
        phi = np.ones((len(at), len(rows), x.shape[2]))
        if self._each:
            receivers = rows[m:]
            came = reception.weights[at][:, receivers, senders] != 0.0
            differences = (y[:, senders] - x[:, receivers]) * came[:, :, None]
            phi[:, m:] = np.where((receivers == senders)[:, None], deviation[:, receivers], differences)
        else:
            weights = reception.weights[at]
            pulled = weights @ y - weights.sum(axis=2)[:, :, None] * x
            phi[:, m:] = pulled + self._pull[mode][:, None] * deviation
        return phi
