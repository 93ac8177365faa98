"""When steps are due, against plain fractions."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.arithmetic.reproducible import StepClock

# Lengths with few decimals, as people write them, and with as many as a float has.
lengths = st.one_of(st.sampled_from([0.05, 0.1, 1.0, 1e-7, 0.3, 0.007, 1 / 3]), st.floats(1e-6, 100.0))
phases = st.floats(0.0, 1.0, exclude_max=True)


def due(step: int, dt: float, phase: float) -> int:
    """By the definition: the text of dt counts, half a nanosecond goes up, the phase shifts all steps alike."""
    length = Fraction(str(dt)) * 10**9
    return floor(step * length + Fraction(1, 2)) + round(phase * float(length))


@given(step=st.integers(0, 10**12), dt=lengths, phase=phases)
def test_one_by_one(step: int, dt: float, phase: float) -> None:
    assert StepClock(dt, phase).nanoseconds(step) == due(step, dt, phase)
    assert abs(StepClock(dt).nanoseconds(step) - step * Fraction(str(dt)) * 10**9) <= Fraction(1, 2)


@given(steps=st.lists(st.integers(0, 10**7), max_size=5), dt=lengths, phase=phases)
def test_many_at_once(steps: list[int], dt: float, phase: float) -> None:
    """Bit for bit the same, also where a product does not fit into 64 bits."""
    found = StepClock(dt, phase).times(np.array(steps, dtype=np.int64))
    assert found.dtype == np.int64
    assert found.tolist() == [due(step, dt, phase) for step in steps]


def test_products_that_do_not_fit_into_64_bits() -> None:
    dt, steps = 1.2345678901234567e-05, np.array([[0, 7], [4_700_001, 10**8]])
    assert StepClock(dt).times(steps).tolist() == [[due(k, dt, 0.0) for k in row] for row in steps.tolist()]
