"""What happened on the air against what should have: the logged losses, and the noise in what was published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from msg_analysis.inference.observed.heard_values import mode_links
from msg_analysis.inference.observed.measurement import Measurement
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.statistics.covariance_test import covariance_statistic
from msg_analysis.types import BoolArray, FloatArray, IntArray

MIN_EXPECTED = 25.0
"""Fewest losses, and messages that come, to be expected of what is tested by a chi-square law."""


@dataclass(frozen=True, slots=True)
class LossTest:
    """The logged losses against independent ones of a probability.

    Attributes
    ----------
    lost
        messages
    expected
        number of messages times the probability
    p
        None where there was no message
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

    Parameters
    ----------
    observation
        of a run with ``noise.loss``, or without
    """
    tally = LossTally.of(observation)
    return tally.test() if tally else None


class LossTally:
    """Sums over the messages of a run; xi = lost - p.

    Parameters
    ----------
    observation
        of a run with ``noise.loss``

    Attributes
    ----------
    probability
        p
    pairs
        (links, 2) receiver and sender of every link that is in any graph
    messages, lost
        (links,) messages of each, and how many of them were lost
    successive, successive_pairs
        sum of xi xi' of successive messages of a link, and their number
    same_step, same_step_pairs
        sum of xi xi' of pairs of messages in one step, and their number
    """

    def __init__(self, observation: Observation | Measurement) -> None:
        step = observation.step
        self.probability = step.loss
        self.pairs: IntArray = np.argwhere(step.listens())
        links = len(self.pairs)
        self.messages, self.lost = np.zeros(links, np.int64), np.zeros(links, np.int64)
        self.successive = self.same_step = 0.0
        self.successive_pairs = self.same_step_pairs = 0
        numbers = np.cumsum(step.listens().ravel()).reshape(step.agents, step.agents) - 1
        graphs = []
        for mode in range(step.modes):
            receiver, sender, which = mode_links(step, mode)
            graphs.append((numbers[receiver, sender], receiver, which))
        before = np.zeros((1, links), np.bool_), np.zeros((1, links))
        for first, last in observation.blocks(4 * links):
            before = self._add(*_block(observation, graphs, links, first, last), before)

    @classmethod
    def of(cls, observation: Observation | Measurement) -> LossTally | None:
        """Of a run; None where no message can be lost, or none was logged.

        Parameters
        ----------
        observation
            of any run
        """
        return cls(observation) if observation.step.loss and observation.lost is not None else None

    def merge(self, other: LossTally) -> None:
        """Take what another run of the same experiment adds up to.

        Parameters
        ----------
        other
            of another run, with another seed
        """
        self.messages += other.messages
        self.lost += other.lost
        self.successive, self.same_step = self.successive + other.successive, self.same_step + other.same_step
        self.successive_pairs += other.successive_pairs
        self.same_step_pairs += other.same_step_pairs

    def test(self) -> LossTest:
        """See ``loss_test``."""
        probability, messages, lost = self.probability, self.messages, self.lost
        if not messages.any():
            return LossTest(0, 0.0, None)
        variance = probability * (1.0 - probability)
        rarer = min(probability, 1.0 - probability)
        often = messages * rarer >= MIN_EXPECTED
        chi2 = float(((lost - probability * messages)[often] ** 2 / messages[often]).sum() / variance)
        dof = int(often.sum())
        rest, rest_lost = int(messages[~often].sum()), int(lost[~often].sum())
        if rest:
            p = float(stats.binomtest(rest_lost, rest, probability).pvalue)
            chi2, dof = chi2 + float(stats.chi2.isf(p, 1)), dof + 1
        for product, pairs in ((self.successive, self.successive_pairs), (self.same_step, self.same_step_pairs)):
            if pairs * rarer**2 >= MIN_EXPECTED:
                chi2, dof = chi2 + product**2 / (variance**2 * pairs), dof + 1
        p = float(stats.chi2.sf(chi2, dof))
        return LossTest(int(lost.sum()), float(probability * messages.sum()), p)

    def _add(
        self, sent: BoolArray, xi: FloatArray, before: tuple[BoolArray, FloatArray]
    ) -> tuple[BoolArray, FloatArray]:
        """Take a block of steps, and the last step before it; the last step of the block."""
        self.messages += sent.sum(axis=0)
        self.lost += (sent & (xi > 0.0)).sum(axis=0)
        in_step = sent.sum(axis=1)
        self.same_step += float((xi.sum(axis=1) ** 2 - (xi**2).sum(axis=1)).sum()) / 2
        self.same_step_pairs += int((in_step * (in_step - 1) // 2).sum())
        sent, xi = np.concatenate([before[0], sent]), np.concatenate([before[1], xi])
        self.successive += float((xi[1:] * xi[:-1]).sum())
        self.successive_pairs += int((sent[1:] & sent[:-1]).sum())
        return sent[-1:], xi[-1:]


def _block(
    observation: Observation | Measurement,
    graphs: list[tuple[IntArray, IntArray, IntArray]],
    links: int,
    first: int,
    last: int,
) -> tuple[BoolArray, FloatArray]:
    """(b, links) of the steps first..last-1: whether there was a message; and xi, 0 where there was none."""
    assert observation.lost is not None
    modes, lost = observation.modes[first:last], observation.lost[first:last]
    sent, xi = np.zeros((len(modes), links), np.bool_), np.zeros((len(modes), links))
    for mode, (number, receiver, which) in enumerate(graphs):
        at = np.flatnonzero(modes == mode)[:, None]
        sent[at, number] = True
        xi[at, number] = lost[at, receiver, which] - observation.step.loss
    return sent, xi


class BroadcastSums:
    """What the noise in what was published adds up to, in units of what it should be.

    Parameters
    ----------
    observation
        of a run with ``noise.broadcast``

    Attributes
    ----------
    scatter
        (m, m) sum of the products of the agents' noise
    samples
        number of published values, replicas counted
    """

    def __init__(self, observation: Observation) -> None:
        assert observation.published is not None
        deviation = observation.prediction.experiment.noise.broadcast
        agents = observation.step.agents
        self.scatter = np.zeros((agents, agents))
        length = observation.steps + 1
        self.samples = length * observation.replicas
        for first, last in [*observation.blocks(observation.states[0].size), (length - 1, length)]:
            noise = (observation.published[first:last] - observation.states[first:last]) / deviation
            flat = noise.transpose(1, 0, 2).reshape(agents, -1)
            self.scatter += flat @ flat.T

    @classmethod
    def of(cls, observation: Observation) -> BroadcastSums | None:
        """Of a run; None without broadcast noise.

        Parameters
        ----------
        observation
            of any run
        """
        noisy = observation.prediction.experiment.noise.broadcast
        return cls(observation) if noisy and observation.published is not None else None

    def merge(self, other: BroadcastSums) -> None:
        """Take what another run of the same experiment adds up to.

        Parameters
        ----------
        other
            of another run, with another seed
        """
        self.scatter += other.scatter
        self.samples += other.samples

    def p_value(self) -> float:
        """See ``broadcast_p``."""
        statistic, dof = covariance_statistic(self.scatter, self.samples)
        return float(stats.chi2.sf(statistic, dof))


def broadcast_p(observation: Observation) -> float | None:
    """p-value of what was published, less the states: N(0, s^2 I) of agents; None without broadcast noise.

    Parameters
    ----------
    observation
        of any run
    """
    sums = BroadcastSums.of(observation)
    return sums.p_value() if sums else None
