"""Bags of runs with noise and loss on the air, made message by message."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.salvage import salvage
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.messages import (
    ACTIVE_GRAPH,
    AGENT_STATE,
    STRING,
    ActiveGraph,
    AgentState,
    MessageType,
    encode_string,
)
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import simulate

STEPS, LOST = 40, 2**64 - 1
NEIGHBOURS = ({1: [2], 2: [1, 3], 3: [2]}, {1: [2, 3], 2: [1], 3: [1]})  # of line and star, agents from 1
Message = tuple[str, MessageType, bytes]


@pytest.fixture(scope="module")
def run() -> Run:
    """A run of the twin; its states, losses and modes are replaced by what the tests write."""
    return simulate(
        Experiment.parse(
            {
                "name": "air",
                "graphs": {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 1}}},
                "switching": {"generator": [[-5, 5], [5, -5]]},
                "noise": {"broadcast": 0.5, "loss": 0.3},
                "run": {"dt": 0.05, "duration": STEPS * 0.05, "replicas": 2, "seed": 1},
            }
        )
    )


def heard(run: Run, k: int, agent: int) -> list[int]:
    """As the definition of the message says, at random written out in full where nothing was lost."""
    if k == 0:
        return []
    assert run.lost is not None
    gone = run.lost[k - 1, agent - 1].tolist()
    number = len(NEIGHBOURS[run.modes[k - 1]][agent])
    if not any(gone) and k % 2:
        return []
    return [LOST if lost else k - 1 for lost in gone[:number]]


def messages(run: Run, change: Callable[..., AgentState] | None = None) -> list[Message]:
    """What a faithful recorder would have; ``change(state, kind)`` may change states."""
    record: RunRecord = run.record
    out: list[Message] = [("/experiment", STRING, encode_string(record.to_json()))]
    for k in range(STEPS):
        graph = ActiveGraph(k * 50_000_000, record.run.bytes, k, int(run.modes[k]) + 1, "any", k, k)
        out.append(("/graph", ACTIVE_GRAPH, graph.encode()))
    assert run.published is not None
    for k in range(STEPS + 1):
        for i in range(3):
            for kind, values in (("truth", run.states), ("state", run.published)):
                steps = np.array(heard(run, k, i + 1), np.uint64)
                mode = int(run.modes[k - 1]) + 1 if k else 0
                state = AgentState(k * 50_000_000, record.run.bytes, i + 1, k, mode, values[k, i], steps)
                state = change(state, kind) if change else state
                out.append((f"/agent_{i + 1}/{kind}", AGENT_STATE, state.encode()))
    return out


def bag(path: Path, contents: Iterable[Message]) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for topic, kind, data in contents:
            if topic not in channels:
                schema = writer.register_schema(kind.full_name, "ros2msg", kind.schema.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], 0, data, 0)
        writer.finish()
    return path


def same(found: Run, run: Run) -> None:
    for name in ("states", "published", "lost", "modes"):
        assert np.array_equal(getattr(found, name), getattr(run, name)), name
    assert found.completeness == run.completeness
    assert found.completeness.expected == 2 * 3 * (STEPS + 1)


def test_faithful(tmp_path: Path, run: Run) -> None:
    assert run.lost is not None
    assert 0 < run.lost.sum() < 100
    same(read_bag(bag(tmp_path / "x.mcap", messages(run))), run)


def test_written_and_salvaged(tmp_path: Path, run: Run) -> None:
    write_trajectory(run, tmp_path / "bag")
    same(read_bag(tmp_path / "bag"), run)
    salvage(tmp_path / "bag", tmp_path / "again")
    same(read_bag(tmp_path / "again"), run)


@pytest.mark.parametrize("kind", ["truth", "state"])
def test_what_is_missing_on_one_topic_is_missing(tmp_path: Path, run: Run, kind: str) -> None:
    contents = [m for m in messages(run) if m[0] != f"/agent_2/{kind}"]
    found = read_bag(bag(tmp_path / "x.mcap", contents))
    assert found.completeness.missing == STEPS + 1
    assert found.prefix == -1
    assert not found.present[:, 1].any()
    assert found.present[:, [0, 2]].all()


@pytest.mark.parametrize("wrong", [[-1, -1, -1], [None] * 1000, [-2, None], [0, None], [10**12, None]])
def test_what_cannot_have_been_heard_is_refused(tmp_path: Path, run: Run, wrong: list[int | None]) -> None:
    """By agent 2, who has two neighbours, at a step k that the line led to: steps relative to k, None for a loss."""
    k = int(np.flatnonzero(run.modes == 0)[5]) + 1
    steps = np.array([LOST if step is None else k + step for step in wrong], np.uint64)

    def change(state: AgentState, kind: str) -> AgentState:
        return dataclasses.replace(state, heard=steps) if (state.agent, state.step, kind) == (2, k, "truth") else state

    found = read_bag(bag(tmp_path / "x.mcap", messages(run, change)))
    assert found.completeness.refused == {"impossible entry in heard": 1}
    assert found.completeness.missing == 1
    assert np.isnan(found.states[k, 1]).all()
    assert found.prefix == k - 1


def test_copies_that_heard_something_else_contradict(tmp_path: Path, run: Run) -> None:
    k = int(np.flatnonzero(run.modes == 0)[5]) + 1
    state = AgentState(0, run.record.run.bytes, 2, k, 1, run.states[k, 1], np.array([LOST, LOST], np.uint64))
    found = read_bag(bag(tmp_path / "x.mcap", [*messages(run), ("/agent_2/truth", AGENT_STATE, state.encode())]))
    assert found.completeness.duplicates == 1
    assert run.lost is not None
    assert not run.lost[k - 1, 1].all()
    assert found.completeness.refused == {"contradicts an earlier copy": 1}
    assert found.completeness.missing == 1
    assert np.argwhere(np.isnan(found.states).any(axis=2)).tolist() == [[k, 1]]
