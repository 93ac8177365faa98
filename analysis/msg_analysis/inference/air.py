"""What happened on the air against what should have: the logged losses, and the noise in what was published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from msg_analysis.inference.gaussian import covariance_statistic
from msg_analysis.inference.measurement import Measurement
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.reception import mode_links
from msg_analysis.types import BoolArray, FloatArray, IntArray

MIN_EXPECTED = 25.0
"""Fewest losses, and messages that come, to be expected of what is tested by a chi-square law."""


@dataclass(frozen=True, slots=True)
class LossTest:
    """The logged losses against independent ones of a probability.

    Attributes
    ----------
    lost : messages
    expected : number of messages times the probability
    p : None where there was no message
    """

    lost: int
    expected: float
    p: float | None


def loss_test(observation: Observation | Measurement) -> LossTest | None:
    """Test that every message is lost with the same probability, whatever happens to others; None without loss.

    Given the graphs, the losses of each link are binomial, exactly. Added to the chi-squares of the links come those of
    the products of (lost - p) of successive messages of one link, and of pairs of messages in one step. What is too
    rare for a chi-square law is left out, links too rare for it are taken together; where these are too rare as
    well, their number is held against the binomial law itself.
    """
    probability = observation.step.loss
    if not probability or observation.lost is None:
        return None
    tally = _Tally(observation)
    for first, last in observation.blocks(4 * tally.links):
        tally.add(first, last)
    messages, lost = tally.messages, tally.lost
    if not messages.any():
        return LossTest(0, 0.0, None)
    rarer = min(probability, 1.0 - probability)
    often = messages * rarer >= MIN_EXPECTED
    chi2 = float(((lost - probability * messages)[often] ** 2 / messages[often]).sum() / tally.variance)
    dof = int(often.sum())
    rest, rest_lost = int(messages[~often].sum()), int(lost[~often].sum())
    if rest:
        p = float(stats.binomtest(rest_lost, rest, probability).pvalue)
        chi2, dof = chi2 + float(stats.chi2.isf(p, 1)), dof + 1
    for product, pairs in ((tally.successive, tally.successive_pairs), (tally.same_step, tally.same_step_pairs)):
        if pairs * rarer**2 >= MIN_EXPECTED:
            chi2, dof = chi2 + product**2 / (tally.variance**2 * pairs), dof + 1
    p = float(stats.chi2.sf(chi2, dof))
    return LossTest(int(lost.sum()), float(probability * messages.sum()), p)


class _Tally:
    """Sums over the messages of a run; xi = lost - p.

    Attributes
    ----------
    links : number of links that are in any graph
    variance : p (1 - p)
    messages, lost : (links,) messages of each, and how many of them were lost
    successive, successive_pairs : sum of xi xi' of successive messages of a link, and their number
    same_step, same_step_pairs : sum of xi xi' of pairs of messages in one step, and their number
    """

    def __init__(self, observation: Observation | Measurement) -> None:
        self._observation = observation
        step = observation.step
        numbers = np.cumsum(step.listens().ravel()).reshape(step.agents, step.agents) - 1
        self._graphs = []
        for mode in range(step.modes):
            receiver, sender, which = mode_links(step, mode)
            self._graphs.append((numbers[receiver, sender], receiver, which))
        self.links = int(step.listens().sum())
        self.variance = step.loss * (1.0 - step.loss)
        self.messages, self.lost = np.zeros(self.links, np.int64), np.zeros(self.links, np.int64)
        self.successive = self.same_step = 0.0
        self.successive_pairs = self.same_step_pairs = 0
        self._before = np.zeros((1, self.links), np.bool_), np.zeros((1, self.links))

    def add(self, first: int, last: int) -> None:
        """Take the steps first..last-1."""
        sent, xi = self._block(first, last)
        self.messages += sent.sum(axis=0)
        self.lost += (sent & (xi > 0.0)).sum(axis=0)
        in_step = sent.sum(axis=1)
        self.same_step += float((xi.sum(axis=1) ** 2 - (xi**2).sum(axis=1)).sum()) / 2
        self.same_step_pairs += int((in_step * (in_step - 1) // 2).sum())
        sent, xi = np.concatenate([self._before[0], sent]), np.concatenate([self._before[1], xi])
        self.successive += float((xi[1:] * xi[:-1]).sum())
        self.successive_pairs += int((sent[1:] & sent[:-1]).sum())
        self._before = sent[-1:], xi[-1:]

    def _block(self, first: int, last: int) -> tuple[BoolArray, FloatArray]:
        """(b, links): whether there was a message; and xi, 0 where there was none."""
        assert self._observation.lost is not None
        modes: IntArray = self._observation.modes[first:last]
        lost = self._observation.lost[first:last]
        sent, xi = np.zeros((len(modes), self.links), np.bool_), np.zeros((len(modes), self.links))
        for mode, (number, receiver, which) in enumerate(self._graphs):
            at = np.flatnonzero(modes == mode)[:, None]
            sent[at, number] = True
            xi[at, number] = lost[at, receiver, which] - self._observation.step.loss
        return sent, xi


def broadcast_p(observation: Observation) -> float | None:
    """p-value of what was published, less the states: N(0, s^2 I) of agents; None without broadcast noise."""
    deviation = observation.prediction.experiment.noise.broadcast
    if not deviation or observation.published is None:
        return None
    agents = observation.step.agents
    scatter = np.zeros((agents, agents))
    length = observation.steps + 1
    for first, last in [*observation.blocks(observation.states[0].size), (length - 1, length)]:
        noise = (observation.published[first:last] - observation.states[first:last]) / deviation
        flat = noise.transpose(1, 0, 2).reshape(agents, -1)
        scatter += flat @ flat.T
    statistic, dof = covariance_statistic(scatter, length * observation.replicas)
    return float(stats.chi2.sf(statistic, dof))
