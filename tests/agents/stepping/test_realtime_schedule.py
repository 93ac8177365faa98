"""When steps are due, against plain fractions."""

from __future__ import annotations

import math
from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st

from msg_agents.stepping.newest_values import Schedule
from msg_analysis.arithmetic.reproducible import SECOND

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
