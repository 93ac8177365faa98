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

"""Noise and loss on the air: what happens to a value between the agent that publishes it and an agent that uses it.

In the step from x(k), agent i uses y_ij(k) = x_j(k) + b_j(k) + l_ij(k) for its neighbour j. Broadcast noise b_j is
added when the value is published, so it is the same for all receivers; link noise l_ij is added by the receiver. If the
message is lost, x_i(k) takes the place of y_ij(k), so there is no coupling in that step. A message carries all its
replicas, which are lost together. The agent uses its own value without noise.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, generator, link_number, normals
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.types import BoolArray, FloatArray

LOST = 2**64 - 1
"""Value in ``heard`` of a state message for a lost message. No step of a run has this number."""


class Air:
    """The random numbers of noise and loss on the air, block after block of steps.

    They do not depend on the graph: they are drawn for a link and a step whether that step uses the link or not.
    """

    def __init__(self, experiment: ValidExperiment) -> None:
        noise = experiment.noise
        self.broadcast, self.link, self.loss = noise.broadcast, noise.link, float(experiment.loss.max())
        self._seed = experiment.run.seed
        self._shape = (STEPS_PER_BLOCK, experiment.run.replicas)
        # The step that an agent makes and the step of the state that it publishes may be in two blocks.
        self._broadcast_block = lru_cache(maxsize=2)(self.broadcast_noise)

    def broadcast_noise(self, agent: int, block: int) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): b of an agent (index from 0) in a block of steps (number from 0)."""
        return self.broadcast * normals(self._seed, Stream.BROADCAST, agent, block, self._shape)

    def link_noise(self, receiver: int, sender: int, block: int) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): l of the messages from sender to receiver (indices from 0) in a block."""
        return self.link * normals(self._seed, Stream.LINK, link_number(receiver, sender), block, self._shape)

    def losses(self, receiver: int, sender: int, block: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost in a block."""
        random = generator(self._seed, Stream.LOSS, link_number(receiver, sender), block)
        return random.random(STEPS_PER_BLOCK) < self.loss

    def published(self, agent: int, step: int, state: FloatArray) -> FloatArray:
        """What an agent (index from 0) publishes of its state (replicas,) of a step.

        Two blocks of noise are cached, which makes consecutive steps of one agent fast.
        """
        block, within = divmod(step, STEPS_PER_BLOCK)
        return np.asarray(state + self._broadcast_block(agent, block)[within])
