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

"""Timers on the clock of a node, and timers on wall time, whatever that clock does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import cast

from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.node import Node

FAR_OFF = 3600.0  # s


class DueTimer:
    """Calls back once, when the node's clock (a wall clock, or ``/clock`` under use_sim_time) has reached a given time.

    ROS 2's own timers are periodic and count from when they were made. This one is set anew for every time, so it does
    not drift and has the phase that was asked for. The callback may come a little late.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._clock = cast(ROSClock, node.get_clock())
        self._callback = callback
        self._timer = node.create_timer(FAR_OFF, self._fire)
        self._timer.cancel()

    def now(self) -> int:
        """Time of the clock [ns]; 0 under use_sim_time until ``/clock`` has been received."""
        if self._clock.ros_time_is_active:
            return int(self._clock.now().nanoseconds)
        return time.time_ns()  # what that clock reads then, in a third of the time

    def set(self, when: int, now: int | None = None) -> None:
        """Call back at time ``when`` of the clock [ns], at once if it has passed; ``now``: its time, if known."""
        # The clock may have moved on from ``now``: the callback is then a little later.
        self._timer.timer_period_ns = max(1, when - (self.now() if now is None else now))
        self._timer.reset()

    def _fire(self) -> None:
        self._timer.cancel()
        self._callback()


def every(node: Node, period: float, callback: Callable[[], None]) -> None:
    """Call back every ``period`` s of wall time, from the node's executor, even while the node's clock stands still."""
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def after(node: Node, seconds: float, callback: Callable[[], None]) -> None:
    """Call back once, after so many seconds of wall time."""

    def fire() -> None:
        node.destroy_timer(timer)
        callback()

    timer = node.create_timer(seconds, fire, clock=Clock(clock_type=ClockType.STEADY_TIME))
