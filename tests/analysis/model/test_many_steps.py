"""Many steps at once, compiled and with numpy, beside sums that are written out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.model.arithmetic import _kernel, many_steps
from msg_analysis.model.arithmetic.many_steps import ManySteps, Reception, Round

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


def used(reception: Reception, k: int, state: list[list[float]], agent: int, sender: int, r: int) -> float:
    """What the agent uses for the sender's value."""
    link = reception.links[agent, sender]
    if reception.own[link, k]:
        return state[agent][r]
    value = state[sender][r]
    if reception.broadcast is not None:
        value += float(reception.broadcast[sender, k, r])
    if reception.link is not None:
        value += float(reception.link[link, k, r])
    return value


def by_hand(
    graphs: list[list[list[Row]]], modes: list[int], start: Any, drives: Any, reception: Reception | None = None
) -> Any:
    """The same with Python's floats, one sum after the other."""
    m, replicas = start.shape
    states = [start.tolist()]
    for k, (mode, drive) in enumerate(zip(modes, drives.tolist(), strict=True)):
        after: list[list[float]] = [[0.0] * replicas for _ in range(m)]
        for agent, terms in (row for each in graphs[mode] for row in each):
            for r in range(replicas):
                total = None
                for column, weight in terms:
                    if reception is not None:
                        value = used(reception, k, states[-1], agent, column, r)
                    else:
                        value = states[-1][column][r] if column < m else after[column - m][r]
                    total = value * weight if total is None else total + value * weight
                assert total is not None
                after[agent][r] = total + drive[agent][r]
        states.append(after)
    return np.array(states[1:])


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


@pytest.mark.parametrize("compiled", [True, False])
@given(network=networks(), data=st.data())
def test_equal_to_the_last_bit(compiled: bool, network: tuple[int, list[list[list[Row]]]], data: st.DataObject) -> None:
    m, graphs = network
    replicas = data.draw(st.integers(1, 4))
    modes = data.draw(st.lists(st.integers(0, len(graphs) - 1), min_size=1, max_size=6))
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    start, drives = random.normal(size=(m, replicas)), random.normal(size=(len(modes), m, replicas))
    assert many_steps.COMPILED
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(many_steps, "COMPILED", compiled)
        states = ManySteps([rounds_of(graph) for graph in graphs]).advance(np.array(modes), start, drives)
    np.testing.assert_array_equal(states, by_hand(graphs, modes, start, drives))


@pytest.mark.parametrize("compiled", [True, False])
@given(network=networks(rounds=1), data=st.data())
def test_with_noise_and_loss_on_the_air(compiled: bool, network: tuple[int, Any], data: st.DataObject) -> None:
    m, graphs = network
    replicas, most = data.draw(st.integers(1, 4)), 6
    modes = data.draw(st.lists(st.integers(0, len(graphs) - 1), min_size=1, max_size=most))
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    start, drives = random.normal(size=(m, replicas)), random.normal(size=(len(modes), m, replicas))
    links = np.arange(m * m).reshape(m, m)
    np.fill_diagonal(links, m * m)
    own = random.random((m * m + 1, most)) < 0.3
    own[-1] = True
    broadcast = random.normal(size=(m, most, replicas)) if data.draw(st.booleans()) else None
    link = random.normal(size=(m * m + 1, most, replicas)) if data.draw(st.booleans()) else None
    reception = Reception(links, own, broadcast, link)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(many_steps, "COMPILED", compiled)
        states = ManySteps([rounds_of(graph) for graph in graphs]).advance(np.array(modes), start, drives, reception)
    np.testing.assert_array_equal(states, by_hand(graphs, modes, start, drives, reception))


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
    "own": np.array([[False] * 3, [False] * 3, [True] * 3]),
    "broadcast": np.zeros((2, 3, 1)),
    "link": np.zeros((3, 3, 1)),
}


@pytest.mark.parametrize(
    "wrong",
    [
        {"links": np.array([2, 0, 1])},
        {"links": np.array([2, 0, 1, 3])},
        {"links": np.array([2, 0, -1, 2])},
        {"links": np.array([2, 0, 2**62, 2])},
        {"own": np.ones((3, 2), dtype=np.bool_)},
        {"own": np.ones(10, dtype=np.bool_)},
        {"own": b""},
        {"broadcast": np.zeros((2, 2, 1))},
        {"broadcast": np.zeros((2, 3, 2))},
        {"link": np.zeros((2, 3, 1))},
        {"columns": np.array([0, 3, 1])},  # what another agent makes in the same step
    ],
    ids=str,
)
def test_nor_of_the_arrays_of_the_air(wrong: dict[str, Any]) -> None:
    right = ARGUMENTS | {"states": np.ones((4, 2, 1))} | AIR
    _kernel.advance(*right.values())
    with pytest.raises(ValueError, match="sizes and indices"):
        _kernel.advance(*(right | wrong).values())
