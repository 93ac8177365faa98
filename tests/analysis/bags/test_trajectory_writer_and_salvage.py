"""Trajectories as bags, in which order they are written, and bags that were cut anywhere."""

import contextlib
import dataclasses
import io
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.highlevel import AnyReader

from experiments import Completeness, Run, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags import salvage as salvage_module
from msg_analysis.bags.salvage import salvage, salvage_in_place
from msg_analysis.bags.stored_file import Compression, Storage
from msg_analysis.bags.writing import BagWriter
from msg_analysis.errors import BagError, InputError
from msg_analysis.messages.messages import encode_string
from msg_analysis.messages.topics import network_topics

MakeRun = Callable[..., Run]


def _same(one: Run, other: Run) -> None:
    assert one.record.to_json() == other.record.to_json()
    assert np.array_equal(one.states, other.states, equal_nan=True)
    assert np.array_equal(one.modes, other.modes)


def _messages(bag: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([bag]) as reader:
        return [(connection.topic, time, bytes(raw)) for connection, time, raw in reader.messages()]


def test_what_is_missing_stays_missing(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    run.states[7, 1] = np.nan
    run.modes[10:12] = -1
    count = Completeness(expected=123, received=122, missing=1, missing_modes=2)
    write_trajectory(Run(run.record, run.states, run.modes, count), tmp_path / "bag")
    found = read_bag(tmp_path / "bag")
    _same(found, run)
    assert found.completeness == count


def test_store_never_overwrites(tmp_path: Path, make_run: MakeRun) -> None:
    write_trajectory(make_run(), tmp_path / "bag")
    before = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    with pytest.raises(BagError, match="exists already"):
        write_trajectory(make_run(seed=1), tmp_path / "bag")
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == before


def test_a_failed_store_leaves_nothing(tmp_path: Path, make_run: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any) -> None:
        raise BagError("no space")

    monkeypatch.setattr(BagWriter, "write", full)
    with pytest.raises(BagError, match="no space"):
        write_trajectory(make_run(), tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


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


def test_torn_at_every_chunk_and_at_500_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """What is there up to the tear comes back; every tenth, and those at chunks, salvaged and read by rosbags."""
    run, whole = recorded
    data, boundaries = whole.read_bytes(), _boundaries(whole)
    assert len(boundaries) > 5
    everything = _messages(whole.parent)
    cuts = {*boundaries, *(b - 1 for b in boundaries), len(data) - 1, len(data) - 9}
    cuts |= set(random.Random(2).sample(range(len(data)), 500))
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


def test_200_flipped_bytes(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    """A flipped byte costs its chunk, or what is behind it, and never puts a wrong number in."""
    run, whole = recorded
    data, everything = whole.read_bytes(), {(topic, raw) for topic, _, raw in _messages(whole.parent)}
    end = _boundaries(whole)[-1]
    flipped, out, rng = tmp_path / "flipped.mcap", tmp_path / "out", random.Random(3)
    costs = 0
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
    assert costs > 20


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
    places = [*range(chunk.chunk_start_offset + 9, content - chunk.compressed_size, 2)]
    places += range(content, content + chunk.message_index_length, 7)
    assert len(places) > 40
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


def test_run_record_survives_in_the_metadata(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run()
    bag = BagWriter(tmp_path / "bag", network_topics(3), record=run.record.to_json())
    bag.flush()
    found = read_bag(tmp_path / "bag")  # nothing came before the recorder died
    assert found.record.run == run.record.run
    assert found.completeness.missing == found.completeness.expected
    bag.close(complete=False)


def test_salvaged_file_is_valid(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    data = recorded[1].read_bytes()
    (tmp_path / "torn.mcap").write_bytes(data[: len(data) // 2])
    report = salvage(tmp_path / "torn.mcap", tmp_path / "out")
    assert report.torn
    with (tmp_path / "out" / "out_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert sum(1 for _ in reader.iter_messages()) == report.kept_messages
        records = list(reader.iter_metadata())
    assert [record.name for record in records] == ["rosbag2", "msg_agents", "rosbag2"]
    said = yaml.safe_load(records[-1].metadata["serialized_metadata"])  # from which `ros2 bag reindex` takes it
    known = {"run": str(recorded[0].record.run), "complete": "false", "salvaged": "true"}
    assert said["custom_data"] == known
    assert (
        yaml.safe_load((tmp_path / "out/metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
        == known
    )
    with pytest.raises(BagError, match="exists already"):
        salvage(tmp_path / "torn.mcap", tmp_path / "out")
    assert (tmp_path / "torn.mcap").read_bytes() == data[: len(data) // 2]


def _torn_recording(recorded: tuple[Run, Path], directory: Path) -> Path:
    directory.mkdir()
    data = recorded[1].read_bytes()
    (directory / "run_0.mcap").write_bytes(data[: len(data) * 2 // 3])
    (directory / ".recording").write_text('{"pid": 1}')  # of a process that holds no lock any more
    return directory


def test_salvage_in_place(recorded: tuple[Run, Path], tmp_path: Path) -> None:
    directory = _torn_recording(recorded, tmp_path / "run")
    before = read_bag(directory)
    report = salvage_in_place(directory)
    assert {file.name for file in directory.iterdir()} == {"run_0.mcap", "metadata.yaml"}
    _same(read_bag(directory), before)
    assert report.kept_messages == len(_messages(directory))
    with pytest.raises(BagError, match="a bag already"):
        salvage_in_place(directory)


def test_failing_salvage_loses_nothing(
    recorded: tuple[Run, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = _torn_recording(recorded, tmp_path / "run")
    before = {file.name: file.read_bytes() for file in directory.iterdir()}

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr(salvage_module.McapWriter, "finish", full)
        with pytest.raises(BagError, match="nothing was lost"):
            salvage_in_place(directory)
    assert {file.name: file.read_bytes() for file in directory.iterdir()} == before
    assert salvage_in_place(directory).kept_messages


def test_a_living_recording_is_left_alone(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", network_topics(1)) as bag:
        bag.write("/experiment", encode_string("x"), 0)
        with pytest.raises(BagError, match="is recording it"):
            salvage_in_place(tmp_path / "bag")


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_the_order_of_messages(tmp_path: Path, pace: str) -> None:
    """By time, then by step and agent, however late an agent is; the same bytes where few steps are sorted at once."""
    run = simulate(line_ring(noise={"broadcast": 0.1}, run={"dt": 0.1, "duration": 12, "pace": pace}))
    if run.made is not None:
        random = np.random.default_rng(2)
        late = random.exponential(4e8, (121, 3)) * (random.random((121, 3)) < 0.2)
        made = np.maximum.accumulate(run.made + late.astype(np.int64), axis=0) // 50_000_000 * 50_000_000
        made[0] = 0
        made[70, 1] = -1
        for values in (run.states, run.published):
            values[70, 1] = np.nan
        run = dataclasses.replace(run, made=made)
    write_trajectory(run, tmp_path / "whole" / "bag")
    write_trajectory(run, tmp_path / "parts" / "bag", block_numbers=20)
    files = [tmp_path / name / "bag" / "bag_0.mcap" for name in ("whole", "parts")]
    assert files[0].read_bytes() == files[1].read_bytes()
    times = run.made if run.made is not None else np.repeat(np.arange(121)[:, None] * 100_000_000, 3, axis=1)
    cells = sorted((int(times[k, i]), k, i) for k, i in np.ndindex(121, 3) if (k, i) != (70, 1) or pace == "lockstep")
    expected = [(f"/agent_{i + 1}/truth", time) for time, _, i in cells]
    with files[0].open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=False))
    found = [(channel.topic, message.log_time) for _, channel, message in messages if channel.topic.endswith("/truth")]
    assert found == expected
