"""The reader against bags that other libraries wrote, from hand-made bytes; also of runs that ended early."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_by_hand import by_library

from experiments import Run, check, compare, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags.salvage import salvage
from msg_analysis.errors import BagError, InputError
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.messages import (
    ACTIVE_GRAPH,
    AGENT_STATE,
    PROGRESS,
    ActiveGraph,
    AgentState,
    Progress,
    encode_string,
)
from msg_analysis.model.run_record import Until

Message = tuple[str, str, bytes, int]  # topic, type, data, time
MakeRun = Callable[..., Run]
STEP = 50_000_000  # ns


def _state(run: Run, k: int, i: int, /, **changes: Any) -> AgentState:
    mode = 0 if k == 0 else int(run.modes[k - 1]) + 1
    fields = {"stamp": k * STEP, "run": run.record.run.bytes, "agent": i + 1, "step": k, "mode": mode}
    return AgentState(**(fields | {"state": run.states[k, i]} | changes))


def _messages(run: Run, namespace: str = "") -> list[Message]:
    """What a faithful recorder would have: the experiment, a holding period every four steps, the states."""
    steps, agents, _ = run.states.shape
    out: list[Message] = [(f"{namespace}/experiment", "std_msgs/msg/String", encode_string(run.record.to_json()), 0)]
    for number, first in enumerate(range(0, steps - 1, 4)):
        graph = run.record.experiment.graph_list[run.modes[first]]
        data = ActiveGraph(
            *(first * STEP, run.record.run.bytes, number, int(run.modes[first]) + 1, graph.name),
            *(first, min(first + 3, steps - 2), graph.arcs),
        )
        out.append((f"{namespace}/graph", "msg_agents_interfaces/msg/ActiveGraph", data.encode(), data.stamp))
    for k in range(steps):
        for i in range(agents):
            state = _state(run, k, i)
            out.append((f"{namespace}/agent_{i + 1}/state", AGENT_STATE.full_name, state.encode(), state.stamp))
    return out


def _same(found: Run, run: Run) -> None:
    assert found.record.run == run.record.run
    assert np.array_equal(found.states, run.states)
    assert np.array_equal(found.modes, run.modes)
    assert np.array_equal(found.agent_modes[1:], np.repeat(run.modes[:, None], run.states.shape[1], axis=1))
    assert (found.agent_modes[0] == -1).all()


def test_what_is_missing(tmp_path: Path, make_run: MakeRun) -> None:
    """Two states, and a holding period that cannot be decoded, which is there a second time."""
    run = make_run()
    lost = [_state(run, k, i).encode() for k, i in ((5, 1), (40, 2))]
    kept = [message for message in _messages(run) if message[2] not in lost]
    found = read_bag(by_library(tmp_path / "x.mcap", [*kept, ("/graph", ACTIVE_GRAPH.full_name, b"rubbish", 1)]))
    count = found.completeness
    assert (count.expected, count.received, count.missing, count.missing_modes) == (123, 121, 2, 0)
    assert count.refused == {"undecodable": 1}
    assert not count.complete
    assert np.isnan(found.states[[5, 40], [1, 2]]).all()
    assert found.prefix == 4
    assert np.array_equal(found.states[found.present], run.states[found.present])


def test_stamps_in_lockstep(tmp_path: Path) -> None:
    """Of two wrong ones, the first step is named by both commands."""
    run = simulate(line_ring(3, 1e-9, run={"duration": 10}))
    wrong = {_state(run, k, i).encode(): _state(run, k, i, stamp=k * STEP + 1).encode() for k, i in ((30, 0), (7, 1))}
    messages = [(topic, kind, wrong.get(data, data), time) for topic, kind, data, time in _messages(run)]
    found = read_bag(by_library(tmp_path / "x.mcap", messages))
    words = "agent 2 at step 7: stamped 0.350000001 s of simulated time, expected 0.35 s"
    assert (found.wrong_stamp, check(found).difference) == ((7, 1, 7 * STEP + 1), words)
    result = compare(found)
    assert (result.verdict, [test.name for test in result.tests if test.rejected]) == ("disagrees", ["stamps"])
    (cause,) = result.causes
    assert (cause.kind, cause.agent, cause.steps, cause.expected) == ("stamps", 2, (7, 7), 0.35)


def test_gaps_and_overlaps_of_sojourns(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    messages = _messages(run)
    graphs = [m for m in messages if m[1] == ACTIVE_GRAPH.full_name]
    messages.remove(graphs[2])  # steps 8..11
    messages.append(graphs[3])  # the same one again: no harm
    overlap = ActiveGraph(0, run.record.run.bytes, 99, 1, "line", 22, 24)  # claims 22..24 as well
    outside = ActiveGraph(0, run.record.run.bytes, 100, 1, "line", 39, 40)
    for graph in (overlap, outside):
        messages.append(("/graph", ACTIVE_GRAPH.full_name, graph.encode(), 0))
    found = read_bag(by_library(tmp_path / "x.mcap", messages))
    unknown = [8, 9, 10, 11, 22, 23, 24]
    assert found.completeness.missing_modes == len(unknown)
    assert np.flatnonzero(found.modes < 0).tolist() == unknown
    assert found.completeness.refused == {"graph out of range": 1}
    assert found.prefix == 8


def test_a_graph_that_the_states_contradict(tmp_path: Path, make_run: MakeRun) -> None:
    """No verdict, and no "equal", on a bag whose graph topic names another graph, or none."""
    run = make_run()
    changed = []
    for topic, kind, data, time in _messages(run):
        if topic == "/graph":
            graph = ActiveGraph.decode(data)
            data = dataclasses.replace(graph, mode=3 - graph.mode).encode()
        changed.append((topic, kind, data, time))
    found = read_bag(by_library(tmp_path / "other.mcap", changed))
    assert found.completeness.missing_modes == len(run.modes)
    assert found.completeness.refused == {"graph of a step that its states contradict": len(run.modes)}
    assert compare(found).verdict == "incomplete"
    assert check(found).missing == len(run.modes)
    none = read_bag(
        by_library(tmp_path / "none.mcap", [message for message in _messages(run) if message[0] != "/graph"])
    )
    assert compare(none).verdict == "incomplete"
    assert check(none).missing == len(run.modes)


def test_two_records_of_one_run(tmp_path: Path, make_run: MakeRun) -> None:
    """One of them is forged: which, nobody can say."""
    run = make_run()
    (topic, kind, _, _), *rest = _messages(run)
    for order in (1, -1):
        texts = [run.record.to_json(), dataclasses.replace(run.record, start=run.record.start + 1).to_json()][::order]
        both = [(topic, kind, encode_string(text), 0) for text in [*texts, texts[0]]]
        with pytest.raises(BagError, match=f"two records of run {run.record.run} contradict each other"):
            read_bag(by_library(tmp_path / "bag.mcap", [*both, *rest]))


def test_two_runs(tmp_path: Path, make_run: MakeRun) -> None:
    one, two = make_run(seed=1), make_run(seed=2, name="second")
    with pytest.raises(BagError, match="2 runs in one bag") as error:
        read_bag(by_library(tmp_path / "two.mcap", _messages(one) + _messages(two)))
    assert str(one.record.run) in str(error.value)
    assert "second, 123 states" in str(error.value)
    latched = _messages(two)[:1]  # the topic of a run that was over before the recording began
    found = read_bag(by_library(tmp_path / "one.mcap", latched + _messages(one)))
    _same(found, one)


def test_no_bag(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    with pytest.raises(BagError, match="not found"):
        read_bag(tmp_path / "nowhere")
    with pytest.raises(BagError, match="empty: its run ended before anything was recorded: delete it"):
        read_bag(tmp_path)
    (tmp_path / "log").mkdir()
    with pytest.raises(BagError, match="empty: its run ended before anything was recorded"):
        salvage(tmp_path, tmp_path / "saved")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(BagError, match="not a bag"):
        read_bag(tmp_path)
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(BagError, match="empty: nothing was recorded"):
        read_bag(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("name: line_ring")
    with pytest.raises(BagError, match="not an MCAP file"):
        read_bag(tmp_path / "text.mcap")
    with pytest.raises(BagError, match="latched topic `experiment` is missing"):
        read_bag(by_library(tmp_path / "x.mcap", _messages(run)[1:]))
    bad = [("/experiment", "std_msgs/msg/String", encode_string("{}"), 0), *_messages(run)[1:]]
    with pytest.raises(InputError, match="not a run record"):
        read_bag(by_library(tmp_path / "y.mcap", bad))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rosbag2_bagfile_information: {storage_identifier: tape}", "expected mcap or sqlite3"),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, compression_mode: FILE, compression_format: lz4}",
            "expected zstd",
        ),
        ("rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [gone.mcap]}", "gone.mcap"),
        ("rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: []}", "every file"),
        ("a: [", "cannot be read"),
        ("[]", "expected the metadata"),
    ],
)
def test_metadata_that_cannot_be_used(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(BagError, match=expected):
        read_bag(tmp_path)


def bag(path: Path, run: Run, ends: Sequence[int], last: Sequence[int]) -> Path:
    """The states of every agent up to its ``last`` step, and messages of these early ends."""
    kept = [m for m in _messages(run) if m[1] != AGENT_STATE.full_name or m[3] <= last[int(m[0][7]) - 1] * STEP]
    stops = [("/stop", PROGRESS.full_name, Progress(k * STEP, run.record.run.bytes, 0, k).encode(), k) for k in ends]
    return by_library(path, kept + stops)


@pytest.fixture
def may_end(make_run: MakeRun) -> Run:
    """Of 40 steps, which may end early."""
    whole = make_run()
    return dataclasses.replace(whole, record=dataclasses.replace(whole.record, until=Until(0.01)))


@pytest.mark.parametrize("end", [1, 22, 24, 39])
def test_what_comes_after_the_end_does_not_count(tmp_path: Path, may_end: Run, end: int) -> None:
    found = read_bag(bag(tmp_path / "x.mcap", may_end, [end, end], [end, 40, end + 1]))
    assert found.record.experiment.steps == end
    assert (found.record.planned_steps, found.record.until) == (40, Until(0.01))
    assert found.completeness.complete
    assert found.completeness.refused == {}
    assert np.array_equal(found.states, may_end.states[: end + 1])
    assert np.array_equal(found.modes, may_end.modes[:end])
    write_trajectory(found, tmp_path / "again")
    again = read_bag(tmp_path / "again")
    assert again.completeness.complete
    assert (again.record.planned_steps, again.record.experiment.steps) == (40, end)
    assert np.array_equal(again.states, found.states)


def test_missing_states_before_the_end(tmp_path: Path, may_end: Run) -> None:
    found = read_bag(bag(tmp_path / "x.mcap", may_end, [22], [22, 20, 30]))
    assert (found.completeness.missing, found.completeness.expected) == (2, 69)


@pytest.mark.parametrize(
    ("ends", "reason"), [([20, 21], Refusal.CONTRADICTION), ([40], Refusal.OUT_OF_RANGE), ([0], Refusal.OUT_OF_RANGE)]
)
def test_impossible_ends(tmp_path: Path, may_end: Run, ends: list[int], reason: str) -> None:
    """They do not count: the run has its planned length."""
    found = read_bag(bag(tmp_path / "x.mcap", may_end, ends, [40, 40, 40]))
    assert found.record.planned is None
    assert found.completeness.complete
    assert found.completeness.refused == {reason: len(ends)}


def test_a_run_that_was_not_to_end_early(tmp_path: Path, make_run: MakeRun) -> None:
    """Somebody else has published on a topic of that name."""
    found = read_bag(bag(tmp_path / "x.mcap", make_run(), [20], [40, 40, 40]))
    assert (found.record.planned, len(found.modes), found.completeness.complete) == (None, 40, True)
