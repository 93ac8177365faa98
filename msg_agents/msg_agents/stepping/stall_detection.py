"""Stall detection: steps per second, and when to warn that there are none."""

from __future__ import annotations

import time

STALL_TIME = 5.0  # s without a step, after which an agent counts as stalled


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
