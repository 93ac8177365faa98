"""Which time of the bag it is while a bag is played. Without ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from msg_analysis.model.arithmetic.step_clock import SECOND


class PlayClock:
    """Time of a bag, at some rate of the wall's; it can be stopped, and held back.

    Parameters
    ----------
    start
        time of the bag [ns] at which it begins
    rate
        seconds of the bag per second of the wall; inf: as fast as it goes
    paused
        whether it stands at first
    wall
        seconds that pass
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
        """Seconds of the bag per second of the wall."""
        return self._rate

    @property
    def paused(self) -> bool:
        """Whether it stands."""
        return self._paused

    def now(self, limit: int) -> int:
        """Time of the bag [ns], but not after ``limit``, the time of what is to be played next.

        So whoever takes the time from here never sees a message of the past.

        Parameters
        ----------
        limit
            time of the bag [ns] of what is to be played next
        """
        if self._paused:
            return self._then
        if math.isinf(self._rate):
            return limit
        return min(limit, self._then + round((self._wall() - self._since) * self._rate * SECOND))

    def until(self, when: int) -> float:
        """Seconds of the wall until a time of the bag [ns]: inf while it stands, 0 or less if it has come.

        Parameters
        ----------
        when
            time of the bag [ns]
        """
        if self._paused:
            return math.inf
        if math.isinf(self._rate):
            return 0.0
        return (when - self._then) / (self._rate * SECOND) - (self._wall() - self._since)

    def jump(self, when: int) -> None:
        """Go to a time of the bag [ns].

        Parameters
        ----------
        when
            time of the bag [ns]
        """
        self._set(when)

    def hold(self, seconds: float) -> None:
        """What has just passed on the wall did not count: nobody took what was played.

        Parameters
        ----------
        seconds
            of the wall [s]
        """
        self._since += seconds

    def pause(self, paused: bool, limit: int) -> None:
        """Stand, or go on from there; ``limit`` as in ``now``.

        Parameters
        ----------
        paused
            whether to stand
        limit
            as in ``now`` [ns]
        """
        if paused != self._paused:
            self._set(self.now(limit))
            self._paused = paused

    def change_rate(self, factor: float, limit: int) -> None:
        """Go faster or slower from now on; ``limit`` as in ``now``.

        Parameters
        ----------
        factor
            on the rate that it has
        limit
            as in ``now`` [ns]
        """
        if not math.isinf(self._rate):
            self._set(self.now(limit))
            self._rate *= factor

    def _set(self, when: int) -> None:
        self._then, self._since = when, self._wall()
