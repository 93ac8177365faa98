"""Stalls and lags against hand-made times."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from msg_agents.stepping.monitoring import ClockDetector, LagDetector, StallDetector


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock to be set; it begins at 100 s. ``wall``: that of the system."""
    found = SimpleNamespace(now=100.0, wall=1e9)
    times = SimpleNamespace(monotonic=lambda: found.now, time=lambda: found.wall)
    monkeypatch.setattr(stall_detection, "time", times)
    assert time.monotonic is not stall_detection.time.monotonic
    return found


def test_a_stall_is_told_when_it_has_doubled(clock: SimpleNamespace) -> None:
    detector, told = StallDetector(), []
    for second in range(1, 45):
        clock.now = 100.0 + second
        if detector.update(7):
            told.append(second)
    assert told == [6, 11, 21, 41]  # the seven steps were made in the first second


def test_a_run_that_keeps_up(clock: SimpleNamespace) -> None:
    """Reports come every 0.2 s, and the clock of simulated time begins half a second after the agents."""
    detector = LagDetector(100.0)
    for tick in range(1000):
        clock.now = 100.0 + 0.05 * tick
        assert detector.update(max(0, 20 * int(5 * (clock.now - 100.5)))) is None


def test_a_run_at_half_the_speed(clock: SimpleNamespace) -> None:
    detector, told = LagDetector(100.0), []
    for second in range(40):
        clock.now = 100.0 + second
        if behind := detector.update(50 * second):
            told.append((second, behind))
    assert told == [(4, 2.0), (8, 4.0), (16, 8.0), (32, 16.0)]


def test_a_clock_that_is_set(clock: SimpleNamespace) -> None:
    detector, told = ClockDetector(), []
    for tick in range(1, 1001):  # 20 ms each; the clock is slewed by 10 %, which is no step
        clock.now, clock.wall = 100.0 + 0.02 * tick, clock.wall + 0.022
        if tick == 400:
            clock.wall -= 3600.0
        if tick == 700:
            clock.wall += 2.5
        if tick == 800:
            clock.wall -= 0.4
        if words := detector.update():
            told.append((tick, words.partition(":")[0]))
    set_forward = "the clock of this machine was set forward by 2.5 s, or the machine slept"
    assert told == [(400, "the clock of this machine was set back by 3600.0 s"), (700, set_forward)]
