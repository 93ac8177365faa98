"""Newest value wins, against a model that remembers all that it was offered; when steps are due, against fractions."""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from msg_agents.stepping.newest_values import NewestReceived, NewestValues, Schedule
from msg_agents.stepping.synchronizer import NOTHING
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.messages.acceptance import Refusal

STEPS = 40
INPUTS = [[1, 3], [3], []]
PEERS = {1, 3, 4}  # 4 hears us, and is not heard


@dataclass
class Clock:
    """How far anybody can be."""

    reach: int = STEPS

    def __call__(self) -> int:
        return self.reach


def newest(clock: Clock, start: int = 0) -> NewestValues[Any]:
    return NewestValues(agent=0, steps=STEPS, inputs=INPUTS, peers=PEERS, reach=clock, start=start)


offers = st.tuples(st.just("offer"), st.integers(0, 5), st.integers(0, STEPS + 5))
moves = st.one_of(offers, st.tuples(st.just("clock"), st.integers(0, 5)), st.tuples(st.just("step")))


@given(st.lists(moves, max_size=60))
def test_the_newest_that_can_be(script: list[tuple[Any, ...]]) -> None:
    clock = Clock(0)
    node = newest(clock)
    assert node.learn(0, 0) is None
    taken: dict[int, list[int]] = {j: [] for j in PEERS}
    reasons: list[tuple[str | None, str | None]] = []  # found, wanted
    for kind, *arguments in script:
        if kind == "clock":
            clock.reach += arguments[0]
        elif kind == "step" and not node.finished:
            node.advance()
        elif kind == "offer":
            agent, step = arguments
            wanted = None
            if agent not in PEERS:
                wanted = Refusal.NOT_A_PEER
            elif step <= max(taken[agent], default=-1):
                wanted = Refusal.REPEATED
            elif step > min(clock.reach, STEPS):
                wanted = Refusal.TOO_NEW
            else:
                taken[agent].append(step)
            reasons.append((node.offer(agent, step, (agent, step)), wanted))
        expected = [(max(taken[j]), (j, max(taken[j]))) if taken[j] else (NOTHING, None) for j in INPUTS[0]]
        assert node.inputs() == (0, expected)
    assert all(found == wanted for found, wanted in reasons)


@given(st.permutations([(2, 0), (0, 10), (1, 11), (2, 25)]))
def test_the_newest_graph_wins(offered: list[tuple[int, int]]) -> None:
    """In any order; those that are missing are not waited for: they were over before they arrived."""
    node = newest(Clock())
    newest_of: tuple[int, int] | None = None
    for mode, first_step in offered:
        known = newest_of is not None and first_step <= newest_of[1]
        assert node.learn(mode, first_step) == (Refusal.REPEATED if known else None)
        assert node.learn(mode, first_step) == Refusal.REPEATED
        newest_of = newest_of if known else (mode, first_step)
        assert node.inputs() == (newest_of[0], [(NOTHING, None) for _ in INPUTS[newest_of[0]]])


def test_a_sojourn_before_its_time() -> None:
    """Is not taken; should it have been a genuine one, the path goes on with the next."""
    clock = Clock(5)
    node = newest(clock)
    assert not node.ready()
    assert node.waiting_for() == "the first graph"
    assert node.learn(1, 0) is None
    assert node.ready()
    assert node.learn(0, 8) == Refusal.TOO_EARLY
    assert node.inputs()[0] == 1
    clock.reach = 30
    assert node.learn(1, 0) == Refusal.REPEATED
    assert node.learn(2, 21) is None
    assert node.inputs()[0] == 2


def test_who_takes_over_comes_into_the_middle() -> None:
    node = newest(Clock(), start=17)
    assert node.learn(0, 12) is None
    assert node.learn(1, 15) is None
    assert (node.step, node.inputs()) == (17, (1, [(NOTHING, None)]))
    assert node.offer(3, 16, "a") is None
    assert node.offer(3, 18, "b") is None
    assert node.inputs() == (1, [(18, "b")])
    assert node.behind == {1: 18, 3: -1, 4: 18}


def test_what_came_before_anybody_knew_the_time_is_reviewed() -> None:
    clock = Clock()
    node = newest(clock, start=3)
    assert node.learn(2, 35) is None
    assert node.offer(1, 39, "forged") is None
    assert node.offer(3, 4, "fine") is None
    clock.reach = 5
    node.review()
    assert not node.ready()
    assert node.learn(0, 0) is None
    assert node.inputs() == (0, [(NOTHING, None), (4, "fine")])
    assert node.offer(1, 5, "fine") is None


def test_the_end() -> None:
    node = newest(Clock(), start=STEPS - 1)
    assert node.learn(0, 0) is None
    assert node.ready()
    node.advance()
    assert node.finished
    assert not node.ready()
    assert node.waiting_for() == "nothing, it has finished"
    assert node.offer(1, STEPS + 1, "") == Refusal.TOO_NEW


def test_another_value_of_the_newest_step() -> None:
    """One of the two is forged; the first is used."""
    node = newest(Clock())
    offers = [(5, "first"), (5, "first"), (5, "second"), (4, "older")]
    found = [None, Refusal.REPEATED, Refusal.CONTRADICTION, Refusal.REPEATED]
    assert [node.offer(1, *each) for each in offers] == found
    assert node.known(1) == "first"


@given(
    steps=st.lists(st.integers(0, STEPS), max_size=30),
    lost=st.sets(st.integers(0, STEPS)),
    delay=st.integers(0, 8),
    holds=st.booleans(),
)
def test_lost_and_delayed_values(steps: list[int], lost: set[int], delay: int, holds: bool) -> None:
    """Against a memory of all that came, asked after every message or only now and then."""
    nodes = [
        NewestReceived(
            delay=delay,
            lost=lambda agent, step: agent == 3 and step in lost,
            holds=holds,
            agent=0,
            steps=STEPS,
            inputs=[[3]],
            peers=[3, 4],
            reach=Clock(),
        )
        for _ in range(2)
    ]
    came: list[int] = []
    for node in nodes:
        assert node.learn(0, 0) is None
        assert node.inputs() == (0, [(NOTHING, None)])
    for count, step in enumerate(steps):
        refused = Refusal.REPEATED if came and step <= came[-1] else None
        assert [node.offer(3, step, f"x{step}") for node in nodes] == [refused] * 2
        if not refused:
            came.append(step)
        usable = [step for step in came if step <= max(0, came[-1] - delay) and not (holds and step in lost)]
        expected: tuple[int, str | None] = (NOTHING, None)
        if usable and (holds or usable[-1] not in lost):
            expected = usable[-1], f"x{usable[-1]}"
        for node in nodes[: 2 if count % 5 == 4 else 1]:
            assert node.inputs() == (0, [expected])
            assert node.known(3) == f"x{came[-1]}"


def test_what_was_received_too_early_is_forgotten() -> None:
    clock = Clock()
    node = NewestReceived(
        delay=1, lost=lambda _j, _k: False, holds=True, agent=0, steps=STEPS, inputs=[[1]], peers=[1], reach=clock
    )
    assert node.learn(0, 0) is None
    assert node.offer(1, 4, "fine") is None
    assert node.offer(1, 39, "forged") is None
    assert node.inputs() == (0, [(4, "fine")])
    clock.reach = 5
    node.review()
    assert node.inputs() == (0, [(NOTHING, None)])
    assert node.offer(1, 4, "fine") is None
    assert node.offer(1, 5, "newest") is None
    assert node.inputs() == (0, [(4, "fine")])


DAY = 86_400 * SECOND
speeds = st.floats(1e-3, 1e3)
lengths = st.floats(1e-3, 10.0)
phases = st.floats(0.0, 1.0, exclude_max=True)
epochs = st.integers(0, 2_000_000_000 * SECOND)


@given(epoch=epochs, speed=speeds, dt=lengths, phase=phases, step=st.integers(0, 10**6))
def test_due_times(epoch: int, speed: float, dt: float, phase: float, step: int) -> None:
    """To two nanoseconds and the precision of a double of the time that has gone."""
    schedule = Schedule(epoch=epoch, speed=speed, step_length=dt, phase=phase)
    due = (step + Fraction(phase)) * Fraction(dt) * SECOND
    assert abs(schedule.due(step) - due) <= 2 + abs(due) / 2**50
    gone = schedule.clock_time(step) - epoch
    assert abs(gone - due / Fraction(speed)) <= 2 + (2 + abs(gone)) * (1 + 1 / speed) / 2**50 + 1 / speed
    assert schedule.due(step) < schedule.due(step + 1)


@given(epoch=epochs, speed=speeds, dt=lengths, phase=phases, gone=st.integers(-DAY, DAY), after=st.integers(0, 1000))
def test_the_next_step_is_the_first_that_is_not_due(
    epoch: int, speed: float, dt: float, phase: float, gone: int, after: int
) -> None:
    schedule = Schedule(epoch=epoch, speed=speed, step_length=dt, phase=phase)
    simulated = schedule.simulated(epoch + gone)
    step = schedule.next_step(epoch + gone, after=after)
    assert step >= after
    assert step == after or schedule.due(step - 1) <= simulated
    assert schedule.due(step) > simulated


@given(epoch=epochs, speed=st.sampled_from([0.5, 1.0, 5.0, 1 / 3]), step=st.integers(0, 10**7), phase=phases)
def test_a_timer_on_time_finds_its_step_due(epoch: int, speed: float, step: int, phase: float) -> None:
    """Or is called again a nanosecond later."""
    schedule = Schedule(epoch=epoch, speed=speed, step_length=0.05, phase=phase)
    now = schedule.clock_time(step)
    assert schedule.simulated(now + 2) >= schedule.due(step)
    assert schedule.next_step(now + 2, after=step) == step + 1


@given(speed=speeds, dt=lengths, gone=st.integers(0, DAY))
def test_nobody_on_time_is_out_of_reach(speed: float, dt: float, gone: int) -> None:
    schedule = Schedule(epoch=7, speed=speed, step_length=dt)
    newest = math.floor(gone * speed / (dt * SECOND))  # who has phase 0 has made the step newest -> newest + 1
    assert schedule.reach(7 + gone) >= newest + 1
    assert schedule.reach(7 + gone) <= newest + 3 + speed / dt  # a margin of 1 s
    assert schedule.reach(-DAY) == 0
