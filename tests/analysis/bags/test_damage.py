"""Bags that were cut or damaged anywhere: what is whole comes back, and no wrong number."""

import contextlib
import random
import shutil
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

from experiments import Run, read_bag, write_trajectory
from msg_analysis.bags.salvage import SalvageReport, salvage
from msg_analysis.bags.stored_file import Compression, Storage
from msg_analysis.errors import BagError, InputError

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
    """What is there up to the tear comes back; of every tenth, and those at chunks, it is salvaged."""
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
    cuts |= set(random.Random(2).sample(range(len(data)), 500))
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
    for cut in [*states, *(cut for cut in sorted(cuts)[::10] if cut > min(states))]:
        torn.write_bytes(data[:cut])
        report = salvaged(torn, everything)
        assert report.kept_bytes + report.dropped_bytes == cut


def test_flipped_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """A flipped byte costs its chunk, or what is behind it, and never puts a wrong number in."""
    run, whole = recorded
    data, (summary, everything) = whole.read_bytes(), contents(whole)
    end = summary.chunk_indexes[-1].chunk_start_offset + summary.chunk_indexes[-1].chunk_length
    flipped, rng, costs = tmp_path / "flipped.mcap", random.Random(3), 0
    for number in range(200):
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
        assert right(found, run)
        assert found.completeness.refused or not found.completeness.missing
        costs += found.completeness.missing > 0
        if number % 10 == 0 and found.completeness.received:
            salvaged(flipped, everything)
    assert costs > 12


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_damage_around_a_chunk(tmp_path: Path, make_run: MakeRun, compression: Compression) -> None:
    """Head and message indexes of a chunk: others go by what we need not believe. What is salvaged, mcap's can read."""
    write_trajectory(make_run(steps=10), tmp_path / "bag", storage=Storage(compression))
    file = tmp_path / "bag" / "bag_0.mcap"
    data, (summary, everything) = file.read_bytes(), contents(file)
    chunk = summary.chunk_indexes[-1]
    content = chunk.chunk_start_offset + chunk.chunk_length
    places = [*range(chunk.chunk_start_offset + 9, content - chunk.compressed_size, 2)]
    places += range(content, content + chunk.message_index_length, 7)
    assert len(places) > 30
    damaged, count = tmp_path / "damaged.mcap", 0
    for place in places:
        damaged.write_bytes(data[:place] + bytes([data[place] ^ 0x41]) + data[place + 1 :])
        with contextlib.suppress(BagError):
            salvaged(damaged, everything)
            count += 1
    assert count > len(places) // 2
