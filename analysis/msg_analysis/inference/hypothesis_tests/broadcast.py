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


"""Test of the noise that is added to published values."""

from __future__ import annotations

from itertools import chain

import numpy as np

from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.statistics.distributions import chi2_tail
from msg_analysis.inference.statistics.normal_covariance import covariance_statistic


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
