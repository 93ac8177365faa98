"""Bags that were cut or damaged anywhere: what is whole comes back, and no wrong number."""

import contextlib
import io
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.highlevel import AnyReader

from experiments import Run, read_bag, write_trajectory
from msg_analysis.bags.salvage import salvage
from msg_analysis.bags.stored_file import Compression, Storage
from msg_analysis.errors import BagError, InputError

MakeRun = Callable[..., Run]


def _same(one: Run, other: Run) -> None:
    assert one.record.to_json() == other.record.to_json()
    assert np.array_equal(one.states, other.states, equal_nan=True)
    assert np.array_equal(one.modes, other.modes)


def _messages(bag: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([bag]) as reader:
        return [(connection.topic, time, bytes(raw)) for connection, time, raw in reader.messages()]


def _boundaries(file: Path) -> list[int]:
    """Ends of the chunks in a file."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        return [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]


@pytest.fixture
def recorded(tmp_path: Path, make_run: MakeRun) -> tuple[Run, Path]:
    """A run and its bag of many small chunks."""
    run = make_run()
    write_trajectory(run, tmp_path / "whole", Storage(chunk_size=2000))
    return run, tmp_path / "whole" / "whole_0.mcap"


def test_torn_at_every_chunk_and_at_many_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """What is there up to the tear comes back; every tenth, and those at chunks, salvaged and read by rosbags."""
    run, whole = recorded
    data, boundaries = whole.read_bytes(), _boundaries(whole)
    assert len(boundaries) > 5
    everything = _messages(whole.parent)
    cuts = {*boundaries, *(b - 1 for b in boundaries), len(data) - 1, len(data) - 9}
    cuts |= set(random.Random(2).sample(range(len(data)), 200))
    known = {cut: _records(data[:cut]) for cut in boundaries}
    head = data.index(b"/experiment") - 200  # the run record stands before the topics
    torn, out = tmp_path / "torn.mcap", tmp_path / "out"
    previous = -1
    for number, cut in enumerate(sorted(cuts)):
        torn.write_bytes(data[:cut])
        try:
            found = read_bag(torn)
        except BagError:
            assert cut < head  # before that nobody can know what run it is of
            continue
        present = found.present
        assert np.array_equal(found.states[present], run.states[present])
        assert found.completeness.refused["torn file"] == 1
        assert found.completeness.received >= previous  # a later tear never loses more
        previous = found.completeness.received
        if cut in boundaries:  # that chunk is whole
            assert previous == sum(message.channel_id > 2 for message in known[cut])  # 1, 2: experiment, graph
        if cut not in boundaries and number % 10:
            continue
        if cut < boundaries[0]:
            with pytest.raises(BagError, match="no whole message"):
                salvage(torn, out)
            assert not out.exists()
            continue
        report = salvage(torn, out)
        kept = _messages(out)
        assert report.kept_messages == len(kept)
        assert report.kept_bytes + report.dropped_bytes == cut
        assert set(kept) <= set(everything)
        _same(read_bag(out), found)
        shutil.rmtree(out)
    assert previous == 123


def test_flipped_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """A flipped byte costs its chunk, or what is behind it, and never puts a wrong number in."""
    run, whole = recorded
    data, everything = whole.read_bytes(), {(topic, raw) for topic, _, raw in _messages(whole.parent)}
    end = _boundaries(whole)[-1]
    flipped, out, rng = tmp_path / "flipped.mcap", tmp_path / "out", random.Random(3)
    costs = 0
    for number in range(120):
        place = rng.randrange(len(data))
        flipped.write_bytes(data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :])
        try:
            found = read_bag(flipped)
        except InputError as error:
            assert str(flipped) in str(error)  # noqa: PT017
            assert place < end
            continue
        if found.record.to_json() != run.record.to_json():
            continue  # in the uncompressed run record, which has no CRC
        present = found.present
        assert np.array_equal(found.states[present], run.states[present])
        if found.completeness.missing:
            costs += 1
            assert found.completeness.refused
        if number % 10 == 0 and found.completeness.received:
            report = salvage(flipped, out)
            assert report.kept_messages == len(_messages(out))
            assert {(topic, raw) for topic, _, raw in _messages(out)} <= everything
            if report.damaged_chunks and not report.torn:
                assert report.lost_messages == len(everything) - report.kept_messages
            shutil.rmtree(out)
    assert costs > 12


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_damage_around_a_chunk(tmp_path: Path, make_run: MakeRun, compression: Compression) -> None:
    """Head and message indexes of a chunk: others go by what we need not believe. What is salvaged, mcap's can read."""
    run = make_run(steps=10)
    write_trajectory(run, tmp_path / "bag", storage=Storage(compression))
    file = tmp_path / "bag" / "bag_0.mcap"
    data = file.read_bytes()
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = summary.chunk_indexes[-1]
    content = chunk.chunk_start_offset + chunk.chunk_length
    places = [*range(chunk.chunk_start_offset + 9, content - chunk.compressed_size, 3)]
    places += range(content, content + chunk.message_index_length, 17)
    assert len(places) > 30
    salvaged = 0
    for place in places:
        damaged, out = tmp_path / "damaged.mcap", tmp_path / "out"
        damaged.write_bytes(data[:place] + bytes([data[place] ^ 0x41]) + data[place + 1 :])
        with contextlib.suppress(BagError):
            report = salvage(damaged, out)
            with (out / "out_0.mcap").open("rb") as stream:
                kept = list(make_reader(stream, validate_crcs=True).iter_messages())
            assert len(kept) == report.kept_messages
            if report.damaged_chunks and not report.torn:
                assert report.lost_messages == summary.statistics.message_count - len(kept)
            _same(read_bag(out), read_bag(damaged))
            shutil.rmtree(out)
            salvaged += 1
    assert salvaged > len(places) // 2


def _records(data: bytes) -> list[Any]:
    """Messages of the whole chunks, by the mcap library."""
    found: list[Any] = []
    with contextlib.suppress(EndOfFile):
        for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
            if isinstance(record, Chunk):
                found += [r for r in breakup_chunk(record, validate_crc=True) if isinstance(r, Message)]
    return found
