"""Bags of runs in real time, made message by message."""

from __future__ import annotations

import dataclasses
import uuid
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
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord

STEPS, LOST = 40, 2**64 - 1
NEIGHBOURS = ({1: [2], 2: [1, 3], 3: [2]}, {1: [2, 3], 2: [1], 3: [1]})  # of line and star, agents from 1
Message = tuple[str, MessageType, bytes]


@pytest.fixture(scope="module")
def run() -> Run:
    """Random states of random age, late by up to four steps; agents notice a new graph late; no theory in it."""
    experiment = Experiment.parse(
        {
            "name": "real",
            "graphs": {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 1}}},
            "switching": {"generator": [[-5, 5], [5, -5]]},
            "run": {"dt": 0.05, "duration": STEPS * 0.05, "replicas": 2, "start": "zero", "pace": "realtime"},
        }
    )
    rng = np.random.default_rng(3)
    states = rng.standard_normal((STEPS + 1, 3, 2))
    modes = np.repeat(rng.integers(0, 2, STEPS // 4), 4)
    agent_modes = np.full((STEPS + 1, 3), -1)
    agent_modes[1:] = np.where(rng.random((STEPS, 3)) < 0.2, np.roll(modes, 1)[:, None], modes[:, None])
    made = np.zeros((STEPS + 1, 3), dtype=np.int64)
    made[1:] = np.sort((np.arange(STEPS)[:, None] + rng.uniform(0.0, 4.0, (STEPS, 3))) * 50_000_000, axis=0)
    used = np.full((STEPS, 3, 2), -1)
    for k in range(STEPS):
        for i in range(3):
            number = len(NEIGHBOURS[agent_modes[k + 1, i]][i + 1])
            used[k, i, :number] = np.maximum(-1, np.minimum(STEPS, k + rng.integers(-3, 2, number)))
    record = RunRecord(uuid.UUID(int=5), experiment, states[0])
    count = Completeness(3 * (STEPS + 1), 3 * (STEPS + 1), 0)
    return Run(record, states, modes, count, agent_modes, used=used, made=made)


def messages(run: Run, change: Callable[[AgentState], AgentState] | None = None) -> list[Message]:
    """What a faithful recorder would have; ``change`` may change states."""
    assert run.used is not None
    assert run.made is not None
    assert run.agent_modes is not None
    out: list[Message] = [("/experiment", STRING, encode_string(run.record.to_json()))]
    for k in range(STEPS):
        graph = ActiveGraph(k * 50_000_000, run.record.run.bytes, k, int(run.modes[k]) + 1, "any", k, k)
        out.append(("/graph", ACTIVE_GRAPH, graph.encode()))
    for k in range(STEPS + 1):
        for i in range(3):
            mode = int(run.agent_modes[k, i]) + 1
            number = len(NEIGHBOURS[mode - 1][i + 1]) if k else 0
            steps = [LOST if step < 0 else step for step in run.used[k - 1, i, :number].tolist()]
            heard = np.array(steps, np.uint64)
            state = AgentState(int(run.made[k, i]), run.record.run.bytes, i + 1, k, mode, run.states[k, i], heard)
            out.append((f"/agent_{i + 1}/state", AGENT_STATE, (change(state) if change else state).encode()))
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
    for name in ("states", "agent_modes", "modes", "used", "made"):
        assert np.array_equal(getattr(found, name), getattr(run, name)), name
    assert found.completeness == run.completeness
    assert found.lost is None
    assert found.published is None


def test_faithful(tmp_path: Path, run: Run) -> None:
    same(read_bag(bag(tmp_path / "x.mcap", messages(run))), run)


def test_written_and_salvaged(tmp_path: Path, run: Run) -> None:
    write_trajectory(run, tmp_path / "bag")
    same(read_bag(tmp_path / "bag"), run)
    salvage(tmp_path / "bag", tmp_path / "again")
    same(read_bag(tmp_path / "again"), run)


@pytest.mark.parametrize("heard", [[], [3], [3, 3, 3], [3, STEPS + 1], [LOST - 1, 3]])
def test_what_cannot_have_been_heard_is_refused(tmp_path: Path, run: Run, heard: list[int]) -> None:
    """By agent 2 in a step with the line, where it has two neighbours: in real time both are always listed."""
    assert run.agent_modes is not None
    k = int(np.flatnonzero(run.agent_modes[:, 1] == 0)[5])

    def change(state: AgentState) -> AgentState:
        there = (state.agent, state.step) == (2, k)
        return dataclasses.replace(state, heard=np.array(heard, np.uint64)) if there else state

    found = read_bag(bag(tmp_path / "x.mcap", messages(run, change)))
    assert found.completeness.refused == {"impossible entry in heard": 1}
    assert found.completeness.missing == 1
    assert found.made is not None
    assert found.used is not None
    assert found.made[k, 1] == -1
    assert (found.used[k - 1, 1] == -1).all()


def test_stamps(tmp_path: Path, run: Run) -> None:
    """None is before the start; of two copies with different ones none is taken."""

    def change(state: AgentState) -> AgentState:
        return dataclasses.replace(state, stamp=-1) if (state.agent, state.step) == (1, 7) else state

    contents = messages(run, change)
    again = AgentState.decode(contents[-1][2])
    contents.append((contents[-1][0], AGENT_STATE, dataclasses.replace(again, stamp=again.stamp + 1).encode()))
    found = read_bag(bag(tmp_path / "x.mcap", contents))
    assert found.completeness.refused == {"stamped before the start": 1, "contradicts an earlier copy": 1}
    assert found.completeness.duplicates == 1
    assert found.made is not None
    assert found.made[-1, again.agent - 1] == -1
    assert found.completeness.missing == 2
