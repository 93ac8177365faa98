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

"""Which steps of an agent a recorder has received, in bounded memory. No ROS."""

from __future__ import annotations

from array import array

import numpy as np

from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.types import IntArray
from msg_analysis.wire.refusals import Refusal

_MASK = 0x3FFFFFFF  # of the bits of a content that are in its mark
CONSECUTIVE = 64
"""Steps in a row after which those before them are taken for lost: the reader came late, for example."""


def marks_of(contents: IntArray) -> array[int]:
    """Marks of so many contents: numbers of 30 bits, not 0."""
    return array("i", ((contents & _MASK) + 1).astype(np.int32).tobytes())


class ReceivedSteps:
    """The steps 0 to ``last`` of one agent, in any order: after a restart some come again.

    A mark of 4 bytes per step tells whether a repeated one is the same, up to RESEND_LIMIT steps before and after
    ``row``, the newest step up to which none is to come any more.
    """

    def __init__(self, last: int) -> None:
        self.row = -1
        self._last = last
        self._chain = (0, 0)  # the step that would continue the newest ones beyond ``row``, and how many these are
        # 0: not received. Negative: two different ones were.
        self._marks = array("i", bytes(4 * min(2 * RESEND_LIMIT, last + 1)))

    def take(self, step: int, content: int) -> str | None:
        """Take a step with a hash of its content; None if it is new, else a ``Refusal``.

        Of two different ones of one step, the second is a contradiction; further ones count as repeated.
        """
        if step > self._last:
            return Refusal.OUT_OF_RANGE
        if step <= self.row - RESEND_LIMIT:
            return Refusal.TOO_OLD
        if step > self.row + 1:
            following, count = self._chain
            self._chain = (step + 1, count + 1 if step == following else 1)
            if self._chain[1] >= CONSECUTIVE:
                self._move(step - 1)
        if step > self.row + RESEND_LIMIT:
            return Refusal.TOO_NEW
        slot, mark = step % len(self._marks), (content & _MASK) + 1
        known = self._marks[slot]
        if not known:
            self._marks[slot] = mark
            while self.row < self._last and self._marks[(self.row + 1) % len(self._marks)]:
                self._move(self.row + 1)
            return None
        if known == mark or known < 0:
            return Refusal.REPEATED
        self._marks[slot] = -known
        return Refusal.CONTRADICTION

    def take_row(self, first: int, marks: array[int]) -> bool:
        """Take the steps from ``first`` on at once, if they follow ``row`` and all are new; else False, and none."""
        size, last = len(self._marks), first + len(marks) - 1
        slot = first % size
        end = slot + len(marks)
        if first != self.row + 1 or last > self._last or end > size or any(self._marks[slot:end]):
            return False
        self._marks[slot:end] = marks
        self._move(last)
        while self.row < self._last and self._marks[(self.row + 1) % size]:
            self._move(self.row + 1)
        return True

    def _move(self, row: int) -> None:
        """Set ``row``; the steps that are then within reach take the places of old ones."""
        size = len(self._marks)
        step = max(self.row, row - size) + RESEND_LIMIT + 1
        end = min(row + RESEND_LIMIT, self._last) + 1
        if end - step == 1:  # in order, one after the other
            self._marks[step % size] = 0
            step = end
        while step < end:
            slot = step % size
            count = min(end - step, size - slot)
            self._marks[slot : slot + count] = array("i", bytes(4 * count))
            step += count
        self.row = row
