"""Stalls and lags against hand-made times."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from msg_agents.stepping import stall_detection
from msg_agents.stepping.stall_detection import LagDetector, StallDetector


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock to be set; it begins at 100 s."""
    found = SimpleNamespace(now=100.0)
    monkeypatch.setattr(stall_detection, "time", SimpleNamespace(monotonic=lambda: found.now))
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
