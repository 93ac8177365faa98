"""Timers on the clock of a node, and timers on the wall, whatever that clock does."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

FAR_OFF = 3600.0  # s


class DueTimer:
    """Calls back once, when the node's clock has come to a given time: a wall clock, or under use_sim_time ``/clock``.

    ROS 2's own timers are periodic and count from when they were made; so this one is set anew for every time. Nothing
    drifts, and the phase is the one that was asked for.

    Parameters
    ----------
    node
        whose clock counts
    callback
        called when it is time, or a little later
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._clock = node.get_clock()
        self._callback = callback
        self._timer = node.create_timer(FAR_OFF, self._fire)
        self._timer.cancel()

    def now(self) -> int:
        """What the clock says [ns]; 0 under use_sim_time until ``/clock`` has been heard."""
        return int(self._clock.now().nanoseconds)

    def set(self, when: int, now: int | None = None) -> None:
        """Call back at a time of the clock [ns]; at once if that has passed.

        Parameters
        ----------
        when
            time of the clock [ns]
        now
            what the clock says, if it is known already [ns]
        """
        # The clock may have moved since the caller looked: one that is late already is only called a little later.
        self._timer.timer_period_ns = max(1, when - (self.now() if now is None else now))
        self._timer.reset()

    def _fire(self) -> None:
        self._timer.cancel()
        self._callback()


def every(node: Node, period: float, callback: Callable[[], None]) -> None:
    """Call back every ``period`` s of the wall, even while the node's clock stands or runs at another rate.

    Parameters
    ----------
    node
        whose executor calls
    period
        of the wall [s]
    callback
        what to call
    """
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
