"""Whose turn it is: agents of one process that can move on do so one after the other, without ROS."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

SLICE = 0.02
"""s of steps without a break, after which the middleware gets its turn: messages, timers, signals."""


class Member(Protocol):
    """Who takes turns."""

    def advance(self) -> None:
        """Make every step that can be made now."""


class Turns:
    """Gives turns in the order in which they were asked for.

    A step of one agent makes others able to step, and theirs others again: this queue stands for nested calls, which
    would go as deep as the run is long.

    Parameters
    ----------
    members
        number of those who must have joined before the first turn is given: until then some may not be ready to be told
        anything
    defer
        calls what it is given a little later, when all that waits has been dealt with
    """

    def __init__(self, members: int, defer: Callable[[Callable[[], None]], object]) -> None:
        self._absent = members
        self._defer = defer
        self._queue: deque[Member] = deque()
        self._given = True  # or about to be: whoever asks for a turn need not see to it

    def join(self, member: Member) -> None:
        """Be there, and have a turn when everybody is.

        Parameters
        ----------
        member
            of this process
        """
        self._absent -= 1
        self._queue.append(member)
        if not self._absent:
            self._give()

    def ask(self, member: Member) -> None:
        """Have a turn: now, or when those who asked before have had theirs.

        Parameters
        ----------
        member
            that has joined
        """
        self._queue.append(member)
        if not self._given:
            self._give()

    def _give(self) -> None:
        self._given = True
        queue, until = self._queue, time.monotonic() + SLICE
        while queue:
            queue.popleft().advance()
            if time.monotonic() > until and queue:
                self._defer(self._give)
                return
        self._given = False
