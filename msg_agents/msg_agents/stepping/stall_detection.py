"""Does something get on? Steps per second, and when it is time to say that there are none."""

from __future__ import annotations

import time

PATIENCE = 5.0  # s


class Pace:
    """Looks at a step counter now and then.

    Attributes
    ----------
    rate
        steps per second between the last two looks
    stalled
        s for which there has been no step; 0.0 if there was one since the last look
    """

    def __init__(self) -> None:
        self._step, self._time = 0, time.monotonic()
        self._patience = PATIENCE
        self.rate = self.stalled = 0.0

    def look(self, step: int) -> bool:
        """Whether it is time to complain: after ``PATIENCE`` s without a step, and then ever more rarely.

        Parameters
        ----------
        step
            that everybody has reached
        """
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
