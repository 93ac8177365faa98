"""Bags of runs that ended early: from hand-made messages, with states and graphs after the end."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.messages import (
    ACTIVE_GRAPH,
    AGENT_STATE,
    PROGRESS,
    STRING,
    ActiveGraph,
    AgentState,
    Progress,
    encode_string,
)
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import Until

MakeRun = Callable[..., Run]
STEP = 50_000_000  # ns


def bag(path: Path, run: Run, ends: Sequence[int], last: Sequence[int]) -> Path:
    """The states of every agent up to its ``last`` step, sojourns of four steps, and messages of these early ends."""
    record = run.record
    messages = [("/experiment", STRING, encode_string(record.to_json()), 0)]
    for number, first in enumerate(range(0, len(run.modes), 4)):
        graph = record.experiment.graph_list[run.modes[first]]
        place = (first, min(first + 3, len(run.modes) - 1), graph.arcs)
        data = ActiveGraph(
            first * STEP, record.run.bytes, number, int(run.modes[first]) + 1, graph.name, *place
        ).encode()
        messages.append(("/graph", ACTIVE_GRAPH, data, first * STEP))
    for k in range(len(run.states)):
        mode = int(run.modes[k - 1]) + 1 if k else 0
        for i in range(run.states.shape[1]):
            if k <= last[i]:
                data = AgentState(k * STEP, record.run.bytes, i + 1, k, mode, run.states[k, i]).encode()
                messages.append((f"/agent_{i + 1}/state", AGENT_STATE, data, k * STEP))
    messages += [("/stop", PROGRESS, Progress(k * STEP, record.run.bytes, 0, k).encode(), k * STEP) for k in ends]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        schemas = {
            kind.full_name: writer.register_schema(kind.full_name, "ros2msg", kind.schema.encode())
            for _, kind, _, _ in messages
        }
        channels = {
            topic: writer.register_channel(topic, "cdr", schemas[kind.full_name]) for topic, kind, _, _ in messages
        }
        for topic, _, data, time in messages:
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


@pytest.fixture
def run(make_run: MakeRun) -> Run:
    """Of 40 steps, which may end early."""
    whole = make_run()
    return dataclasses.replace(whole, record=dataclasses.replace(whole.record, until=Until(0.01)))


@pytest.mark.parametrize("end", [1, 22, 24, 39])
def test_what_comes_after_the_end_does_not_count(tmp_path: Path, run: Run, end: int) -> None:
    found = read_bag(bag(tmp_path / "x.mcap", run, [end, end], [end, 40, end + 1]))
    assert found.record.experiment.steps == end
    assert (found.record.planned_steps, found.record.until) == (40, Until(0.01))
    assert found.completeness.complete
    assert found.completeness.refused == {}
    assert np.array_equal(found.states, run.states[: end + 1])
    assert np.array_equal(found.modes, run.modes[:end])
    write_trajectory(found, tmp_path / "again")
    again = read_bag(tmp_path / "again")
    assert again.completeness.complete
    assert (again.record.planned_steps, again.record.experiment.steps) == (40, end)
    assert np.array_equal(again.states, found.states)


def test_missing_states_before_the_end(tmp_path: Path, run: Run) -> None:
    found = read_bag(bag(tmp_path / "x.mcap", run, [22], [22, 20, 30]))
    assert (found.completeness.missing, found.completeness.expected) == (2, 69)


@pytest.mark.parametrize(
    ("ends", "reason"), [([20, 21], Refusal.CONTRADICTION), ([40], Refusal.OUT_OF_RANGE), ([0], Refusal.OUT_OF_RANGE)]
)
def test_impossible_ends(tmp_path: Path, run: Run, ends: list[int], reason: str) -> None:
    """They do not count: the run has its planned length."""
    found = read_bag(bag(tmp_path / "x.mcap", run, ends, [40, 40, 40]))
    assert found.record.planned is None
    assert found.completeness.complete
    assert found.completeness.refused == {reason: len(ends)}


def test_a_run_that_was_not_to_end_early(tmp_path: Path, make_run: MakeRun) -> None:
    """Somebody else has published on a topic of that name."""
    found = read_bag(bag(tmp_path / "x.mcap", make_run(), [20], [40, 40, 40]))
    assert (found.record.planned, len(found.modes), found.completeness.complete) == (None, 40, True)
