"""Counts of messages, by hand and beside slow definitions."""

from __future__ import annotations

import random

import pytest

from msg_agents.doctor.qos.cells import Cell
from msg_agents.doctor.qos.semantics import Demand
from msg_agents.doctor.qos.tally import CellResult, Received, Tally, Try, quantile, rate, tally_reader
from msg_analysis.wire.topics import Qos

SENT = {number: 1_000_000 * number for number in range(10)}
DEMANDS = [Demand(range(2, 4), range(2, 4)), Demand(range(8, 10), range(4, 10), live=True)]


def counts(tally: Tally) -> dict[str, int]:
    names = ("due", "received", "lost", "missing", "unexpected", "doubled", "out_of_order")
    return {name: getattr(tally, name) for name in names if getattr(tally, name)}


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([2, 3, 4, 5, 6, 7, 8, 9], {"due": 8, "received": 8}),
        ([2, 3, 8, 9], {"due": 8, "received": 4, "lost": 4}),
        ([3, 8, 9], {"due": 8, "received": 3, "lost": 5, "missing": 1}),
        ([2, 3, 3, 8, 9, 2], {"due": 8, "received": 6, "lost": 4, "doubled": 2}),
        ([3, 2, 9, 8, 7], {"due": 8, "received": 5, "lost": 3, "out_of_order": 3}),
        ([1, 2, 3, 8, 9, 77], {"due": 8, "received": 6, "lost": 4, "unexpected": 2}),
        ([], {"due": 8, "lost": 8, "missing": 4}),
    ],
)
def test_by_hand(numbers: list[int], expected: dict[str, int]) -> None:
    assert counts(tally_reader(Received(numbers, [0] * len(numbers)), SENT, DEMANDS)) == expected


def test_what_was_not_sent_is_not_due() -> None:
    sent = {number: time for number, time in SENT.items() if number not in (3, 9)}
    tally = tally_reader(Received([2, 8], [0, 0]), sent, DEMANDS)
    assert counts(tally) == {"due": 6, "received": 2, "lost": 4}


def test_latency_is_that_of_messages_sent_to_a_reader_that_reads() -> None:
    times = [9_000_000, 4_500_000, 8_000_250, 8_900_000]
    tally = tally_reader(Received([3, 4, 8, 8], times), SENT, DEMANDS)
    assert tally.latencies == pytest.approx([0.5e-3, 0.25e-6])


def test_random_orders_beside_slow_definitions() -> None:
    rng = random.Random(3)
    for _ in range(200):
        numbers = [rng.randrange(12) for _ in range(rng.randrange(15))]
        tally = tally_reader(Received(numbers, [0] * len(numbers)), SENT, DEMANDS)
        firsts = [n for i, n in enumerate(numbers) if n not in numbers[:i]]
        assert tally.doubled == len(numbers) - len(firsts)
        assert tally.out_of_order == sum(any(m > n for m in firsts[:i]) for i, n in enumerate(firsts))
        assert tally.lost == sum(n not in numbers for n in range(2, 10))
        assert tally.missing == sum(n not in numbers for n in (2, 3, 8, 9))
        assert tally.unexpected == sum(n in numbers for n in (0, 1, 10, 11))


def test_a_cell() -> None:
    """Three tries: lost lawfully, missing, and one that does not count."""
    tries = [
        Try(sent=10, tally=Tally(due=10, received=8, lost=2, latencies=[0.1, 0.3])),
        Try(sent=9, refused=1, tally=Tally(due=9, received=8, lost=1, missing=1, latencies=[0.2])),
        Try(sent=10, tally=Tally(due=10, lost=10, missing=10), counts=False),
    ]
    result = CellResult(Cell(Qos(10, reliable=True, latched=True), "late", 4), tries)
    document = result.to_json()
    words = ("reliability", "durability", "history", "reader", "readers")
    assert [document[name] for name in words] == ["reliable", "transient_local", "keep_last_10", "late", "many"]
    assert (document["tries"], document["not_counted"]) == (2, 1)
    assert (document["sent"], document["refused"], document["lost"], document["missing"]) == (19, 1, 3, 1)
    assert document["latency"] == {"median": 0.2, "p99": 0.3, "max": 0.3}
    assert document["tries_with_loss"]["count"] == 2
    assert document["tries_with_violation"]["count"] == result.violating == 1
    assert document["violations"] == ["missing"]


def test_rate_has_the_interval_of_clopper_and_pearson() -> None:
    """Of no event in n tries, the upper bound is 1 - 0.025^(1/n)."""
    assert rate(0, 200) == {"count": 0, "low": 0.0, "high": pytest.approx(1 - 0.025 ** (1 / 200))}
    assert rate(0, 0) == {"count": 0, "low": 0.0, "high": 1.0}


def test_quantile() -> None:
    assert [quantile([3.0, 1.0, 2.0, 4.0], p) for p in (0.25, 0.5, 0.51, 1)] == [1.0, 2.0, 3.0, 4.0]
    assert quantile([], 0.5) is None
