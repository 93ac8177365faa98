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

"""The air: what happens to a value between the agent that publishes it and an agent that uses it.

The message of step k of agent j says x_j(k) + b_j(k); agent i receives y_ij(k) = x_j(k) + b_j(k) + l_ij(k), or nothing
where it is lost, with all its replicas. Noise and loss belong to the message: used twice, it has the same noise.
With n the step of the newest message, i uses that of step s = max(0, n - delay). If it is lost, x_i(k) takes its place
(own), or the newest one before that is not lost (hold; the first one never is).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, link_number, normals
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.losses import Losses
from msg_analysis.types import BoolArray, FloatArray, IntArray

LOST = 2**64 - 1
"""Value in ``heard`` of a state message for a lost message. No step of a run has this number."""

NOTHING = -1
"""In place of the step of a message: none, so that the agent uses its own value."""


class Air:
    """The random numbers of noise and loss on the air, block after block of steps.

    They do not depend on the graph: they are drawn for a link and a step whether that step uses the link or not.
    ``start``: step of the first messages; negative for a past before the run.
    """

    def __init__(self, experiment: ValidExperiment, start: int = 0) -> None:
        noise = experiment.noise
        self.broadcast, self.link, self.loss = noise.broadcast, noise.link, noise.loss.any
        self.delay, self.holds = noise.delay, noise.holds
        self.start = start
        self._seed = experiment.run.seed
        self._replicas = experiment.run.replicas
        self._losses = Losses(experiment)
        # Of each link, the block whose sources were found last, and the last one of them.
        self._ends: dict[tuple[int, int], tuple[int, int]] = {}
        # The step that an agent makes and the step of the state that it publishes may be in two blocks.
        self._broadcast_block = lru_cache(maxsize=2)(self.broadcast_noise)

    def broadcast_noise(self, agent: int, block: int, until: int | None = None) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): b of an agent (index from 0) in a block of steps (number from 0).

        Where steps from ``until`` on do not matter, only those before.
        """
        return self.broadcast * normals(self._seed, Stream.BROADCAST, agent, block, self._shape(block, until))

    def link_noise(self, receiver: int, sender: int, block: int, until: int | None = None) -> FloatArray:
        """The same of l of the messages from sender to receiver (indices from 0)."""
        link = link_number(receiver, sender)
        return self.link * normals(self._seed, Stream.LINK, link, block, self._shape(block, until))

    def _shape(self, block: int, until: int | None) -> tuple[int, int]:
        steps = STEPS_PER_BLOCK if until is None else min(STEPS_PER_BLOCK, until - block * STEPS_PER_BLOCK)
        return steps, self._replicas

    def losses(self, receiver: int, sender: int, block: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost in a block."""
        lost = self._losses.block(receiver, sender, block)
        if self.holds and block == self.start // STEPS_PER_BLOCK:
            lost[self.start % STEPS_PER_BLOCK] = False
        return lost

    def sources(self, receiver: int, sender: int, block: int) -> IntArray:
        """(STEPS_PER_BLOCK,) of a run: the step of the message that is used where that of each step should be.

        NOTHING where the receiver uses its own value.
        """
        steps = block * STEPS_PER_BLOCK + np.arange(STEPS_PER_BLOCK)
        came = np.where(self.losses(receiver, sender, block), NOTHING, steps)
        if not self.holds:
            return came
        link = receiver, sender
        known, held = self._ends.get(link, (None, NOTHING))
        before = block
        if known != block - 1:
            held = NOTHING
        while came[0] == NOTHING and held == NOTHING:
            before -= 1
            kept = np.flatnonzero(~self.losses(receiver, sender, before))
            held = before * STEPS_PER_BLOCK + int(kept[-1]) if len(kept) else NOTHING
        found = np.maximum.accumulate(np.maximum(came, held))
        self._ends[link] = block, int(found[-1])
        return found

    def published(self, agent: int, step: int, state: FloatArray) -> FloatArray:
        """What an agent (index from 0) publishes of its state (replicas,) of a step.

        Two blocks of noise are cached, which makes consecutive steps of one agent fast.
        """
        block, within = divmod(step, STEPS_PER_BLOCK)
        return np.asarray(state + self._broadcast_block(agent, block)[within])
