"""Stalls, lags and clocks against hand-made times."""

import random
from collections.abc import Callable

import pytest

from msg_agents.stepping.monitoring import (
    ClockDetector,
    ClockOffsets,
    Lag,
    LagDetector,
    StallDetector,
    StuckDetector,
    silence_text,
)


class Clock:
    """A clock to be set; it begins at 100 s. ``wall``: that of the system."""

    now, wall = 100.0, 1e9

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_stall_is_told_when_it_has_doubled(clock: Clock) -> None:
    detector, told = StallDetector(clock), []
    for second in range(1, 45):
        clock.now = 100.0 + second
        if detector.update(7):
            told.append(second)
    assert told == [6, 11, 21, 41]  # the seven steps were made in the first second


@pytest.mark.parametrize(
    ("kind", "told"),
    [("stands still", 131), ("moves once", 181), ("somebody is stopped", 281), ("all are paused", 130)],
)
def test_a_run_that_is_stuck_for_120_s(clock: Clock, kind: str, told: int) -> None:
    """From second 10 on no step is made; a stop is an excuse, and a pause of this process is no time."""
    detector, pause = StuckDetector(clock=clock), 0
    for second in range(1, 401):
        if kind == "all are paused" and second == 60:
            pause = 350
        clock.now = 100.0 + second + pause
        step = min(second, 10) + (kind == "moves once" and second >= 60)
        if detector.update(step, excused=kind == "somebody is stopped" and 20 <= second <= 160):
            break
    assert second == told


Steps = Callable[[float], list[int]]


def warnings(clock: Clock, steps: Steps, rate: float = 100.0, seconds: int = 22, last: int = 10**6) -> list[Lag]:
    """What a detector warns of; agents report their steps, from the time [s], every 0.2 s."""
    detector, found = LagDetector(rate, clock), []
    for tick in range(20 * seconds):
        clock.now = 100.0 + 0.05 * tick
        if lag := detector.update(steps(0.2 * (tick // 4)), last):
            found.append(Lag(round(lag.behind), lag.silent, round(lag.quiet)))
    return found


def on_time(t: float) -> int:
    """Steps at a time: 100 a second from second 3 on."""
    return max(0, round(100 * (t - 3.0)))


def with_silent(others: Callable[[float], float], until: float = 10.0) -> Steps:
    """Agent 3 makes no step after a time; the others have made the steps of another time, which is not later."""
    return lambda t: [on_time(others(t))] * 2 + [on_time(min(others(t), until))]


def with_backlog(stopped: float, back: float) -> Steps:
    """Agent 3 stands still between two times, and is on time again a second later."""
    return lambda t: (
        [on_time(t)] * 2 + [on_time(t if t < stopped or t > back + 1 else max(stopped, t - (back - stopped)))]
    )


def silent_for(*seconds: int) -> list[Lag]:
    """Warnings of agent 3."""
    return [Lag(0, (2,), each) for each in seconds]


KINDS: dict[str, tuple[Steps, list[Lag]]] = {
    "on time": (with_silent(lambda t: t, 99.0), []),
    "half the speed": (lambda t: [int(50 * t)] * 3, [Lag(2), Lag(4), Lag(8)]),
    "silent": (with_silent(lambda t: t), silent_for(2, 4, 8)),
    "silent from the start": (with_silent(lambda t: t, 0.0), silent_for(4, 8, 17)),
    "a little late before": (with_silent(lambda t: t if t > 8 else 3 + (t - 3) / 1.6), silent_for(2, 4, 8)),
    "late before": (with_silent(lambda t: t if t > 8 else 3 + (t - 3) / 2), [Lag(2), *silent_for(2, 4, 8)]),
    "twice": (lambda t: [on_time(t)] * 2 + [on_time(min(t, t - t % 8 + 4.5))], silent_for(2, 2)),
    "makes what it has missed": (with_backlog(8.0, 11.5), silent_for(2)),
    "all stand still": (with_silent(lambda t: min(t, 8.0) if t < 18 else t, 99.0), []),
    "another is late, too": (
        lambda t: [on_time(t), on_time(min(t, 7 + t / 2)), on_time(min(t, 10))],
        [*silent_for(2, 4, 8), Lag(2)],
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_one_silent_agent_is_not_a_slow_network(clock: Clock, kind: str) -> None:
    """Whatever has been told before, and however long all wait for their epoch."""
    steps, found = KINDS[kind]
    assert warnings(clock, steps) == found


def test_one_silent_while_the_others_reach_the_end(clock: Clock) -> None:
    steps = with_silent(lambda t: t)
    assert warnings(clock, lambda t: [min(each, 900) for each in steps(t)], last=900) == silent_for(2, 4, 8)


def test_seconds_between_two_steps(clock: Clock) -> None:
    """An agent that makes a step every 3 s is not silent in between, nor late."""
    assert warnings(clock, lambda t: [int((t - 0.3 * i) / 3.0) for i in range(3)], rate=1.0 / 3.0, seconds=60) == []


def test_silent_agents_in_words() -> None:
    words = silence_text((2,), 2.0, 2, {2: 1234}, None)
    assert words == "agent 3 (PID 1234) has made no step for 2.0 s; the other 2 are on time"
    two = silence_text((0, 2), 2.0, 1, {}, ["a", "b", "c"])
    assert two == "agents a, c have made no step for 2.0 s; the other 1 is on time"


def test_a_clock_that_is_set(clock: Clock) -> None:
    detector, told = ClockDetector(clock, lambda: clock.wall), []
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


MS = 1_000_000  # ns


def test_bounds_by_hand() -> None:
    """The other clock is 70 ms ahead; messages take 4 and 2 ms to us, and 3 ms from us."""
    clocks = ClockOffsets()
    assert clocks.to_json() == []
    clocks.add("agent_1", sent=1070 * MS, received=1004 * MS)
    assert clocks.to_json() == [{"node": "agent_1", "ahead_ms": [66.0, None]}]
    assert clocks.warning(50 * MS) is not None  # at least 66 ms, however long messages take
    clocks.add("agent_1", sent=2070 * MS, received=2002 * MS, at_most=73 * MS)
    clocks.add("agent_1", sent=3070 * MS, received=3009 * MS, at_most=90 * MS)
    assert clocks.to_json() == [{"node": "agent_1", "ahead_ms": [68.0, 73.0]}]
    warning = clocks.warning(50 * MS)
    assert "agent_1 is at least 68.0 ms ahead of it, more than dt / speed = 50 ms" in warning
    assert clocks.warning(69 * MS) is None


def test_a_clock_that_is_behind() -> None:
    clocks = ClockOffsets()
    clocks.add("agent_2", sent=900 * MS, received=1001 * MS, at_most=-99 * MS)
    clocks.add("agent_1", sent=1000 * MS, received=1001 * MS, at_most=1 * MS)
    warning = clocks.warning(50 * MS)
    assert warning.startswith(
        "the clocks of agent_2 are not that of the switcher: agent_2 is at least 99.0 ms behind it"
    )


def test_the_offset_is_always_between_the_bounds() -> None:
    rng = random.Random(1)
    for _ in range(200):
        offset = rng.randint(-(10**9), 10**9)
        clocks, at_most = ClockOffsets(), float("inf")
        for now in range(0, 10**10, 10**9):
            at_most = min(at_most, rng.expovariate(1 / 5e6) + offset)
            clocks.add("agent_1", now + offset, now + int(rng.expovariate(1 / 5e6)), at_most)
        low, high = clocks.to_json()[0]["ahead_ms"]
        assert low <= offset / MS <= high
        assert high - low < 20  # ms; two minima of ten delays with mean 5 ms: larger once in 10^12
