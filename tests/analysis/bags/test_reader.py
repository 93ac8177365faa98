"""The reader against bags that other libraries wrote, from hand-made bytes."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.salvage import salvage
from msg_analysis.errors import BagError, InputError
from msg_analysis.inference.verdict import compare
from msg_analysis.messages.messages import ACTIVE_GRAPH, AGENT_STATE, STRING, ActiveGraph, AgentState, encode_string
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import build_model
from msg_analysis.twin.check import check

Message = tuple[str, str, bytes, int]  # topic, type, data, time
MakeRun = Callable[..., Run]


def _state(run: Run, k: int, i: int, /, **changes: Any) -> AgentState:
    mode = 0 if k == 0 else int(run.modes[k - 1]) + 1
    fields = {"stamp": k * 50_000_000, "run": run.record.run.bytes, "agent": i + 1, "step": k, "mode": mode}
    return AgentState(**(fields | {"state": run.states[k, i]} | changes))


def _messages(run: Run, namespace: str = "") -> list[Message]:
    """What a faithful recorder would have: the experiment, a sojourn every four steps, the states."""
    steps, agents, _ = run.states.shape
    out: list[Message] = [(f"{namespace}/experiment", "std_msgs/msg/String", encode_string(run.record.to_json()), 0)]
    for number, first in enumerate(range(0, steps - 1, 4)):
        graph = run.record.experiment.graph_list[run.modes[first]]
        data = ActiveGraph(
            *(first * 50_000_000, run.record.run.bytes, number, int(run.modes[first]) + 1, graph.name),
            *(first, min(first + 3, steps - 2), graph.arcs),
        )
        out.append((f"{namespace}/graph", "msg_agents_interfaces/msg/ActiveGraph", data.encode(), data.stamp))
    for k in range(steps):
        for i in range(agents):
            state = _state(run, k, i)
            out.append((f"{namespace}/agent_{i + 1}/state", AGENT_STATE.full_name, state.encode(), state.stamp))
    return out


def _mcap(path: Path, messages: Iterable[Message], **options: Any) -> Path:
    """A bare MCAP file, written by the mcap library."""
    path.parent.mkdir(parents=True, exist_ok=True)
    types = {kind.full_name: kind for kind in (AGENT_STATE, ACTIVE_GRAPH, STRING)}
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2", "test")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, kind, data, time in messages:
            if kind not in schemas:
                text = types[kind].schema if kind in types else "uint8 data"
                schemas[kind] = writer.register_schema(kind, "ros2msg", text.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def _same(found: Run, run: Run) -> None:
    assert found.record.run == run.record.run
    assert np.array_equal(found.states, run.states)
    assert np.array_equal(found.modes, run.modes)
    assert found.agent_modes is not None
    assert np.array_equal(found.agent_modes[1:], np.repeat(run.modes[:, None], run.states.shape[1], axis=1))
    assert (found.agent_modes[0] == -1).all()


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.STORAGE, CompressionMode.FILE])
def test_bag_of_rosbags(tmp_path: Path, make_run: MakeRun, typestore: Any, mode: CompressionMode) -> None:
    run = make_run()
    writer = RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, data, time in _messages(run):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore)
            writer.write(connections[topic], time, data)
    found = read_bag(tmp_path / "bag")
    _same(found, run)
    assert found.completeness.complete
    assert found.completeness.expected == found.completeness.received == 41 * 3
    assert found.completeness.refused == {}


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"chunk_size": 300, "compression": CompressionType.LZ4},
        {"chunk_size": 300, "compression": CompressionType.NONE, "enable_crcs": False},
    ],
)
def test_bare_mcap_file(tmp_path: Path, make_run: MakeRun, options: dict[str, Any]) -> None:
    run = make_run()
    _same(read_bag(_mcap(tmp_path / "x.mcap", _messages(run), **options)), run)


def test_namespace_foreign_topics_and_split_files(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    messages = _messages(run, "/lab/north")
    foreign = [
        ("/camera/state", "sensor_msgs/msg/Image", b"\x00\x01\x00\x00" + bytes(9), 3),
        ("/agent_1/state", "std_msgs/msg/String", encode_string("not ours"), 3),
        ("/other/experiment", "std_msgs/msg/String", encode_string("{}"), 3),
    ]
    for number, part in enumerate(
        [messages[:30], foreign, messages[30:31], *[[m] for m in messages[31:45]], messages[45:]]
    ):
        _mcap(tmp_path / "bag" / f"bag_{number}.mcap", part)
    _same(read_bag(tmp_path / "bag"), run)


def test_states_with_frame_and_heard_and_in_big_endian(tmp_path: Path, make_run: MakeRun, typestore: Any) -> None:
    run = make_run(steps=8)
    model = build_model(run.record.experiment)
    messages = _messages(run)
    kind = AGENT_STATE.full_name
    for index, (topic, name, data, time) in enumerate(messages):
        if name == kind and index % 2:
            state = AgentState.decode(data)
            neighbours = model.neighbours(state.mode - 1, state.agent - 1) if state.step else ()
            heard = np.full(len(neighbours), max(state.step, 1) - 1, np.uint64)
            other = _state(run, state.step, state.agent - 1, frame_id="map", heard=heard).encode()
            messages[index] = (topic, name, other, time)
        elif name == kind:
            message = typestore.deserialize_cdr(data, kind)
            big = bytes(typestore.serialize_cdr(message, kind, little_endian=False))
            messages[index] = (topic, name, big, time)
    _same(read_bag(_mcap(tmp_path / "x.mcap", messages)), run)


def test_what_is_missing_double_late_or_wrong_is_counted(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    head = [m for m in _messages(run) if m[1] != AGENT_STATE.full_name]
    states = [(k, i) for k in range(41) for i in range(3)]
    states.remove((5, 1))
    states.remove((40, 2))
    late = states.pop(states.index((7, 0)))
    states.insert(states.index((9, 1)), late)  # after (8, 0) and (9, 0)
    states += [(3, 0), (3, 0)]

    def message(k: int, i: int, **changes: Any) -> Message:
        return (f"/agent_{i + 1}/state", AGENT_STATE.full_name, _state(run, k, i, **changes).encode(), k)

    body = [message(k, i) for k, i in states]
    wrong = [
        message(1, 1, agent=9),
        message(1, 1, agent=0),
        message(1, 1, step=41),
        message(1, 1, step=2**64 - 1),
        message(1, 1, mode=3),
        message(1, 1, run=bytes(16)),
        message(1, 1, state=np.ones(5)),
        message(1, 1, state=np.array([np.nan, 0.0])),
        ("/agent_1/state", AGENT_STATE.full_name, b"\x00\x01\x00\x00rubbish", 1),
        ("/graph", ACTIVE_GRAPH.full_name, b"\x00\x01\x00\x00rubbish", 1),
    ]
    found = read_bag(_mcap(tmp_path / "x.mcap", [*head, *wrong, *body]))
    count = found.completeness
    assert (count.expected, count.received, count.missing) == (123, 121, 2)
    assert (count.duplicates, count.out_of_order, count.missing_modes) == (2, 1, 0)
    assert count.refused == {
        "unknown agent": 2,
        "step out of range": 2,
        "unknown mode": 1,
        "other run": 1,
        "wrong length": 1,
        "not finite": 1,
        "undecodable": 2,
    }
    assert not count.complete
    assert np.isnan(found.states[[5, 40], [1, 2]]).all()
    assert found.prefix == 4
    known = found.present
    assert np.array_equal(found.states[known], run.states[known])


def test_order_does_not_matter(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    messages = _messages(run)
    random.Random(1).shuffle(messages)
    found = read_bag(_mcap(tmp_path / "x.mcap", messages, chunk_size=2000))
    _same(found, run)
    arrived: dict[int, int] = {}
    late = 0
    for _, kind, data, _ in messages:
        if kind == AGENT_STATE.full_name:
            state = AgentState.decode(data)
            late += state.step < arrived.get(state.agent, -1)
            arrived[state.agent] = max(state.step, arrived.get(state.agent, -1))
    assert found.completeness.out_of_order == late


def test_contradicting_copies_count_as_missing(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    messages = _messages(run)
    messages.append(("/agent_1/state", AGENT_STATE.full_name, _state(run, 4, 0, state=np.zeros(2)).encode(), 5))
    messages.append(("/agent_2/state", AGENT_STATE.full_name, _state(run, 6, 1).encode(), 5))  # the same again
    found = read_bag(_mcap(tmp_path / "x.mcap", messages))
    assert found.completeness.refused == {"contradicts an earlier copy": 1}
    assert found.completeness.duplicates == 2
    assert found.completeness.missing == 1
    assert np.argwhere(~found.present).tolist() == [[4, 0]]
    assert np.array_equal(found.states[found.present], run.states[found.present])


def test_copies_with_another_graph_contradict(tmp_path: Path, make_run: MakeRun) -> None:
    """A copy that heard what cannot be in such a run is not even a copy: it is refused, and the state stays."""
    run = make_run()
    state = _state(run, 4, 0)
    forged = dataclasses.replace(state, mode=3 - state.mode)
    deaf = dataclasses.replace(_state(run, 5, 1), heard=np.array([0, 0, 0, 0, 0], np.uint64))
    copies = [("/agent_1/state", AGENT_STATE.full_name, forged.encode(), 5)]
    copies += [("/agent_2/state", AGENT_STATE.full_name, deaf.encode(), 5)]
    found = read_bag(_mcap(tmp_path / "x.mcap", _messages(run) + copies))
    assert found.completeness.refused == {"contradicts an earlier copy": 1, "impossible entry in heard": 1}
    assert (found.completeness.duplicates, found.completeness.missing) == (1, 1)
    assert np.argwhere(~found.present).tolist() == [[4, 0]]


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
    found = read_bag(_mcap(tmp_path / "x.mcap", messages))
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
    found = read_bag(_mcap(tmp_path / "other.mcap", changed))
    assert found.completeness.missing_modes == len(run.modes)
    assert found.completeness.refused == {"graph of a step that its states contradict": len(run.modes)}
    assert compare(found).verdict == "incomplete"
    assert check(found).missing == len(run.modes)
    none = read_bag(_mcap(tmp_path / "none.mcap", [message for message in _messages(run) if message[0] != "/graph"]))
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
            read_bag(_mcap(tmp_path / "bag.mcap", [*both, *rest]))


def test_two_runs(tmp_path: Path, make_run: MakeRun) -> None:
    one, two = make_run(seed=1), make_run(seed=2, name="second")
    with pytest.raises(BagError, match="2 runs in one bag") as error:
        read_bag(_mcap(tmp_path / "two.mcap", _messages(one) + _messages(two)))
    assert str(one.record.run) in str(error.value)
    assert "second, 123 states" in str(error.value)
    latched = _messages(two)[:1]  # the topic of a run that was over before the recording began
    found = read_bag(_mcap(tmp_path / "one.mcap", latched + _messages(one)))
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
        read_bag(_mcap(tmp_path / "x.mcap", _messages(run)[1:]))
    bad = [("/experiment", "std_msgs/msg/String", encode_string("{}"), 0), *_messages(run)[1:]]
    with pytest.raises(InputError, match="not a run record"):
        read_bag(_mcap(tmp_path / "y.mcap", bad))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"storage_identifier": "tape"}, "expected mcap or sqlite3"),
        ({"compression_mode": "MESSAGE", "compression_format": "lz4"}, "expected zstd"),
        ({"relative_file_paths": ["gone_0.mcap"]}, "gone_0.mcap"),
        ({"relative_file_paths": []}, "missing"),
    ],
)
def test_metadata_that_cannot_be_used(tmp_path: Path, changes: dict[str, Any], expected: str) -> None:
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        "compression_mode": "",
        "relative_file_paths": ["a"],
    }
    (tmp_path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information | changes}))
    with pytest.raises(BagError, match=expected):
        read_bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(BagError, match="cannot be read"):
        read_bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("[]")
    with pytest.raises(BagError, match="expected the metadata"):
        read_bag(tmp_path)


def test_flipped_bits_cost_a_chunk_at_most(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run(steps=100)
    path = _mcap(tmp_path / "x.mcap", _messages(run), chunk_size=1500, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    victim = _state(run, 50, 1).state.tobytes()
    where = data.index(victim)
    data[where] ^= 1
    path.write_bytes(data)
    found = read_bag(path)
    assert found.completeness.refused == {"damaged chunk": 1}
    assert 0 < found.completeness.missing < 30
    assert np.array_equal(found.states[found.present], run.states[found.present])
