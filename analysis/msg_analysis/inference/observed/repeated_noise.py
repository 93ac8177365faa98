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


"""Link noise of messages that are used more than once: what earlier steps say about it.

The noise of a link belongs to the message: used again, because a newer one was lost or late, it is the same. So the
innovations e_i of an agent are no longer independent, but those of the Kalman filter are: the noises of its newest
messages are a Gaussian vector, of which every step observes one combination, w^T noise + process noise.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.inference.observed.heard_values import HeardValues
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.types import BoolArray, FloatArray, IntArray

NEVER = -2


class RepeatedNoise:
    """Frees the innovations, block after block, of what earlier ones say about the noise in them.

    Exact where the process noise of the agents is independent.
    """

    def __init__(self, observation: Observation) -> None:
        self._step = step = observation.step
        m, replicas = step.agents, observation.replicas
        listens = step.listens()
        most = int(listens.sum(axis=1).max(initial=1)) or 1
        places = np.cumsum(listens, axis=1) - 1  # (m, m) place of a sender among all that an agent ever hears
        self._place = places[np.arange(m)[:, None], neighbour_tables(step).senders]  # (n, m, D)
        self._variance = step.link**2
        self._process = np.square(step.noise_gain).sum(axis=2)  # (n, m)
        self._message = np.full((m, most), NEVER, dtype=np.int64)
        self._mean, self._covariance = np.zeros((m, most, replicas)), np.zeros((m, most, most))

    @classmethod
    def of(cls, observation: Observation) -> RepeatedNoise | None:
        """None where there is no link noise, or no message is used again."""
        kept = observation.timers is not None or observation.used is not None
        return cls(observation) if observation.step.link and kept else None

    def free(self, innovations: FloatArray, reception: HeardValues) -> tuple[FloatArray, FloatArray]:
        """Innovations (b, m, R) less what is known of them, and the variance (b, m) of the link noise that is not."""
        found, variances = np.empty_like(innovations), np.empty(reception.link_variance.shape)
        agents = np.arange(innovations.shape[1])[:, None]
        places = self._place[reception.graphs, agents.T]  # (b, m, D)
        process = self._process[reception.graphs, agents.T]
        for k, e in enumerate(innovations):
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
        return found, variances

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
