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

"""What is due when, in real time. Pure: the caller passes the time of the clock."""

from __future__ import annotations

import math

from msg_analysis.model.arithmetic.step_clock import SECOND, StepClock

CLOCK_MARGIN = 1.0
"""s of the clock by which the clock of another host, or a message from there, may be ahead of ours."""


class Schedule:
    """Simulated time on a clock, and the steps of one agent in it.

    Step k, from x(k) to x(k+1), is due at simulated time (k + phase) dt, 0 <= phase < 1: see ``StepClock``.
    """

    def __init__(self, *, epoch: int, speed: float, step_length: float, phase: float = 0.0) -> None:
        self.epoch = epoch  # time of the clock [ns] at which simulated time is 0
        self._speed = speed  # units of simulated time per second of the clock
        self._steps = StepClock(step_length, phase)
        self._dt, self._phase = self._steps.step_ns, phase

    def simulated(self, now: int) -> int:
        """Simulated time [ns] when the clock says ``now`` [ns]; negative before the epoch."""
        return math.floor((now - self.epoch) * self._speed)

    def due(self, step: int) -> int:
        """Simulated time [ns] at which a step is due."""
        return self._steps.nanoseconds(step)

    def clock_time(self, step: int) -> int:
        """Time of the clock [ns] at which a step is due, rounded up."""
        return self.epoch + math.ceil(self.due(step) / self._speed)

    def next_step(self, now: int, *, after: int = 0) -> int:
        """The first step, from ``after`` on, that is not yet due when the clock says ``now`` [ns]."""
        simulated = self.simulated(now)
        step = max(after, math.floor(simulated / self._dt - self._phase))
        while step > after and self.due(step - 1) > simulated:  # rounding
            step -= 1
        while self.due(step) <= simulated:
            step += 1
        return step

    def reach(self, now: int) -> int:
        """Newest state that any agent can have when the clock says ``now`` [ns], if clocks agree to the margin."""
        return max(0, math.floor(self.simulated(now + round(CLOCK_MARGIN * SECOND)) / self._dt) + 1)
