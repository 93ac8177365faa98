"""Bags that were cut or damaged anywhere: what is whole comes back, and no wrong number."""

import contextlib
import itertools
import os
import random
import shutil
import struct
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import CompressionType, IndexType, Writer

from experiments import Run, read_bag, write_trajectory
from msg_analysis.bags.files import stored_file
from msg_analysis.bags.reading import record_document
from msg_analysis.bags.salvage import SalvageReport, salvage
from msg_analysis.bags.stored_file import Compression, Storage
from msg_analysis.errors import BagError

MakeRun = Callable[..., Run]


def contents(file: Path) -> tuple[Summary, list[tuple[str, int, bytes]]]:
    """Summary, and topics, times and bytes of the messages, by mcap's reader with checksums validated."""
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = reader.iter_messages(log_time_order=False)
        return reader.get_summary(), [(channel.topic, m.log_time, m.data) for _, channel, m in found]


def salvaged(damaged: Path, everything: list[tuple[str, int, bytes]]) -> SalvageReport:
    """What is saved of it is what is read of it, and is counted."""
    out = damaged.parent / "out"
    report = salvage(damaged, out)
    _, kept = contents(out / "out_0.mcap")
    lost = len(everything) - len(kept) if report.damaged_chunks and not report.torn else report.lost_messages
    assert (report.kept_messages, report.lost_messages) == (len(kept), lost)
    assert set(kept) <= set(everything)
    one, other = read_bag(out), read_bag(damaged)
    assert one.record.to_json() == other.record.to_json()
    assert np.array_equal(one.states, other.states, equal_nan=True)
    assert np.array_equal(one.modes, other.modes)
    shutil.rmtree(out)
    return report


def right(found: Run, run: Run) -> bool:
    return np.array_equal(found.states[found.present], run.states[found.present])


@pytest.fixture
def recorded(tmp_path: Path, make_run: MakeRun) -> tuple[Run, Path]:
    """A run and its bag of many small chunks."""
    run = make_run()
    write_trajectory(run, tmp_path / "whole", Storage(chunk_size=2000))
    return run, tmp_path / "whole" / "whole_0.mcap"


def test_torn_at_every_chunk_and_at_many_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """What is there up to the tear comes back; of some, and those at chunks, it is salvaged."""
    run, whole = recorded
    data, (summary, everything) = whole.read_bytes(), contents(whole)
    with whole.open("rb") as stream:
        chunks = [each for each in StreamReader(stream, emit_chunks=True).records if isinstance(each, Chunk)]
    records = [breakup_chunk(chunk, validate_crc=True) for chunk in chunks]
    counts = accumulate(sum(isinstance(each, Message) and each.channel_id > 2 for each in chunk) for chunk in records)
    ends = [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]
    states = dict(zip(ends, counts, strict=True))  # up to there; channels 1, 2: experiment, graph
    assert len(states) > 5
    cuts = {*states, *(end - 1 for end in states), len(data) - 1, len(data) - 9}
    cuts |= set(random.Random(2).sample(range(len(data)), 150))
    head = data.index(b"/experiment") - 200  # the run record stands before the topics
    torn, previous = tmp_path / "torn.mcap", -1
    for cut in sorted(cuts):
        torn.write_bytes(data[:cut])
        try:
            found = read_bag(torn)
        except BagError:
            assert cut < head  # before that nobody can know what run it is of
            continue
        assert right(found, run)
        assert found.completeness.refused["torn file"] == 1
        assert found.completeness.received >= previous  # a later tear never loses more
        previous = found.completeness.received
        assert states.get(cut, previous) == previous
    assert previous == 123
    for cut in [*list(states)[::4], *(cut for cut in sorted(cuts)[::10] if cut > min(states))]:
        torn.write_bytes(data[:cut])
        report = salvaged(torn, everything)
        assert report.kept_bytes + report.dropped_bytes == cut


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_damage_around_a_chunk(tmp_path: Path, make_run: MakeRun, compression: Compression) -> None:
    """Head and message indexes of a chunk: others go by what we need not believe. What is salvaged, mcap's can read."""
    write_trajectory(make_run(steps=10), tmp_path / "bag", storage=Storage(compression))
    file = tmp_path / "bag" / "bag_0.mcap"
    data, (summary, everything) = file.read_bytes(), contents(file)
    chunk = summary.chunk_indexes[-1]
    content = chunk.chunk_start_offset + chunk.chunk_length
    places = [*range(chunk.chunk_start_offset + 9, content - chunk.compressed_size, 4)]
    places += range(content, content + chunk.message_index_length, 23)
    assert len(places) > 15
    damaged, count = tmp_path / "damaged.mcap", 0
    for place in places:
        damaged.write_bytes(data[:place] + bytes([data[place] ^ 0x41]) + data[place + 1 :])
        with contextlib.suppress(BagError):
            salvaged(damaged, everything)
            count += 1
    assert count > len(places) // 2


Message4 = tuple[str, int, int, bytes]  # topic, number, time, data
KINDS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "no index": {"compression": CompressionType.ZSTD, "index_types": IndexType.NONE},
    "no CRC": {"compression": CompressionType.ZSTD, "enable_crcs": False},
    "loose": {"use_chunking": False},
}


def of_others(path: Path, rng: random.Random, **options: Any) -> list[Message4]:
    """A file of mcap's writer, with six topics that its first chunk describes; the messages in it."""
    messages = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1500, **options)
        writer.start("ros2", "theirs")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        topics = {
            name: writer.register_channel(name, "cdr", schema, {"q": "x" * 30}) for name in map("/t{}".format, "012345")
        }
        for number in range(300):
            name, data = rng.choice(list(topics)), b"\0\1\0\0" + rng.randbytes(rng.choice([20, 40, 60]))
            time = 1_700_000_000_000_000_000 + number * 1_000_003
            writer.add_message(topics[name], time, data, time, number)
            messages.append((name, number, time, data))
        writer.finish()
    return messages


def records(data: bytes, at: int = 8) -> list[tuple[int, int, int]]:
    """Opcode, start and end of the records that follow each other."""
    found = []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def numbers(data: bytes, opcode: int, start: int, end: int) -> set[int]:
    """Of the messages in a chunk, or of one outside of chunks."""
    if opcode == 5:
        return {struct.unpack_from("<I", data, start + 11)[0]}
    size, (name_size,) = struct.unpack_from("<Q", data, start + 25)[0], struct.unpack_from("<I", data, start + 37)
    name, packed = data[start + 41 : start + 41 + name_size], data[start + 49 + name_size : end]
    if name == b"zstd":
        packed = zstandard.decompress(packed, size)
    inside = lz4.frame.decompress(packed) if name == b"lz4" else packed
    return set().union(*(numbers(inside, *each) for each in records(inside, 0) if each[0] == 5))


def damage(data: bytes, rng: random.Random, *, heads: bool) -> tuple[int, int, bytes]:
    """A stretch, and what is there instead; with ``heads``, of opcodes and lengths only, which no checksum covers."""
    _, start, end = rng.choice(records(data))
    way = rng.randrange(2 if heads else 9)
    if way < 4:
        place = start + [0, rng.randrange(1, 9), rng.randrange(min(60, end - start)), rng.randrange(end - start)][way]
        return place, place + 1, bytes([data[place] ^ 1 << rng.randrange(8)])
    if way == 4:
        place = rng.randrange(len(data) - 37, len(data))  # footer, magic
        return place, place + 1, bytes([data[place] ^ 1 << rng.randrange(8)])
    place, size = rng.randrange(8, len(data)), rng.choice([1, 2, 8, 9, 100, 512, 4096])
    end = min(place + size, len(data))
    ways = [(place, rng.randbytes(size)), (end, b""), (end, bytes(end - place)), (end, rng.randbytes(end - place))]
    return place, *ways[way - 5]


@pytest.mark.parametrize("kind", KINDS)
def test_damage_costs_what_it_touches(kind: str, tmp_path: Path) -> None:
    """Flips, insertions, deletions, zeros: all messages outside damaged chunks are read, and no others.

    40 damages of each kind; STRESS=10 for 2,400. Without checksums, a changed value cannot be told: there, only opcodes
    and lengths are damaged; and one before a damaged message that is not in a chunk may be lost with it.
    """
    rng, path, damaged = random.Random(4), tmp_path / "x.mcap", tmp_path / "damaged.mcap"
    messages = of_others(path, rng, **KINDS[kind])
    data = path.read_bytes()
    units = [
        (start, end, numbers(data, *each)) for each in records(data) if each[0] in (5, 6) for _, start, end in [each]
    ]
    for _ in range(40 * int(os.environ.get("STRESS", "1"))):
        start, end, instead = damage(data, rng, heads=kind in ("no CRC", "loose"))
        damaged.write_bytes(data[:start] + instead + data[end:])
        file, found = stored_file(damaged), []
        with contextlib.suppress(BagError):  # the first bytes
            for batch in file.batches():
                for index, head in enumerate(batch.head.tolist()):
                    found.append((file.channels[head[0]].topic, *head[1:3], batch.message(index)))
        touched = [
            unit
            for unit in units
            if unit[0] < max(end, start + 1) and start < unit[1] and max(start, end - 1) >= unit[0]
        ]
        before = (
            [unit for unit in units if unit[1] == start or unit[1] + 9 > start >= unit[1]] if kind == "loose" else []
        )
        free = {number for unit in [*touched, *before] for number in unit[2]}
        case = (kind, start, end, instead)
        assert len(found) == len(set(found)), case
        assert set(found) <= set(messages), case
        assert {message[1] for message in messages} - free <= {message[1] for message in found}, case
        assert len(found) == len(messages) or file.damaged_chunks or file.torn, case


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none", "no CRC"])
@pytest.mark.parametrize("way", ["ends at a later chunk", "is a message"])
def test_a_chunk_that_looks_whole(kind: str, way: str, tmp_path: Path) -> None:
    """Its length leads to a later chunk, or its opcode is that of a message: it alone is lost, and that is counted."""
    path = tmp_path / "x.mcap"
    messages = of_others(path, random.Random(5), **KINDS[kind])
    data = path.read_bytes()
    chunks = [each for each in records(data) if each[0] == 6]
    for (_, start, end), (_, later, _) in itertools.pairwise(chunks[1:6:2]):
        head = (
            struct.pack("<BQ", 6, later - start - 9)
            if way == "ends at a later chunk"
            else b"\5" + data[start + 1 :][:8]
        )
        path.write_bytes(data[:start] + head + data[start + 9 :])
        file = stored_file(path)
        found = {int(number) for batch in file.batches() for number in batch.head["sequence"]}
        assert {message[1] for message in messages} - found == numbers(data, 6, start, end)
        assert file.damaged_chunks == 1


@pytest.mark.parametrize(
    ("old", "new"),
    [('"seed": 0', '"seed": 1'), ('"seed"', '"seee"'), ("[[", "[{"), ('"run": "0', '"run": "1'), ("0.05", "0.07")],
    ids=["a value", "a key", "no JSON", "the run", "not valid"],
)
def test_a_damaged_copy_of_the_record(old: str, new: str, tmp_path: Path, make_run: MakeRun) -> None:
    """The record in the metadata has no checksum; that on the topic has one, and every command goes by it."""
    run = make_run()
    write_trajectory(run, tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    text = run.record.to_json()
    file.write_bytes(file.read_bytes().replace(text.encode(), text.replace(old, new, 1).encode()))
    salvage(tmp_path / "bag", tmp_path / "out")
    for bag in ("bag", "out"):
        found = read_bag(tmp_path / bag)
        assert found.record.to_json() == text
        assert np.array_equal(found.states, run.states)
        assert found.completeness.refused == {"contradicts the run record": 1}
        assert record_document(tmp_path / bag)["format"] == 1
