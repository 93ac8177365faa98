"""Bags as others record them: analysed as ours are, or refused with the reason. Written by rosbags."""

import itertools
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

from experiments import Run, compare, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags.reading import read_record
from msg_analysis.bags.salvage import salvage
from msg_analysis.bags.stored_file import Storage
from msg_analysis.errors import BagError
from msg_analysis.report.documents import describe_bag

Message = tuple[str, str, bytes]  # topic, type, data
WALL = 1_760_000_000_000_000_000  # ns
Record = Callable[..., Path]


@pytest.fixture(scope="module")
def noisy() -> Run:
    """Long enough for numbers; published with noise, so that there are two topics of states."""
    return simulate(line_ring(3, 2.0, noise={"broadcast": 0.3}, run={"duration": 15, "seed": 5}))


@pytest.fixture(scope="module")
def messages(noisy: Run, tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    bag = tmp_path_factory.mktemp("ours") / "bag"
    write_trajectory(noisy, bag)
    with AnyReader([bag]) as reader:
        return [(c.topic, c.msgtype, bytes(raw)) for c, _, raw in reader.messages()]


@pytest.fixture
def record(messages: list[Message], tmp_path: Path, typestore: Any) -> Record:
    """Record the run again, with rosbags, as of the wall clock: what ``select`` makes of its messages."""

    def record_again(
        select: Callable[[list[Message]], list[Message]] = lambda messages: messages,
        name: str = "theirs",
        compression: CompressionMode = CompressionMode.NONE,
        storage: StoragePlugin = StoragePlugin.MCAP,
    ) -> Path:
        writer = Writer(tmp_path / name, version=9, storage_plugin=storage)
        if compression != CompressionMode.NONE:
            writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for number, (topic, kind, data) in enumerate(select(messages)):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=typestore)
                writer.write(connections[topic], WALL + 1000 * number, data)
        return tmp_path / name

    return record_again


def _shuffled(messages: list[Message]) -> list[Message]:
    return random.Random(1).sample(messages, len(messages))


def _same(found: Run, wanted: Run) -> None:
    assert found.completeness.complete
    assert np.array_equal(found.states, wanted.states)
    assert np.array_equal(found.published, wanted.published)
    assert np.array_equal(found.modes, wanted.modes)


def test_extra_topics_in_a_namespace(noisy: Run, record: Record) -> None:
    """As `ros2 bag record -a` gives them: /rosout, another program's /experiment, states that are none."""
    string = "std_msgs/msg/String"

    def everything(messages: list[Message]) -> list[Message]:
        text = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
        others = [(f"/{name}", string, text) for name in ("chatter", "experiment", "agent_1/state", "camera/state")]
        return others + [("/lab" + topic, kind, data) for topic, kind, data in messages] + others

    bag = record(everything)
    _same(read_bag(bag), noisy)
    topics = {topic["name"]: topic["messages"] for topic in describe_bag(bag)["topics"]}
    assert topics["/chatter"] == 2
    assert topics["/lab/agent_2/truth"] == 301


def test_a_missing_beginning(noisy: Run, record: Record) -> None:
    """No numbers without x(0), but what there is is said. Latched topics are there: they come to who is late."""

    def late(messages: list[Message]) -> list[Message]:
        latched = [message for message in messages if message[0] in ("/experiment", "/graph")]
        return latched + [message for message in messages if message not in latched][6 * 120 :]

    bag = record(late)
    found = read_bag(bag)
    assert found.stretch == (120, 300)
    assert found.prefix == -1
    assert np.array_equal(found.states[120:], noisy.states[120:])
    document = compare(found).to_json()
    assert document["verdict"] == "incomplete"
    assert document["completeness"]["missing"] == 6 * 120
    assert document["completeness"]["stretch"] == [120, 300]
    assert document["system_error"]["measured"] is None
    assert describe_bag(bag)["completeness"]["stretch"] == (120, 300)


def test_a_missing_end(noisy: Run, record: Record) -> None:
    """The numbers are those of the complete beginning."""
    bag = record(lambda messages: [m for m in messages if m[0] in ("/experiment", "/graph")] + messages[: 6 * 220])
    comparison = compare(read_bag(bag))
    document = comparison.to_json()
    assert (document["verdict"], comparison.exit_code) == ("incomplete", 3)
    assert 200 < document["steps"] < 220
    assert document["system_error"]["measured"] > 0


@pytest.mark.parametrize(("topic", "field"), [("truth", "states"), ("state", "published")])
def test_one_of_the_two_topics_is_missing(record: Record, topic: str, field: str) -> None:
    found = read_bag(record(lambda messages: [m for m in messages if not m[0].endswith(topic)]))
    assert found.completeness.missing == 3 * 301
    assert np.isnan(getattr(found, field)).all()
    assert found.prefix == -1
    assert compare(found).verdict == "incomplete"


def test_without_the_experiment(record: Record) -> None:
    """Nobody knows what run it is of: no comparison, but `info` says what is there."""
    bag = record(lambda messages: [m for m in messages if m[0] != "/experiment"])
    with pytest.raises(BagError, match="the latched topic `experiment` is missing"):
        read_bag(bag)
    document = describe_bag(bag)
    assert "latched topic" in document["problem"]
    assert document["run"] is None
    assert {topic["name"]: topic["messages"] for topic in document["topics"]}["/agent_1/state"] == 301
    (file,) = (file for file in document["files"] if file["name"] != "metadata.yaml")
    assert file["start"] == WALL
    assert file["messages"] == sum(topic["messages"] for topic in document["topics"])


STORAGES = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


@pytest.mark.parametrize(
    ("storage", "compression"),
    [*itertools.product(STORAGES, ["NONE", "MESSAGE", "FILE"]), (StoragePlugin.MCAP, "STORAGE")],
)
def test_every_storage_and_compression(noisy: Run, record: Record, storage: StoragePlugin, compression: str) -> None:
    """With metadata.yaml and without, from the directory and from the file: the same run, so compared as ours is."""
    bag = record(_shuffled, compression=CompressionMode[compression], storage=storage)
    _same(read_bag(bag), noisy)
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    _same(read_bag(file), noisy)
    (bag / "metadata.yaml").unlink()
    _same(read_bag(bag), noisy)
    assert read_record(bag).to_json() == noisy.record.to_json()


@pytest.mark.parametrize("storage", STORAGES)
def test_a_message_that_cannot_be_unpacked(
    noisy: Run, record: Record, storage: StoragePlugin, typestore: Any, tmp_path: Path
) -> None:
    """It is refused, and all others are read."""

    def damaged(messages: list[Message]) -> list[Message]:
        packed = [(topic, kind, zstandard.compress(data)) for topic, kind, data in messages]
        topic, kind, data = packed[-1]
        return [*packed[:-1], (topic, kind, data[:-5]), (topic, kind, b"\x28\xb5\x2f\xfd")]

    found = read_bag(record(damaged, storage=storage))
    assert (found.completeness.missing, found.completeness.refused) == (1, {"undecodable": 2})
    assert np.isnan(found.states).sum() + np.isnan(found.published).sum() == 2


def test_messages_made_to_fill_the_memory(record: Record) -> None:
    """A megabyte of messages that unpack to a gigabyte: one error, before that is unpacked."""
    bomb = zstandard.compress(bytes(2**27))

    def bombs(messages: list[Message]) -> list[Message]:
        return [*messages[:100], *[("/agent_1/state", messages[5][1], bomb)] * 80]

    for storage in STORAGES:
        with pytest.raises(BagError, match="made to fill the memory"):
            read_bag(record(bombs, name=storage.name, storage=storage))


def test_split_without_metadata_and_with_a_lost_file(noisy: Run, record: Record, tmp_path: Path) -> None:
    """Files of one recording, the one in the middle lost, one that was just begun when the machine went off."""
    whole = tmp_path / "split"
    whole.mkdir()
    for number in range(11):
        part = record(lambda messages, n=number: messages[n * 180 : (n + 1) * 180], f"part_{number}")
        (file,) = part.glob("*.mcap")
        file.rename(whole / f"split_{number}.mcap")
    _same(read_bag(whole), noisy)
    (whole / "split_5.mcap").rename(tmp_path / "lost")
    (whole / "split_11.mcap").touch()
    found = read_bag(whole)
    assert found.completeness.refused == {"unreadable file": 1}
    assert 0 < found.completeness.missing <= 180
    present = found.present
    assert np.array_equal(found.states[present], noisy.states[present])
    report = salvage(whole, tmp_path / "saved")
    assert report.dropped_files == 1
    again = read_bag(tmp_path / "saved")
    assert again.completeness.refused == {}
    assert again.completeness.received == found.completeness.received


def test_torn_file_that_is_compressed_as_a_whole(noisy: Run, tmp_path: Path) -> None:
    """Cut or flipped: what could be unpacked up to there counts."""
    write_trajectory(noisy, tmp_path / "bag", Storage("none", chunk_size=3000))
    whole = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    frames = [whole[start : start + 10_000] for start in range(0, len(whole), 10_000)]
    data = b"".join(zstandard.ZstdCompressor(write_checksum=True).compress(frame) for frame in frames)
    torn, rng = tmp_path / "torn_0.mcap.zstd", random.Random(4)
    torn.write_bytes(data)
    _same(read_bag(torn), noisy)
    received = []
    for number in range(40):
        place = rng.randrange(len(data))
        flipped = bytes([data[place] ^ 0x55]) + data[place + 1 :]
        torn.write_bytes(data[:place] + (flipped if number % 2 else b""))
        try:
            found = read_bag(torn)
        except BagError:
            assert place < 20_000  # in the run record
            continue
        present = found.present
        assert np.array_equal(found.states[present], noisy.states[present])
        assert found.completeness.refused["torn file"] == 1
        received.append(found.completeness.received)
    assert min(received) < max(received)
