"""Chunks decoded at once, and messages without chunks: against rosbags, and the rules applied one by one."""

import random
import struct
import tracemalloc
import uuid
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_by_hand import MAGIC, chunk_content, record, write

from experiments import Experiment, Run, RunRecord, read_bag, write_trajectory
from msg_analysis.bags.mcap_reading import McapFile, locate, unpack
from msg_analysis.bags.stored_file import DamageError
from msg_analysis.messages.cdr import CdrError
from msg_analysis.messages.messages import AGENT_STATE, STRING, ActiveGraph, AgentState, encode_string

STEPS, AGENTS, WIDTH, LOST = 5, 3, 2, 2**64 - 1
MESSAGE, PRIVATE, FOOTER, HEAD = 5, 0x80, 2, 22
NEIGHBOURS = ([0, 0, 0], [1, 2, 1], [2, 1, 1])  # how many: no graph, line, star
KINDS = ("plain", "loss", "realtime", "late", "hold")
thorough = settings(max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _record(kind: str) -> RunRecord:
    document: dict[str, Any] = {
        "name": kind,
        "graphs": {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 1}}},
        "switching": {"generator": [[-5, 5], [5, -5]]},
        "run": {"dt": 0.05, "duration": STEPS * 0.05, "replicas": WIDTH, "start": "zero"},
    }
    if kind in ("loss", "late", "hold"):
        document["noise"] = {"loss": 0.3, "delay": int(kind == "late"), "on_loss": "hold" if kind == "hold" else "own"}
    if kind == "realtime":
        document["run"]["pace"] = "realtime"
    return RunRecord(uuid.UUID(int=7), Experiment.parse(document), np.zeros((AGENTS, WIDTH)))


RECORDS = {kind: _record(kind) for kind in KINDS}


@st.composite
def _states(draw: st.DrawFn) -> AgentState:
    """Mostly such as belong to the run, often of the same agent and step."""

    def mostly(usual: st.SearchStrategy[Any], rare: st.SearchStrategy[Any]) -> Any:
        return draw(rare) if draw(st.integers(0, 11)) == 0 else draw(usual)

    agent, step = mostly(st.integers(1, 3), st.integers(0, 5)), mostly(st.integers(0, STEPS), st.just(2**64 - 1))
    mode = mostly(st.integers(1, 2) if step else st.just(0), st.integers(0, 3))
    near = st.sampled_from([*[(step - 1) % 2**64, LOST] * 2, max(0, step - 2)])
    length = NEIGHBOURS[min(mode, 2)][min(max(agent, 1), 3) - 1]
    heard = mostly(st.lists(near, min_size=length, max_size=length), st.lists(st.integers(0, LOST), max_size=4))
    state = mostly(
        st.lists(st.sampled_from([0.0, 1.0]), min_size=WIDTH, max_size=WIDTH),
        st.lists(st.sampled_from([0.0, -0.0, 5e-324, np.nan, np.inf]), max_size=3),
    )
    return AgentState(
        stamp=mostly(st.sampled_from([0, 1]), st.integers(-2, 10**15)),
        run=mostly(st.just(RECORDS["plain"].run.bytes), st.sampled_from([bytes(16), bytes(15) + b"\x01"])),
        agent=agent,
        step=step,
        mode=mode,
        state=np.array(state, dtype=float),
        heard=np.array(draw(st.sampled_from([[], heard, heard])), np.uint64),
        frame_id=mostly(st.just(""), st.sampled_from(["m", "map"])),
    )


def _rules(messages: list[Any], kind: str) -> dict[str, Any]:
    """What is to come out of messages in the order of the bag; None is one that cannot be decoded."""
    first: dict[tuple[int, int], Any] = {}
    contradicted: set[tuple[int, int]] = set()
    refused: Counter[str] = Counter()
    duplicates, wrong_stamps = 0, []
    for place, message in enumerate(messages):
        if message is None:
            refused["undecodable"] += 1
            continue
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        heard = [int(step) for step in message.heard]
        expected = NEIGHBOURS[message.mode][message.agent - 1] if message.mode < 3 and 1 <= message.agent <= 3 else 0
        newest = max(0, message.step - 1 - (kind == "late"))
        possible = {"realtime": range(STEPS + 1), "hold": range(min(newest, STEPS) + 1)}.get(kind, [newest])
        possible = [*possible, *([] if kind in ("plain", "hold") else [LOST])]
        silent = not heard and kind != "realtime"
        reasons = {
            "other run": bytes(message.run) != RECORDS[kind].run.bytes,
            "wrong length": len(message.state) != WIDTH,
            "unknown agent": not 1 <= message.agent <= AGENTS,
            "step out of range": message.step > STEPS,
            "unknown mode": message.mode > 2,
            "not finite": not np.isfinite(message.state).all(),
            "stamped before the start": kind == "realtime" and stamp < 0,
            "impossible entry in heard": not silent
            and (len(heard) != expected or any(step not in possible for step in heard)),
        }
        reason = next((reason for reason, holds in reasons.items() if holds), None)
        if reason:
            refused[reason] += 1
            continue
        cell = (message.step, message.agent - 1)
        if kind != "realtime" and stamp != message.step * 50_000_000:
            wrong_stamps.append((*cell, stamp))
        said = [message.state.tolist(), message.mode]
        said += [] if kind == "plain" else [[*heard, 0, 0][:2]]
        said += [stamp] if kind == "realtime" else []
        if cell not in first:
            first[cell] = (place, message, said, heard, stamp)
            continue
        duplicates += 1
        if said != first[cell][2]:
            contradicted.add(cell)
            refused["contradicts an earlier copy"] += 1
    taken = {cell: entry for cell, entry in first.items() if cell not in contradicted}
    shape = (STEPS + 1, AGENTS)
    out: dict[str, Any] = {
        "states": np.full((*shape, WIDTH), np.nan),
        "agent_modes": np.full(shape, -1),
        "used": np.full((*shape, 2), -1) if kind in ("realtime", "late", "hold") else None,
        "made": np.full(shape, -1) if kind == "realtime" else None,
        "lost": np.zeros((*shape, 2), bool) if kind in ("loss", "late", "hold") else None,
        "wrong_stamp": min(wrong_stamps, default=None),
    }
    for cell, (_, message, _, heard, stamp) in taken.items():
        out["states"][cell], out["agent_modes"][cell] = message.state, message.mode - 1
        if kind == "realtime":
            out["made"][cell] = stamp
        newest = max(0, cell[0] - 1 - (kind == "late"))
        count = NEIGHBOURS[message.mode][cell[1]]
        for k, step in enumerate((heard or [newest] * count) if kind != "plain" else []):
            if out["used"] is not None:
                out["used"][(*cell, k)] = -1 if step == LOST else step
            if out["lost"] is not None:
                out["lost"][(*cell, k)] = step != newest
    for name in ("used", "lost"):
        out[name] = None if out[name] is None else out[name][1:]
    out["late"] = sum(
        any(other[1] == cell[1] and other[0] > cell[0] and taken[other][0] < taken[cell][0] for other in taken)
        for cell in taken
    )
    return out | {"received": len(taken), "duplicates": duplicates, "refused": dict(refused)}


@thorough
@given(data=st.data())
def test_random_bags(tmp_path: Path, typestore: Any, data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(KINDS))
    states = data.draw(st.lists(_states(), min_size=1, max_size=40))
    states += [states[i] for i in data.draw(st.lists(st.integers(0, len(states) - 1), max_size=9))]
    raw = []
    for state in states:
        form = data.draw(st.sampled_from(["own"] * 9 + ["big", "padded", "cut"]))
        encoded = state.encode()
        if form == "big":
            message = typestore.deserialize_cdr(encoded, AGENT_STATE.full_name)
            encoded = bytes(typestore.serialize_cdr(message, AGENT_STATE.full_name, little_endian=False))
        raw.append({"padded": encoded + bytes(3), "cut": encoded[:-9]}.get(form, encoded))
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=data.draw(st.sampled_from([64, 400, 2**20])),
            compression=data.draw(st.sampled_from(CompressionType)),
            index_types=data.draw(st.sampled_from([IndexType.NONE, IndexType.ALL])),
            use_chunking=data.draw(st.booleans()),
            enable_crcs=data.draw(st.booleans()),
        )
        writer.start("ros2", "test")
        schema = {t: writer.register_schema(t.full_name, "ros2msg", t.schema.encode()) for t in (AGENT_STATE, STRING)}
        channels = [writer.register_channel(f"/agent_{i}/state", "cdr", schema[AGENT_STATE]) for i in (1, 2, 3)]
        experiment = writer.register_channel("/experiment", "cdr", schema[STRING])
        when = data.draw(st.integers(0, len(raw)))
        for i, encoded in enumerate([*raw, b""]):
            if i == when:
                writer.add_message(experiment, 0, encode_string(RECORDS[kind].to_json()), 0)
            if i < len(raw):
                writer.add_message(channels[i % 3], i, encoded, i)
        writer.finish()

    with path.open("rb") as stream:
        records = list(StreamReader(stream).records)
    stored = [each.data for each in records if isinstance(each, Message) and each.channel_id != experiment]
    assert stored == raw
    decoded = [
        None if len(encoded) < len(state.encode()) else typestore.deserialize_cdr(encoded, AGENT_STATE.full_name)
        for encoded, state in zip(stored, states, strict=True)
    ]
    expected, found = _rules(decoded, kind), read_bag(path)
    for name in ("states", "agent_modes", "used", "made", "lost", "wrong_stamp"):
        np.testing.assert_array_equal(getattr(found, name), expected[name], name)
    count = found.completeness
    assert (count.received, count.duplicates, count.out_of_order) == tuple(
        expected[name] for name in ("received", "duplicates", "late")
    )
    assert count.refused == expected["refused"]


def test_memory_is_that_of_the_result(tmp_path: Path, make_run: Callable[..., Run]) -> None:
    """20 MB of states: nothing beside the result grows with their length, and little with their number."""
    run = make_run(steps=10_000, replicas=64)
    write_trajectory(run, tmp_path / "bag")
    tracemalloc.start()
    try:
        found = read_bag(tmp_path / "bag")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(found.states, run.states)
    result = found.states.nbytes + found.agent_modes.nbytes + found.modes.nbytes
    assert peak - result < 0.5 * result


def test_unpack() -> None:
    records = bytes(range(256)) * 40
    zstd = zstandard.ZstdDecompressor()
    whole = zstandard.ZstdCompressor().compress(records)
    sizeless = zstandard.ZstdCompressor(write_content_size=False).compress(records)
    for name, packed in (("", records), ("zstd", whole), ("zstd", sizeless), ("lz4", lz4.frame.compress(records))):
        assert unpack(chunk_content(records, name, packed), zstd) == records
        assert unpack(chunk_content(records, name, packed, crc=0), zstd) == records
        for wrong in ({"crc": 1}, {"size": 2**40}):
            with pytest.raises(DamageError):
                unpack(chunk_content(records, name, packed, **wrong), zstd)
        with pytest.raises((DamageError, zstandard.ZstdError, RuntimeError)):
            unpack(chunk_content(records, name, packed, packed_size=len(packed) - 9), zstd)
    for length in range(44):
        with pytest.raises((DamageError, struct.error)):
            unpack(chunk_content(records)[:length], zstd)


def test_chunks_that_claim_too_much_are_not_unpacked() -> None:
    bomb = bytes(10**7)
    for name, compress in (("zstd", zstandard.ZstdCompressor().compress), ("lz4", lz4.frame.compress)):
        with pytest.raises(DamageError):
            unpack(chunk_content(bomb, name, compress(bomb), size=9), zstandard.ZstdDecompressor(), limit=10**6)


def _index(*places: int, claimed: int | None = None) -> bytes:
    entries = b"".join(struct.pack("<QQ", 3, place) for place in places)
    return struct.pack("<HI", 1, len(entries) if claimed is None else claimed) + entries


def test_locate_believes_no_index_that_the_records_do_not_bear_out() -> None:
    """The second message looks as if messages began in it."""
    inner = record(MESSAGE, bytes(22)) + record(MESSAGE, bytes(30))
    data = record(MESSAGE, bytes(40)) + record(MESSAGE, inner) + record(MESSAGE, b"x" * 25)
    true = [0, 49, 49 + 9 + len(inner)]

    def found(*index: bytes) -> list[list[int]] | None:
        places = locate(data, index)
        return None if places is None else [column.tolist() for column in places]

    expected = [[place + 9 for place in true], [40, len(inner), 25]]
    assert found(_index(*true)) == expected
    assert found(_index(true[2], true[0]), _index(true[1])) == expected  # each channel has one, in whatever order
    assert found(_index(*true), _index()) == expected
    for wrong in (true[:2], true[1:], [0, *true], [true[0], true[2]], [0, 58, true[2]], [2**64 - 1, *true], [1]):
        assert found(_index(*wrong)) is None, wrong
    for index in ([], [_index()], [_index(*true, claimed=32)], [_index(*true)[:-1]], [b""]):
        assert found(*index) is None
    other = record(4, b"channel")
    for records, places in ((data + other, true), (other, [0]), (data[:-1], true), (b"", [0]), (b"\x05", [0])):
        assert locate(records, [_index(*places)]) is None


def test_the_same_arcs_again_and_arcs_that_are_wrong() -> None:
    """Arcs are read once: at another alignment, in another byte order or after damage they are others."""
    rng = random.Random(1)
    for _ in range(200):
        arcs = tuple((rng.randrange(9), rng.randrange(9), rng.choice([0.5, 2.0])) for _ in range(rng.randrange(3)))
        graph = ActiveGraph(5, bytes(16), 0, 1, "x" * rng.randrange(9), 0, 9, arcs, "y" * rng.randrange(9))
        data = graph.encode()
        assert ActiveGraph.decode(data).arcs == arcs
        if arcs:
            with pytest.raises(CdrError, match=f"the message has {len(data) - 1}"):
                ActiveGraph.decode(data[:-1])
            with pytest.raises(CdrError, match="too many"):
                ActiveGraph.decode(data + bytes(8))


# Runs of equal and of different lengths; of 21 bytes a message is damaged, the other opcode is an application's own.
runs = st.lists(
    st.tuples(st.sampled_from([MESSAGE] * 4 + [PRIVATE]), st.sampled_from([21, 22, 30, 98, 700]), st.integers(1, 60)),
    max_size=12,
)


def _walked(data: bytes) -> tuple[list[bytes], int]:
    """CDR bytes of the whole messages, and where the last whole record ends."""
    at, found = len(MAGIC), []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        if opcode == MESSAGE and length >= HEAD:
            found.append(data[at + 9 + HEAD : at + 9 + length])
        at += 9 + length
    return found, at


def _read_loose(path: Path, **options: int) -> tuple[list[bytes], McapFile]:
    file, found, ends = McapFile(path, **options), [], []
    for batch in file.batches():
        found += [batch.message(index) for index in range(len(batch.start))]
        ends.append(batch.end)
    assert ends == sorted(ends)
    return found, file


@thorough
@given(runs=runs, cut=st.integers(0, 3000), block=st.sampled_from([1, 100, 5000, 2**18]))
def test_runs_of_any_lengths(tmp_path: Path, runs: list[tuple[int, int, int]], cut: int, block: int) -> None:
    """Cut off anywhere, and whatever the size of the blocks in which the file is read."""
    records = [(opcode, size, number) for opcode, size, count in runs for number in range(count)]
    contents = [(opcode, bytes(HEAD)[:size] + bytes([number] * (size - HEAD))) for opcode, size, number in records]
    path = tmp_path / "x.mcap"
    data = MAGIC + b"".join(record(*each) for each in contents)
    data = data[: max(len(MAGIC), len(data) - cut)]
    path.write_bytes(data)
    wanted, end = _walked(data)
    found, file = _read_loose(path, loose=block)
    assert found == wanted
    assert file.whole_bytes == end
    assert file.torn


def test_long_messages(tmp_path: Path) -> None:
    """Longer than what is read at a time, beside short ones; then one that is cut off."""
    sizes = [30, 2**18 - 9, 2**18, 2**20, 40, 40, 2**18 + 1]
    contents = [(MESSAGE, bytes(HEAD) + bytes([i] * (size - HEAD))) for i, size in enumerate(sizes)]
    path = tmp_path / "x.mcap"
    data = write(path, *(record(*each) for each in contents)).read_bytes()
    assert _read_loose(path)[0] == [content[HEAD:] for _, content in contents]
    path.write_bytes(data[:-1])
    found, file = _read_loose(path)
    assert found == [content[HEAD:] for _, content in contents[:-1]]
    assert "cut off" in str(file.torn)


def test_the_end_of_the_file(tmp_path: Path) -> None:
    messages = record(MESSAGE, bytes(98)) * 40
    found, file = _read_loose(write(tmp_path / "x.mcap", messages, record(FOOTER, bytes(20)), MAGIC))
    assert len(found) == 40
    assert file.torn is None
