"""What a recorder knows of the steps that it has received."""

from __future__ import annotations

import random
import tracemalloc

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from msg_agents.stepping.synchronizer import CONSECUTIVE, RESEND_LIMIT, ReceivedSteps, hashes_of
from msg_analysis.messages.acceptance import Refusal

LONG = 50_000


def test_in_order_to_the_end() -> None:
    steps = ReceivedSteps(LONG)
    for k in range(LONG + 1):
        assert steps.take(k, k) is None
        assert steps.row == k
    assert steps.take(LONG + 1, 0) == Refusal.OUT_OF_RANGE


def test_neighbours_swapped() -> None:
    """k + 2 before k + 1, once: what comes long afterwards is taken all the same."""
    steps = ReceivedSteps(LONG)
    for k in (0, 2, 1, *range(3, LONG + 1)):
        assert steps.take(k, k) is None
    assert steps.row == LONG


@given(st.integers(0, 2**32), st.integers(1, 300), st.integers(0, 40))
def test_any_order_and_repetitions(seed: int, last: int, shuffled: int) -> None:
    """Restarts repeat what came before; of different contents the second is told apart."""
    chance = random.Random(seed)
    order = sorted(range(last + 1), key=lambda k: k + chance.uniform(0, shuffled))
    steps, known = ReceivedSteps(last), {}
    for k in order:
        assert steps.take(k, hash((k, seed))) is None
        known[k] = hash((k, seed))
        again = chance.choice(list(known))
        assert steps.take(again, known[again]) == Refusal.REPEATED
    assert steps.row == last
    assert steps.take(last, 1) == Refusal.CONTRADICTION
    assert steps.take(last, 2) == Refusal.REPEATED
    assert steps.take(last, known[last]) == Refusal.REPEATED


def test_reach() -> None:
    steps = ReceivedSteps(LONG)
    for k in range(20_001):
        steps.take(k, k)
    assert steps.take(20_000 - RESEND_LIMIT, 0) == Refusal.TOO_OLD
    assert steps.take(20_001 - RESEND_LIMIT, 20_001 - RESEND_LIMIT) == Refusal.REPEATED
    assert steps.take(20_001 - RESEND_LIMIT, 0) == Refusal.CONTRADICTION
    assert steps.take(20_001 + RESEND_LIMIT, 0) == Refusal.TOO_NEW
    assert steps.take(20_000 + RESEND_LIMIT, 0) is None


def test_forged_steps_change_nothing() -> None:
    """Of any steps that do not follow each other, before the first true one and between true ones."""
    chance = random.Random(1)
    steps = ReceivedSteps(LONG)
    taken = set()
    for k in [*range(LONG, 0, -50), *(chance.randrange(LONG) for _ in range(2000))]:
        taken |= {k} if steps.take(k, -1) is None else set()
    for k in range(LONG + 1):
        assert steps.take(k, k) == (Refusal.CONTRADICTION if k in taken else None)
        forged = chance.randrange(k + 1, 2 * LONG)
        taken |= {forged} if steps.take(forged, -1) is None else set()
    assert steps.row == LONG


def test_a_reader_that_came_late() -> None:
    """The first steps never come: after a few in a row they are taken for lost."""
    for first in (1, 100, RESEND_LIMIT, 20_000):
        steps = ReceivedSteps(LONG)
        taken = [k for k in range(first, LONG + 1) if steps.take(k, k) is None]
        assert taken == list(range(taken[0], LONG + 1))
        assert taken[0] - first < CONSECUTIVE
        assert steps.row == LONG


def test_memory_does_not_grow() -> None:
    steps = ReceivedSteps(10**9)
    for k in range(20_000):
        steps.take(k, k)
    tracemalloc.start()
    for k in range(20_000, 100_000):
        steps.take(k, k)
        steps.take(10**9 - k, k)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 10_000


@given(st.integers(0, 2**32), st.sampled_from([3, 50, 7_000, 13_000, LONG]))
def test_rows_at_once_are_the_same_as_one_by_one(seed: int, last: int) -> None:
    """Rows that follow, repeat, overlap or leave gaps: what one by one says, and the same marks afterwards."""
    chance = random.Random(seed)
    rows, singles = ReceivedSteps(last), ReceivedSteps(last)
    step = 0
    for _ in range(30):
        first = max(0, step + chance.choice([0, 0, 0, 0, 1, -3, 100, -RESEND_LIMIT]))
        contents = [hash((k, chance.random() < 0.01)) for k in range(first, first + chance.randrange(1, 900))]
        one_by_one = [singles.take(k, content) for k, content in enumerate(contents, start=first)]
        if rows.take_row(first, hashes_of(np.array(contents))):
            assert one_by_one == [None] * len(contents)
        else:
            assert [rows.take(k, content) for k, content in enumerate(contents, start=first)] == one_by_one
        assert rows.row == singles.row
        step = min(first + len(contents), last + 1)
    for k in range(max(0, step - 2 * RESEND_LIMIT), min(step + RESEND_LIMIT, last) + 1, 7):
        assert rows.take(k, k) == singles.take(k, k)


def test_a_row_beyond_the_end() -> None:
    steps = ReceivedSteps(5)
    assert not steps.take_row(0, hashes_of(np.arange(7)))
    assert not steps.take_row(1, hashes_of(np.arange(3)))
    assert steps.take_row(0, hashes_of(np.arange(6)))
    assert steps.row == 5
    assert not steps.take_row(6, hashes_of(np.arange(1)))
