"""Many steps at once, compiled and with numpy, beside sums that are written out."""

import dataclasses
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


Heard = dict[tuple[int, int], list[float]]


def message(reception: Reception, k: int, states: list[Any], agent: int, sender: int) -> list[float] | None:
    """What the link brings in step k; None where it is lost. ``states`` begin a delay before x(0)."""
    link = reception.links[agent, sender]
    which = k + int(reception.ahead[link])
    if reception.lost[link, which]:
        return None
    values = list(states[which][sender])
    for r in range(len(values)):
        if reception.broadcast is not None:
            values[r] += float(reception.broadcast[sender, which, r])
        if reception.link is not None:
            values[r] += float(reception.link[link, which, r])
    return values


def by_hand(
    graphs: list[list[list[Row]]],
    modes: list[int],
    past: Any,
    drives: Any,
    reception: Reception | None = None,
    held: Heard | None = None,
) -> Any:
    """The same with Python's floats, one sum after the other; ``held``: the last values heard, by receiver, sender."""
    _, m, replicas = past.shape
    states = past.tolist()
    for k, (mode, drive) in enumerate(zip(modes, drives.tolist(), strict=True)):
        now = states[-1]
        after: list[list[float]] = [[0.0] * replicas for _ in range(m)]
        states.append(after)
        for agent, terms in (row for each in graphs[mode] for row in each):
            for link in held or {}:
                if link[0] == agent and reception is not None:
                    held[link] = message(reception, k, states, *link) or held[link]  # type: ignore[index]
            for r in range(replicas):
                total = None
                for column, weight in terms:
                    sender = column % m
                    if reception is None or sender == agent:
                        value = now[column][r] if column < m else after[column - m][r]
                    elif held is not None:
                        value = held[agent, sender][r]
                    else:
                        value = (message(reception, k, states, agent, sender) or now[agent])[r]
                    total = value * weight if total is None else total + value * weight
                after[agent][r] = total + drive[agent][r]
    return np.array(states[len(past) :])


@st.composite
def networks(draw: st.DrawFn, rounds: int = 2) -> tuple[int, list[list[list[Row]]]]:
    """Agents, and for each graph rounds in which every agent uses itself, others, and what earlier rounds made."""
    m = draw(st.integers(1, 5))
    weight = st.floats(-2, 2).filter(bool)
    graphs = []
    for _ in range(draw(st.integers(1, 3))):
        order = draw(st.permutations(range(m)))
        cut = draw(st.integers(1, m)) if rounds > 1 else m
        graph: list[list[Row]] = []
        made: list[int] = []
        for agents in filter(None, (order[:cut], order[cut:])):
            graph.append([])
            for agent in agents:
                others = draw(st.sets(st.integers(0, m - 1)).map(lambda chosen, agent=agent: sorted(chosen | {agent})))
                graph[-1].append((agent, [(j + m if j in made else j, draw(weight)) for j in others]))
            made += agents
        graphs.append(graph)
    return m, graphs


@given(network=networks(), data=st.data())
def test_equal_to_the_last_bit(network: tuple[int, list[list[list[Row]]]], data: st.DataObject) -> None:
    """Compiled, and by numpy."""
    m, graphs = network
    replicas = data.draw(st.integers(1, 4))
    modes = data.draw(st.lists(st.integers(0, len(graphs) - 1), min_size=1, max_size=6))
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    start, drives = random.normal(size=(1, m, replicas)), random.normal(size=(len(modes), m, replicas))
    assert COMPILED
    expected = by_hand(graphs, modes, start, drives)
    for compiled in (True, False):
        many = ManySteps([rounds_of(graph) for graph in graphs], compiled=compiled)
        states = many.advance(np.array(modes), start, drives)
        np.testing.assert_array_equal(states, expected)


@given(m=st.integers(1, 5), data=st.data())
def test_with_noise_loss_and_delay_on_the_air(m: int, data: st.DataObject) -> None:
    """In lockstep, or one agent after the other in an order that all graphs share; compiled, and by numpy."""
    graphs, order = [], data.draw(st.permutations(range(m)))
    one_by_one = data.draw(st.booleans())
    before = {agent: set(order[:place]) if one_by_one else set() for place, agent in enumerate(order)}
    for _ in range(data.draw(st.integers(1, 3))):
        rows: list[list[Row]] = []
        for agent in order:
            others = sorted(data.draw(st.sets(st.integers(0, m - 1))) | {agent})
            weights = data.draw(st.lists(st.floats(-2, 2).filter(bool), min_size=len(others), max_size=len(others)))
            terms = [(j + m * (j in before[agent]), weight) for j, weight in zip(others, weights, strict=True)]
            rows.append([(agent, terms)])
        graphs.append(rows if one_by_one else [[row for each in rows for row in each]])
    replicas, delay = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 3))
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
    last = None if held is None else {pair: held[link].tolist() for link, pair in enumerate(pairs)}
    expected = by_hand(graphs, modes, past, drives, reception, last)
    for compiled in (True, False):
        own = None if held is None else held.copy()
        heard = dataclasses.replace(reception, held=own)
        many = ManySteps([rounds_of(graph) for graph in graphs], compiled=compiled)
        states = many.advance(np.array(modes), past, drives, heard)
        np.testing.assert_array_equal(states, expected)
        assert own is None or np.array_equal(own, list((last or {}).values()))


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
