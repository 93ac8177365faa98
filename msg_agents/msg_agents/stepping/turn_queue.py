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

"""The agents of one process that can step do so one after the other. No ROS."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

TURN_SLICE = 0.02
"""s of steps without a break, after which the executor gets its turn: messages, timers, signals."""


class Member(Protocol):
    """What takes turns."""

    def advance(self) -> None:
        """Make every step that can be made now."""


class TurnQueue:
    """Gives turns in the order in which they were asked for, once all ``members`` (a number) have joined.

    A step of one agent lets others step, and theirs others again: the queue replaces nested calls, which would go as
    deep as the run is long.
    """

    def __init__(
        self,
        members: int,
        defer: Callable[[Callable[[], None]], object],  # runs a callback after what is already waiting in the executor
        after: Callable[[], None] = lambda: None,  # is called when turns have been given
    ) -> None:
        self._absent = members
        self._defer = defer
        self._after = after
        self._queue: deque[Member] = deque()
        self._given = True  # turns are being given, or will be: ``ask`` need not start that

    def join(self, member: Member) -> None:
        """Add a member, which gets a turn as soon as all have joined: before, some may not be ready for messages."""
        self._absent -= 1
        self._queue.append(member)
        if not self._absent:
            self._give()

    def ask(self, member: Member) -> None:
        """Get a turn: now, or after the members that asked before."""
        self._queue.append(member)
        if not self._given:
            self._give()

    def _give(self) -> None:
        self._given = True
        queue, until = self._queue, time.monotonic() + TURN_SLICE
        while queue:
            queue.popleft().advance()
            if time.monotonic() > until and queue:
                self._after()
                self._defer(self._give)
                return
        self._after()
        self._given = False
