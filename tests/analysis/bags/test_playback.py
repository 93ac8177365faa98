"""The order in which the messages of a bag are played, against sorting all of them, and against MCAP's own reader."""

import random
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, IndexType
from mcap_by_hand import MAGIC, by_library

from msg_analysis.bags.playback import Playback
from msg_analysis.errors import BagError

QOS = "- history: keep_all\n  reliability: reliable\n  durability: {}\n"


STRING = "std_msgs/msg/String"


def write(path: Path, messages: list[tuple[str, int]], **options: Any) -> None:
    """A file with these messages: topic and log time; their data are their numbers."""
    numbered = [(topic, STRING, number.to_bytes(20, "little"), time) for number, (topic, time) in enumerate(messages)]
    by_library(path, numbered, **{"chunk_size": 200, "compression": CompressionType.ZSTD} | options)


def played(path: Path, *topics: str, until: int = 2**63, **options: int) -> list[tuple[str, int, int]]:
    bag = Playback(path, **options)
    found = bag.messages(topics or list(bag.topics), until)
    return [(message.topic, message.time, int.from_bytes(message.data, "little")) for message in found]


def expected(messages: list[tuple[str, int]]) -> list[tuple[str, int, int]]:
    """By sorting everything at once."""
    newest: dict[str, int] = {}
    order = []
    for number, (topic, time) in enumerate(messages):
        newest[topic] = max(time, newest.get(topic, 0))
        order.append((newest[topic], number, topic))
    return [(topic, time, number) for time, number, topic in sorted(order)]


def disorder(seed: int, spread: int, count: int = 400) -> list[tuple[str, int]]:
    """Times that rise, but for some disorder, and a topic that is far ahead of the others."""
    rng = random.Random(seed)
    messages = [(rng.choice(["/a", "/b", "/c"]), 1000 + 10 * i + rng.randrange(spread)) for i in range(count)]
    for i in range(0, count, 50):
        messages.insert(i, ("/ahead", 1500 + 20 * i))
    return messages


@pytest.mark.parametrize("spread", [1, 60, 2000])
@pytest.mark.parametrize(
    "options", [{}, {"use_chunking": False}, {"use_statistics": False}, {"index_types": IndexType.NONE}]
)
def test_order(tmp_path: Path, spread: int, options: dict[str, Any]) -> None:
    """In chunks, loose, and without a summary that could be relied on."""
    for seed in range(5):
        messages = disorder(seed, spread)
        write(tmp_path / f"{seed}.mcap", messages, **options)
        assert played(tmp_path / f"{seed}.mcap") == expected(messages)


def test_several_files_overlap(tmp_path: Path) -> None:
    messages = disorder(3, 500)
    write(tmp_path / "bag_0.mcap", messages[:150])
    write(tmp_path / "bag_1.mcap", messages[150:200], use_chunking=False)
    write(tmp_path / "bag_2.mcap", messages[200:])
    found = [(topic, time) for topic, time, _ in played(tmp_path)]
    assert found == [(topic, time) for topic, time, _ in expected(messages)]


def test_time_0_is_a_time(tmp_path: Path) -> None:
    """Chunks whose messages are all of time 0 look like empty ones."""
    messages = [("/a", 5), *[("/b", 0)] * 30, ("/a", 6), *[("/c", 0)] * 30]
    write(tmp_path / "bag.mcap", messages)
    assert played(tmp_path / "bag.mcap") == expected(messages)


def test_selection_and_end(tmp_path: Path) -> None:
    messages = disorder(4, 60)
    write(tmp_path / "bag.mcap", messages)
    some = [entry for entry in expected(messages) if entry[0] == "/b" and entry[1] <= 2000]
    assert played(tmp_path / "bag.mcap", "/b", until=2000) == some


def test_a_bag_far_out_of_order_does_not_fill_the_memory(tmp_path: Path) -> None:
    """The last message is the earliest: the order gives way, and nothing is lost."""
    messages = [("/a", 1000 + i) for i in range(300)] + [("/b", 1)]
    write(tmp_path / "bag.mcap", messages)
    found = played(tmp_path / "bag.mcap", most_held=1000)
    assert sorted(found) == sorted(expected(messages))
    assert found[0][0] == "/a"
    assert [entry for entry in found if entry[0] == "/a"] == [entry for entry in expected(messages) if entry[0] == "/a"]


def test_what_is_known_of_a_bag(tmp_path: Path) -> None:
    messages = [("/a", 7), ("/b", 3), ("/a", 9)]
    write(tmp_path / "bag.mcap", messages, qos=QOS.format("transient_local"))
    bag = Playback(tmp_path / "bag.mcap")
    assert (bag.start, bag.end, bag.damage) == (3, 9, [])
    assert {name: (topic.messages, topic.latched) for name, topic in bag.topics.items()} == {
        "/a": (2, True),
        "/b": (1, True),
    }
    assert bag.topics["/a"].type_name == "std_msgs/msg/String"
    assert bag.topics["/a"].encoding == "cdr"


@pytest.mark.parametrize(
    ("qos", "latched"),
    [(QOS.format(1), True), *((qos, False) for qos in ("", QOS.format("volatile"), QOS.format(2), "[", "3"))],
)
def test_latched_in_words_and_numbers(tmp_path: Path, qos: str, latched: bool) -> None:
    write(tmp_path / "bag.mcap", [("/a", 1)], qos=qos)
    assert Playback(tmp_path / "bag.mcap").topics["/a"].latched is latched


def test_torn_and_damaged(tmp_path: Path) -> None:
    """Cut off: what is whole is played. A flipped byte in a chunk: the other chunks are."""
    messages = disorder(5, 1)
    file = tmp_path / "bag.mcap"
    write(file, messages, compression=CompressionType.NONE)
    whole = file.read_bytes()
    order = expected(messages)
    for part in (0.1, 0.3, 0.5):
        file.write_bytes(whole[: int(part * len(whole))])
        bag = Playback(file)
        assert "bag.mcap: " in bag.damage[0]
        found = played(file)
        assert 0 < len(found) < len(order)
        numbers = {number for _, _, number in found}
        assert numbers == set(range(len(numbers)))
        assert found == [entry for entry in order if entry[2] in numbers]
    at = whole.index((100).to_bytes(20, "little"))
    file.write_bytes(whole[:at] + b"\xff" + whole[at + 1 :])
    bag = Playback(file)
    found = [int.from_bytes(message.data, "little") for message in bag.messages(list(bag.topics), bag.end)]
    assert bag.damage == [f"{file}: damaged chunks that are left out: 1"]
    assert 100 not in found
    assert len(messages) - 10 < len(found) < len(messages)


def test_nothing_to_play(tmp_path: Path) -> None:
    write(tmp_path / "bag.mcap", [])
    with pytest.raises(BagError, match=r"bag\.mcap: has no messages: there is nothing to play"):
        Playback(tmp_path / "bag.mcap")
    with pytest.raises(BagError, match="not found"):
        Playback(tmp_path / "none")


def test_two_types_on_a_topic(tmp_path: Path) -> None:
    by_library(tmp_path / "bag.mcap", [("/a", "one/msg/A", b"", 1), ("/a", "two/msg/B", b"", 1)])
    with pytest.raises(BagError, match="topic /a: its messages are one/msg/A and two/msg/B"):
        Playback(tmp_path / "bag.mcap")


@pytest.mark.parametrize("kind", ["std_msgs::msg::dds_::String_", "std_msgs/msg/dds_/String_", "std_msgs/String"])
def test_names_of_dds(tmp_path: Path, kind: str) -> None:
    """Topics and types have the names that ROS 2 gives them; a channel without a type has that of its topic."""
    names = [("rt/a/b", ""), ("/a/b", kind), ("rt/a/b", kind), ("a/c", "")]
    by_library(tmp_path / "bag.mcap", [(*name, bytes([number]), number) for number, name in enumerate(names)])
    bag = Playback(tmp_path)
    assert {name: topic.type_name for name, topic in bag.topics.items()} == {"/a/b": "std_msgs/msg/String", "/a/c": ""}
    found = [(message.topic, message.data[0]) for message in bag.messages(["/a/b"])]
    assert found == [("/a/b", 0), ("/a/b", 1), ("/a/b", 2)]


@pytest.mark.parametrize("flipped", [0x01, 0x40, 0x80])
def test_a_length_beyond_the_file(tmp_path: Path, flipped: int) -> None:
    """A flipped bit in the length of an index record costs nothing; in that of a chunk, the chunk, and it is said."""
    messages = [("/a", 1000 + i) for i in range(100)]
    path = tmp_path / "x.mcap"
    for records, lost in ((10, 0), (11, 4)):
        write(path, messages)
        data = bytearray(path.read_bytes())
        at = 8
        for _ in range(records):
            at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        data[at + 8] ^= flipped
        path.write_bytes(data)
        found = played(path)
        assert len(found) == 100 - lost
        assert set(found) <= set(expected(messages))
        assert Playback(path).damage == [f"{path}: damaged chunks that are left out: 1"][: lost // 4]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("b_2.mcap", b""),
        ("b_2.mcap", bytes(5000)),
        ("._b_0.mcap", b"\0\5\26\7Mac OS X"),
        ("b_2.db3", b""),
        ("b_2.db3", b"x" * 99),
        ("b_2.mcap.zstd", b"no frame"),
        ("b_2.mcap", MAGIC),
        ("0.db3.zstd", bytes(99)),
    ],
)
def test_one_file_that_cannot_be_read(tmp_path: Path, name: str, content: bytes) -> None:
    """The others are played, and the file is named."""
    messages = [("/a", 1000 + i) for i in range(30)]
    write(tmp_path / "b_1.mcap", messages)
    (tmp_path / name).write_bytes(content)
    bag = Playback(tmp_path)
    assert [message.topic for message in bag.messages(set(bag.topics))] == ["/a"] * 30
    (line,) = bag.damage
    assert str(tmp_path / name) in line
    (tmp_path / "b_1.mcap").unlink()
    with pytest.raises(BagError):
        Playback(tmp_path)
