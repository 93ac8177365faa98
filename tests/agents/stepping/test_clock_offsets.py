"""Bounds of the offset of two clocks, by hand."""

from __future__ import annotations

import random

from msg_agents.stepping.monitoring import ClockOffsets

MS = 1_000_000  # ns


def test_bounds_by_hand() -> None:
    """The other clock is 70 ms ahead; messages take 4 and 2 ms to us, and 3 ms from us."""
    clocks = ClockOffsets()
    assert clocks.to_json() == []
    clocks.hear("agent_1", sent=1070 * MS, received=1004 * MS)
    assert clocks.to_json() == [{"node": "agent_1", "ahead_ms": [66.0, None]}]
    assert clocks.warning(50 * MS) is not None  # at least 66 ms, however long messages take
    clocks.hear("agent_1", sent=2070 * MS, received=2002 * MS, at_most=73 * MS)
    clocks.hear("agent_1", sent=3070 * MS, received=3009 * MS, at_most=90 * MS)
    assert clocks.to_json() == [{"node": "agent_1", "ahead_ms": [68.0, 73.0]}]
    warning = clocks.warning(50 * MS)
    assert warning is not None
    assert "agent_1 is at least 68.0 ms ahead of it, more than dt / speed = 50 ms" in warning
    assert clocks.warning(69 * MS) is None


def test_a_clock_that_is_behind() -> None:
    clocks = ClockOffsets()
    clocks.hear("agent_2", sent=900 * MS, received=1001 * MS, at_most=-99 * MS)
    clocks.hear("agent_1", sent=1000 * MS, received=1001 * MS, at_most=1 * MS)
    warning = clocks.warning(50 * MS)
    assert warning is not None
    assert warning.startswith(
        "the clocks of agent_2 are not that of the switcher: agent_2 is at least 99.0 ms behind it"
    )


def test_the_offset_is_always_between_the_bounds() -> None:
    rng = random.Random(1)
    for _ in range(200):
        offset = rng.randint(-(10**9), 10**9)
        clocks, at_most = ClockOffsets(), float("inf")
        for time in range(0, 10**10, 10**9):
            at_most = min(at_most, rng.expovariate(1 / 5e6) + offset)
            clocks.hear("agent_1", time + offset, time + int(rng.expovariate(1 / 5e6)), at_most)
        low, high = clocks.to_json()[0]["ahead_ms"]
        assert low <= offset / MS <= high
        assert high - low < 20  # ms; two minima of ten delays with mean 5 ms: larger once in 10^12
