"""Many steps at once: the same compiled and with numpy, and nothing outside the arrays is read or written.

tests/analysis/twin/test_links.py has them beside loops over numbers.
"""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.arithmetic import _kernel
from msg_analysis.arithmetic.update_law import COMPILED, ManySteps, Reception, Round

Row = tuple[int, list[tuple[int, float]]]  # an agent, and its terms: row of [x(k); x(k+1)] and weight


def rounds_of(rows: list[list[Row]]) -> list[Round]:
    """Rounds from their rows, as the twin makes them: padded with zeros."""
    found = []
    for each in rows:
        depth = max(len(terms) for _, terms in each)
        padded = [[*terms, *[(0, 0.0)] * (depth - len(terms))] for _, terms in each]
        there = np.array([[d < len(terms) for _, terms in each] for d in range(depth)])
        columns = np.array([[terms[d][0] for terms in padded] for d in range(depth)])
        weights = np.array([[terms[d][1] for terms in padded] for d in range(depth)])
        found.append(Round(np.array([agent for agent, _ in each]), columns, there, weights))
    return found


@given(m=st.integers(1, 5), data=st.data())
def test_equal_to_the_last_bit(m: int, data: st.DataObject) -> None:
    """Agents in rounds, in an order that all graphs share; with or without noise, loss and delay on the air."""
    graphs, order = [], data.draw(st.permutations(range(m)))
    cuts = [0, *sorted(data.draw(st.sets(st.sampled_from(range(m))))), m]
    parts = [order[first:end] for first, end in itertools.pairwise(cuts) if end > first]
    before = {agent: set(itertools.chain(*parts[:place])) for place, part in enumerate(parts) for agent in part}

    def row(agent: int) -> Row:
        others = sorted(data.draw(st.sets(st.integers(0, m - 1))) | {agent})
        weights = data.draw(st.lists(st.floats(-2, 2).filter(bool), min_size=len(others), max_size=len(others)))
        return agent, [(j + m * (j in before[agent]), weight) for j, weight in zip(others, weights, strict=True)]

    for _ in range(data.draw(st.integers(1, 3))):
        graphs.append([[row(agent) for agent in part] for part in parts])
    on_air = data.draw(st.booleans())
    replicas, delay = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 3)) if on_air else 0
    modes = data.draw(st.lists(st.integers(0, len(graphs) - 1), min_size=1, max_size=6))
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    pairs = [(i, j) for i in range(m) for j in range(m) if i != j]
    numbers, messages = np.full((m, m), len(pairs)), len(modes) + 1
    for link, pair in enumerate(pairs):
        numbers[pair] = link
    past, drives = random.normal(size=(delay + 1, m, replicas)), random.normal(size=(len(modes), m, replicas))
    held = random.normal(size=(len(pairs), replicas)) if data.draw(st.booleans()) and pairs else None
    reception = Reception(
        links=numbers,
        first=np.arange(m + 1) * (m - 1),
        senders=np.array([j for _, j in pairs], dtype=np.int64),
        ahead=np.array([int(j in before[i]) for i, j in pairs], dtype=np.int64),
        delay=delay,
        lost=random.random((len(pairs) + 1, messages)) < 0.3,
        broadcast=random.normal(size=(m, messages, replicas)) if data.draw(st.booleans()) else None,
        link=random.normal(size=(len(pairs), messages, replicas)) if data.draw(st.booleans()) and pairs else None,
        held=held,
    )
    found = []
    assert COMPILED
    for compiled in (True, False):
        own = None if held is None else held.copy()
        heard = dataclasses.replace(reception, held=own) if on_air else None
        many = ManySteps([rounds_of(graph) for graph in graphs], compiled=compiled)
        found.append((many.advance(np.array(modes), past, drives, heard), own))
    (one, last), (other, again) = found
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(last, again)


ARGUMENTS: dict[str, Any] = {  # two agents, one graph, three steps of one replica; agent 1 uses both
    "order": np.arange(2),
    "offsets": np.array([0, 2, 3]),
    "columns": np.array([0, 1, 1]),
    "weights": np.array([0.5, 0.25, 1.0]),
    "modes": np.zeros(3, dtype=np.int64),
    "drives": np.zeros((3, 2, 1)),
    "states": np.ones((4, 2, 1)),
    "agents": 2,
    "replicas": 1,
}


@pytest.mark.parametrize(
    "wrong",
    [
        {"order": np.array([0, 2])},
        {"order": np.array([0, -1])},
        {"order": np.arange(3)},
        {"offsets": np.array([0, 2, 4])},
        {"offsets": np.array([0, 3, 2])},
        {"offsets": np.array([0, 2, 2])},
        {"columns": np.array([0, 4, 1])},
        {"columns": np.array([0, -1, 1])},
        {"columns": np.array([0, 1])},
        {"weights": np.ones(2)},
        {"modes": np.array([0, 1, 0])},
        {"modes": np.array([0, -1, 0])},
        {"modes": np.zeros(4, dtype=np.int64)},
        {"drives": np.zeros(5)},
        {"states": np.ones(7)},
        {"agents": 0},
        {"agents": 2**62},
        {"replicas": -1},
        {"replicas": 2**62},
        {"modes": b"1234567"},
    ],
    ids=str,
)
def test_the_kernel_reads_and_writes_nothing_outside_its_arrays(wrong: dict[str, Any]) -> None:
    _kernel.advance(*(ARGUMENTS | {"states": np.ones((4, 2, 1))}).values())
    with pytest.raises(ValueError, match="sizes and indices"):
        _kernel.advance(*(ARGUMENTS | wrong).values())


AIR: dict[str, Any] = {  # two links, and their noise, in the three steps
    "links": np.array([2, 0, 1, 2]),
    "first": np.array([0, 1, 2]),
    "senders": np.array([1, 0]),
    "ahead": np.array([0, 1]),
    "delay": 1,
    "lost": np.zeros((3, 4), dtype=np.bool_),
    "broadcast": np.zeros((2, 4, 1)),
    "link": np.zeros((2, 4, 1)),
    "held": np.zeros((2, 1)),
}


@pytest.mark.parametrize(
    "wrong",
    [
        {"links": np.array([2, 0, 1])},
        {"links": np.array([2, 0, 1, 3])},
        {"links": np.array([2, 0, -1, 2])},
        {"links": np.array([2, 0, 2**62, 2])},
        {"first": np.array([0, 1])},
        {"first": np.array([0, 3, 2])},
        {"first": np.array([1, 1, 2])},
        {"first": b""},
        {"senders": np.array([1, 2])},
        {"senders": np.array([-1, 0])},
        {"senders": np.array([1, 0, 0])},
        {"senders": b""},
        {"ahead": np.array([0, 2])},
        {"ahead": np.array([-1, 0])},
        {"ahead": np.array([0])},
        {"delay": 0},
        {"delay": 2},
        {"delay": -1},
        {"delay": 2**62},
        {"lost": np.zeros((3, 3), dtype=np.bool_)},
        {"lost": np.zeros(13, dtype=np.bool_)},
        {"lost": b""},
        {"broadcast": np.zeros((2, 3, 1))},
        {"broadcast": np.zeros((2, 4, 2))},
        {"link": np.zeros((3, 4, 1))},
        {"held": np.zeros((3, 1))},
    ],
    ids=str,
)
def test_nor_of_the_arrays_of_the_air(wrong: dict[str, Any]) -> None:
    right = ARGUMENTS | {"states": np.ones((5, 2, 1))} | AIR
    _kernel.advance(*right.values())
    with pytest.raises(ValueError, match="sizes and indices"):
        _kernel.advance(*(right | wrong).values())
