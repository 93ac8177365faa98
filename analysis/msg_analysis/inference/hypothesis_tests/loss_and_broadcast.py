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

"""Tests of the logged message losses, and of the noise added to published values."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from msg_analysis.inference.observed.heard_values import mode_links
from msg_analysis.inference.observed.measurement import Measurement
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.statistics.distributions import chi2_quantile, chi2_tail
from msg_analysis.inference.statistics.normal_covariance import covariance_statistic
from msg_analysis.types import BoolArray, FloatArray, IntArray

MIN_EXPECTED_LOSSES = 25.0  # smallest expected count for which a chi-square law is used


@dataclass(frozen=True, slots=True)
class LossTest:
    """The logged losses against independent losses of equal probability."""

    lost: int  # messages
    expected: float  # number of messages times the probability
    p: float | None  # None where there was no message


def loss_test(observation: Observation | Measurement) -> LossTest | None:
    """Test that messages are lost independently, all with the same probability; None without (logged) loss.

    Given the graphs, the losses of each link are exactly binomial. The statistic adds one chi-square per link and two
    for the products of (lost - p): of messages of one link in successive steps, and of pairs of messages in one step.
    Links with too few messages for a chi-square law are pooled and tested by the exact binomial law; products that are
    too rare are left out.
    """
    tally = LossTally.of(observation)
    return tally.test() if tally else None


class LossTally:
    """Sums over the messages of a run with ``noise.loss``; xi = lost - p."""

    def __init__(self, observation: Observation | Measurement) -> None:
        step = observation.step
        self.probability = step.loss
        self.pairs: IntArray = np.argwhere(step.listens())  # (links, 2) receiver and sender of links in any graph
        links = len(self.pairs)
        self.messages, self.lost = np.zeros(links, np.int64), np.zeros(links, np.int64)
        # Sums of xi xi' over messages of a link in successive steps and over pairs in one step, and their numbers.
        self.successive = self.same_step = 0.0
        self.successive_pairs = self.same_step_pairs = 0
        numbers = np.cumsum(step.listens().ravel()).reshape(step.agents, step.agents) - 1
        graphs = []
        for mode in range(step.modes):
            receiver, sender, which = mode_links(step, mode)
            graphs.append((numbers[receiver, sender], receiver, which))
        before = np.zeros((1, links), np.bool_), np.zeros((1, links))
        for first, last in observation.blocks(4 * links, "loss"):
            before = self._add(*_block(observation, graphs, links, first, last), before)

    @classmethod
    def of(cls, observation: Observation | Measurement) -> LossTally | None:
        """Tally of a run; None where no message can be lost, or no loss was logged."""
        return cls(observation) if observation.step.loss and observation.lost is not None else None

    def merge(self, other: LossTally) -> None:
        """Add the tally of another run of the same experiment, with another seed."""
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
        often = messages * rarer >= MIN_EXPECTED_LOSSES
        chi2 = float(((lost - probability * messages)[often] ** 2 / messages[often]).sum() / variance)
        dof = int(often.sum())
        rest, rest_lost = int(messages[~often].sum()), int(lost[~often].sum())
        if rest:
            from scipy.stats import binomtest  # here, since it takes longer to import than all the rest

            p = float(binomtest(rest_lost, rest, probability).pvalue)
            chi2, dof = chi2 + float(chi2_quantile(p, 1)), dof + 1
        for product, pairs in ((self.successive, self.successive_pairs), (self.same_step, self.same_step_pairs)):
            if pairs * rarer**2 >= MIN_EXPECTED_LOSSES:
                chi2, dof = chi2 + product**2 / (variance**2 * pairs), dof + 1
        p = float(chi2_tail(chi2, dof))
        return LossTest(int(lost.sum()), float(probability * messages.sum()), p)

    def _add(
        self, sent: BoolArray, xi: FloatArray, before: tuple[BoolArray, FloatArray]
    ) -> tuple[BoolArray, FloatArray]:
        """Add a block of steps, given the last step before it; returns the last step of the block."""
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
    """Sums over the noise in published values, in units of its nominal standard deviation."""

    def __init__(self, observation: Observation) -> None:
        assert observation.published is not None
        deviation = observation.prediction.experiment.noise.broadcast
        agents = observation.step.agents
        self.scatter = np.zeros((agents, agents))  # sum of the products of the agents' noise
        length = observation.steps + 1
        self.samples = length * observation.replicas  # published values of each agent
        for first, last in chain(
            observation.blocks(observation.states[0].size, "broadcast noise"), [(length - 1, length)]
        ):
            noise = (observation.published[first:last] - observation.states[first:last]) / deviation
            flat = noise.transpose(1, 0, 2).reshape(agents, -1)
            self.scatter += flat @ flat.T

    @classmethod
    def of(cls, observation: Observation) -> BroadcastSums | None:
        """Sums of a run; None without broadcast noise."""
        noisy = observation.prediction.experiment.noise.broadcast
        return cls(observation) if noisy and observation.published is not None else None

    def merge(self, other: BroadcastSums) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        self.scatter += other.scatter
        self.samples += other.samples

    def p_value(self) -> float:
        """p-value of published - state being N(0, s^2 I), s = ``noise.broadcast``."""
        statistic, dof = covariance_statistic(self.scatter, self.samples)
        return float(chi2_tail(statistic, dof))
