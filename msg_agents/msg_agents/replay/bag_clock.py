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

"""The time of a bag while it is played. No ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from msg_analysis.model.arithmetic.step_clock import SECOND


def parse_rate(word: object) -> float:
    """A rate as users give it: a positive number, or "max" (inf); ValueError if it is neither."""
    rate = math.inf if word == "max" else float(str(word))
    if not rate > 0 or (isinstance(word, str) and math.isinf(rate) and word != "max"):
        raise ValueError(word)
    return rate


class BagClock:
    """Time of a bag [ns], at ``rate`` seconds of the bag per second of wall time (inf: as fast as possible).

    It can be paused, and held back while nothing is played.
    """

    def __init__(
        self, start: int, rate: float, *, paused: bool = False, wall: Callable[[], float] = time.monotonic
    ) -> None:
        self._wall = wall
        self._rate = rate
        self._paused = paused
        self._set(start)

    @property
    def rate(self) -> float:
        """Seconds of the bag per second of wall time."""
        return self._rate

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._paused

    def now(self, limit: int) -> int:
        """Time of the bag [ns], at most ``limit`` (of the next message): no message is older than the clock."""
        if self._paused:
            return self._then
        if math.isinf(self._rate):
            return limit
        return min(limit, self._then + round((self._wall() - self._since) * self._rate * SECOND))

    def until(self, when: int) -> float:
        """Seconds of wall time until a time of the bag [ns]: inf while paused, 0 or less if it has come."""
        if self._paused:
            return math.inf
        if math.isinf(self._rate):
            return 0.0
        return (when - self._then) / (self._rate * SECOND) - (self._wall() - self._since)

    def jump(self, when: int) -> None:
        """Go to a time of the bag [ns]."""
        self._set(when)

    def hold(self, seconds: float) -> None:
        """Do not count the last so many seconds of wall time: nothing was played in them."""
        self._since += seconds

    def pause(self, paused: bool, limit: int) -> None:
        """Pause, or go on from the same time; ``limit`` as in ``now``."""
        if paused != self._paused:
            self._set(self.now(limit))
            self._paused = paused

    def change_rate(self, factor: float, limit: int) -> None:
        """Multiply the rate by ``factor`` from now on; ``limit`` as in ``now``. The rate inf stays."""
        if not math.isinf(self._rate):
            self._set(self.now(limit))
            self._rate *= factor

    def _set(self, when: int) -> None:
        self._then, self._since = when, self._wall()
