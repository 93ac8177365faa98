# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Stalls and lags: steps per second, and when to warn that there are none, or fewer than in real time.

Steps in real time follow the clock of the system, which can be set while they do.
"""

from __future__ import annotations

import time

STALL_TIME = 5.0  # s without a step, after which an agent counts as stalled
LAG_TIME = 2.0
"""s by which a run in real time is behind its clock after which it counts as too slow; agents report every 0.2 s."""
CLOCK_STEP = 0.5  # s by which the clock must have been set to be noted


class StallDetector:
    """Measures the rate of a step counter between two calls of ``update``."""

    def __init__(self) -> None:
        self._step, self._time = 0, time.monotonic()
        self._next_warning = STALL_TIME
        self.rate = self.stalled = 0.0  # steps/s between the last two updates; s without a step

    def update(self, step: int) -> bool:
        """Whether to warn now: after ``STALL_TIME`` s without a step, and again whenever the stall has doubled."""
        now = time.monotonic()
        elapsed, made = now - self._time, step - self._step
        self._step, self._time = step, now
        self.rate = made / elapsed if elapsed > 0.0 else 0.0
        if made:
            self.stalled, self._next_warning = 0.0, STALL_TIME
            return False
        self.stalled += elapsed
        if self.stalled < self._next_warning:
            return False
        self._next_warning = 2.0 * self.stalled
        return True


class LagDetector:
    """Notices that a run in real time falls behind its clock; ``rate``: steps that are due per second."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._began: float | None = None
        self._first = 0
        self._next_warning = LAG_TIME

    def update(self, step: int) -> float | None:
        """After each look at the newest step of all agents: s behind, if to warn now, and again when it has doubled."""
        now = time.monotonic()
        if self._began is None or step == self._first:  # waiting for the epoch
            self._began, self._first = now, step
            return None
        behind = now - self._began - (step - self._first) / self._rate
        if behind < self._next_warning:
            return None
        self._next_warning = 2.0 * behind
        return behind


class ClockDetector:
    """Notices that the clock of this machine has been set, by comparison with the one that nobody sets."""

    def __init__(self) -> None:
        self._apart = time.time() - time.monotonic()

    def update(self) -> str | None:
        """What has happened since the last call, in words."""
        before, self._apart = self._apart, time.time() - time.monotonic()
        forward = self._apart - before
        if abs(forward) < CLOCK_STEP:
            return None
        if forward > 0.0:
            return (
                f"the clock of this machine was set forward by {forward:.1f} s, or the machine slept: the steps of "
                "that time are made at once, too late"
            )
        return (
            f"the clock of this machine was set back by {-forward:.1f} s: no step is due until it is there again, "
            "since steps in real time follow it; a new run begins at once"
        )
