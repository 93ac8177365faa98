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

"""Which messages are lost: independently, or in bursts, by one uniform number for each message of a directed link.

With bursts a link is a stationary Markov chain (Gilbert 1960): a message is lost with probability ``after_lost`` or
``after_kept``, by the fate of the one before. A number below both means lost, above both not lost, between them the
same as before (or the opposite, if losses come more evenly than independent ones). So the fate of a message follows
from the newest number that decides alone, exactly, and without all that was before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK, Stream, link_number, uniforms
from msg_analysis.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.experiment import ValidExperiment

_WITHIN = np.arange(STEPS_PER_BLOCK)


def loss_probabilities(experiment: ValidExperiment) -> tuple[FloatArray, FloatArray]:
    """Of a message after one that was not lost, and after one that was, (m, m) each: receiver, sender."""
    loss, burst = experiment.loss, experiment.noise.burst
    if burst is None:
        return loss, loss
    return loss / (burst * (1.0 - loss)), np.where(loss > 0.0, 1.0 - 1.0 / burst, 0.0)


class Losses:
    """The lost messages of every link, block after block of steps."""

    def __init__(self, experiment: ValidExperiment) -> None:
        self._seed = experiment.run.seed
        after_kept, after_lost = loss_probabilities(experiment)
        self._low, self._high = np.minimum(after_kept, after_lost), np.maximum(after_kept, after_lost)
        self._opposite = after_kept > after_lost
        # Of each link, the block that was drawn last, and whether its last message was lost.
        self._ends: dict[tuple[int, int], tuple[int, bool]] = {}

    def block(self, receiver: int, sender: int, number: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost in a block."""
        link = receiver, sender
        if not self._high[link]:
            return np.zeros(STEPS_PER_BLOCK, dtype=np.bool_)
        lost, decided = self._drawn(link, number)
        if decided.all():
            return lost
        newest = np.maximum.accumulate(np.where(decided, _WITHIN, -1))
        before = self._end(link, number - 1) if newest[0] < 0 else False
        lost = np.where(newest < 0, before, lost[newest])
        if self._opposite[link]:
            lost ^= (_WITHIN - newest) % 2 == 1
        self._ends[link] = number, bool(lost[-1])
        return lost

    def _drawn(self, link: tuple[int, int], number: int) -> tuple[BoolArray, BoolArray]:
        """Of every message of a block, whether its number alone makes it lost, and whether it decides alone."""
        drawn = uniforms(self._seed, Stream.LOSS, link_number(*link), number, STEPS_PER_BLOCK)
        lost: BoolArray = drawn < self._low[link]
        return lost, lost | (drawn >= self._high[link])

    def _end(self, link: tuple[int, int], number: int) -> bool:
        """Whether the last message of a block is lost."""
        known = self._ends.get(link)
        if known and known[0] == number:
            return known[1]
        distance = 0
        while True:
            lost, decided = self._drawn(link, number)
            if decided.any():
                newest = int(np.flatnonzero(decided)[-1])
                odd = (distance + STEPS_PER_BLOCK - 1 - newest) % 2 == 1
                return bool(lost[newest]) ^ bool(self._opposite[link] and odd)
            number, distance = number - 1, distance + STEPS_PER_BLOCK
