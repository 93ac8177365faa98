"""Stall detection: steps per second, and when to warn that there are none."""

from __future__ import annotations

import time

PATIENCE = 5.0  # s


class Pace:
    """Rate of a step counter between two calls of ``look``."""

    def __init__(self) -> None:
        self._step, self._time = 0, time.monotonic()
        self._patience = PATIENCE
        self.rate = self.stalled = 0.0  # steps/s between the last two looks; s without a step

    def look(self, step: int) -> bool:
        """Whether to warn now: after ``PATIENCE`` s without a step, and again whenever the stall has doubled."""
        now = time.monotonic()
        elapsed, made = now - self._time, step - self._step
        self._step, self._time = step, now
        self.rate = made / elapsed if elapsed > 0.0 else 0.0
        if made:
            self.stalled, self._patience = 0.0, PATIENCE
            return False
        self.stalled += elapsed
        if self.stalled < self._patience:
            return False
        self._patience = 2.0 * self.stalled
        return True
