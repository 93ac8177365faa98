"""Bags of ours in every combination of options, read by rosbags and by mcap's own reader with CRCs validated."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from experiments import Run, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags.stored_file import COMPRESSIONS, Compression, Storage
from msg_analysis.errors import InputError

AGENTS, STEPS, REPLICAS = 3, 120, 4
NOISE: dict[str, dict[str, float]] = {
    "none": {},
    "broadcast": {"broadcast": 0.3},
    "loss": {"loss": 0.2},
    "both": {"broadcast": 0.3, "loss": 0.2},
}


@pytest.fixture(scope="module", params=NOISE)
def twin(request: pytest.FixtureRequest) -> Run:
    """A run of the twin, with a second topic of states where they are published with noise."""
    setting = {"duration": STEPS * 0.05, "replicas": REPLICAS, "seed": 5, "start": "zero"}
    return simulate(line_ring(AGENTS, 2.0, name="peers", noise=NOISE[request.param], run=setting))


@pytest.mark.parametrize("split", [None, 3])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_peer_reads_every_bag(
    twin: Run, compression: Compression, split: int | None, tmp_path: Path, typestore: Any
) -> None:
    """Every message, in the order of time, with the right counts and values, in one file or in several."""
    bag = tmp_path / "bag"
    if split is not None:  # so many files
        write_trajectory(twin, tmp_path / "one", Storage(compression, chunk_size=3000))
        split = (tmp_path / "one" / "one_0.mcap").stat().st_size // split
    write_trajectory(twin, bag, Storage(compression, split, 3000))
    files = sorted(bag.glob("*.mcap"), key=lambda file: int(file.stem.removeprefix("bag_")))
    assert [file.name for file in files] == [f"bag_{i}.mcap" for i in range(len(files))]
    assert len(files) in ((1,) if split is None else (2, 3))
    topics = _values(twin, bag, typestore)
    _files(bag, files, compression, topics, split)
    assert {"metadata.yaml", *(file.name for file in files)} == {file.name for file in bag.iterdir()}
    found = read_bag(bag)
    assert np.array_equal(found.states, twin.states)
    assert found.completeness == twin.completeness
    np.testing.assert_array_equal(found.lost, twin.lost)
    np.testing.assert_array_equal(found.published, twin.published)


def _values(twin: Run, bag: Path, typestore: Any) -> Counter[str]:
    """All messages by rosbags, with the definitions in the bag: right values; their numbers by topic."""
    expected = {"state": twin.states if twin.published is None else twin.published, "truth": twin.states}
    found = {kind: np.full_like(states, np.nan) for kind, states in expected.items()}
    count: Counter[str] = Counter()
    modes = np.full_like(twin.modes, -1)
    with AnyReader([bag]) as reader:
        last = 0
        for connection, time, raw in reader.messages():
            assert time >= last
            last = time
            count[connection.topic] += 1
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/graph":
                graph = twin.record.experiment.graph_list[message.mode - 1]
                arcs = zip(message.source, message.target, message.weight, strict=True)
                assert (message.name, [tuple(arc) for arc in arcs]) == (graph.name, graph.arcs)
                modes[message.first_step : message.last_step + 1] = message.mode - 1
            elif connection.topic == "/experiment":
                assert message.data == twin.record.to_json()
            else:
                assert connection.topic.startswith(f"/agent_{message.agent}/")
                found[connection.topic.rsplit("/", 1)[1]][message.step, message.agent - 1] = message.state
                if twin.lost is not None and message.step:
                    gone = twin.lost[message.step - 1, message.agent - 1].sum()
                    assert (message.heard == 2**64 - 1).sum() == gone
        assert reader.message_count == count.total()
        assert {topic: info.msgcount for topic, info in reader.topics.items()} == count
        assert reader.duration == STEPS * 50_000_000 + 1
    with Reader(bag) as plain:
        assert Counter(connection.topic for connection, _, _ in plain.messages()) == count
        for connection in plain.connections:
            assert connection.digest == typestore.hash_rihs01(connection.msgtype)
            assert connection.ext.offered_qos_profiles
    assert np.array_equal(modes, twin.modes)
    assert np.array_equal(found["state"], expected["state"])
    noisy = twin.published is not None
    assert np.array_equal(found["truth"], twin.states) if noisy else np.isnan(found["truth"]).all()
    kinds = ("state", "truth") if noisy else ("state",)
    states = {f"/agent_{i + 1}/{kind}": STEPS + 1 for i in range(AGENTS) for kind in kinds}
    files = len(list(bag.glob("*.mcap")))  # each begins with what is in force
    assert count == states | {"/experiment": files, "/graph": count["/graph"]}
    assert count["/graph"] - int(np.count_nonzero(np.diff(twin.modes))) - 1 in range(2 * files - 1)
    return count


def _files(bag: Path, files: list[Path], compression: Compression, topics: Counter[str], split: int | None) -> None:
    """Each file by mcap's reader, and what metadata.yaml says of it."""
    information = yaml.load((bag / "metadata.yaml").read_text(), yaml.CSafeLoader)["rosbag2_bagfile_information"]
    assert information["message_count"] == topics.total()
    assert information["relative_file_paths"] == [file.name for file in files]
    counted: Counter[str] = Counter()
    sequences: dict[str, list[int]] = {}
    before = -1
    for file, entry in zip(files, information["files"], strict=True):
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            kinds = {index.compression for index in summary.chunk_indexes}
            assert kinds == {"" if compression == "none" else compression}
            # Without the head of a later file, which has the time of its beginning, and states never have.
            begin = -1 if file is files[0] else min(index.message_start_time for index in summary.chunk_indexes)
            body = [index for index in summary.chunk_indexes if index.message_end_time > begin]
            sizes = [index.chunk_length + index.message_index_length for index in body]
            # Nor the one that made it too large, and those that were late.
            assert sum(sizes[:-2]) < (split or 10**9)
            messages = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
            for topic, message in messages:
                if message.publish_time == message.log_time:
                    sequences.setdefault(topic, []).append(message.sequence)
                else:
                    assert message.sequence in sequences[topic]  # repeated
            times = [message.log_time for _, message in messages]
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        assert summary.statistics.message_count == len(messages) == entry["message_count"]
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        assert {channel.topic for channel in summary.channels.values()} == set(topics)
        assert entry["path"] == file.name
        assert min(times) > before
        before = max(times)
        assert entry["starting_time"]["nanoseconds_since_epoch"] == min(times)
        assert entry["duration"]["nanoseconds"] == max(times) - min(times)
        counted.update(topic for topic, _ in messages)
        # Each file says what run it is of, with which software, and what the bag was when it was closed.
        record = json.loads(metadata["msg_agents"]["record"])
        assert record["experiment"]["name"] == "peers"
        assert set(record["versions"]) >= {"msg_analysis", "python", "numpy"}
        closing = yaml.load(metadata["rosbag2"]["serialized_metadata"], yaml.CSafeLoader)
        assert closing["message_count"] == counted.total()
        alone = read_bag(file)
        assert str(alone.record.run) == record["run"]
        if len(messages) > 30:  # more than a step; not the rest in the last file
            assert alone.stretch[0] >= min(times) // 50_000_000
    assert counted == topics
    assert all(numbers == list(range(len(numbers))) for numbers in sequences.values())  # a gap would tell of a loss


def test_storage_refuses_nonsense() -> None:
    with pytest.raises(InputError, match="one of none, zstd, lz4"):
        Storage("zip")
    with pytest.raises(InputError, match="more than 0"):
        Storage(split_size=0)
