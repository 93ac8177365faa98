"""What is saved of torn files made by hand, and what is said of it: read by other libraries."""

import json
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard
from full_disk import full_disk
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_by_hand import attachment, by_library, channel, chunk, header, message, metadata, schema, write

from msg_analysis.bags.salvage import SalvageReport, salvage, salvage_in_place
from msg_analysis.bags.writing import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.messages.topics import network_topics

RUN = "00000000-0000-0000-0000-000000000007"
RECORD = json.dumps({"run": RUN, "versions": {"ros_distro": "kilted"}})
QOS = "- history: keep_all\n  depth: 0\n"
STRING = "std_msgs/msg/String"
TOPICS = channel(65535, "/a", 3, offered_qos_profiles=QOS, topic_type_hash="RIHS01_x") + channel(0, "/b", 5)
LOOSE = [header(), schema(5, STRING, "string data"), channel(0, "/b", 5), message(0, b"data", 50)]
TOO_MANY = b"".join(channel(number, f"/t{number}") for number in range(1, 8200))  # not read any further
TORN = [
    header("robot", "somebody"),
    schema(3, STRING, "string data"),
    TOPICS,
    message(0, b"first", 30, 5, 29),
    chunk(message(65535, b"second", 10, 1, 9) + message(0, b"", 20, 6) + message(9, b"of no channel", 1)),
    channel(4, "/silent", 3),
    metadata("another", key="value"),
    metadata("msg_agents", record=RECORD),
    attachment("notes.txt", b"a note", 3, 2),
]
NOTHING = SalvageReport(0, 0, 0, 0, 0, 0, None)


def unended(*records: bytes) -> tuple[int, str]:
    """Bytes of the records behind the magic, and what is said of a file that ends after them."""
    size = 8 + len(b"".join(records))
    return size, f"ends after {size} bytes without a footer"


def content(file: Path) -> dict[str, Any]:
    """All of a file, by mcap's reader with checksums validated."""
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        said, messages = reader.get_header(), reader.iter_messages(log_time_order=False)
        found = {
            "header": (said.profile, said.library),
            "messages": [(of.topic, m.sequence, m.log_time, m.publish_time, m.data) for _, of, m in messages],
            "metadata": [(each.name, each.metadata) for each in reader.iter_metadata()],
            "attachments": [(a.name, a.media_type, a.data, a.log_time) for a in reader.iter_attachments()],
        }
        summary = reader.get_summary()
    schemas = {number: (of.name, of.encoding, of.data) for number, of in summary.schemas.items()}
    topics = [(c.topic, c.message_encoding, schemas.get(c.schema_id), c.metadata) for c in summary.channels.values()]
    compression = {index.compression for index in summary.chunk_indexes}
    return found | {"schemas": list(schemas.values()), "topics": topics, "compression": compression}


def information(bag: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    return found


def described(file: str) -> dict[str, Any]:
    """What metadata.yaml is to say of what is saved of TORN."""
    times = {"starting_time": {"nanoseconds_since_epoch": 10}, "duration": {"nanoseconds": 20}, "message_count": 3}
    cdr = {"serialization_format": "cdr", "offered_qos_profiles": [], "type_description_hash": ""}
    typed = cdr | {"offered_qos_profiles": yaml.safe_load(QOS), "type_description_hash": "RIHS01_x"}
    topics = [({"name": "/b", "type": ""} | cdr, 2), ({"name": "/a", "type": STRING} | typed, 1)]
    topics.append(({"name": "/silent", "type": STRING} | cdr, 0))
    return times | {
        "version": 9,
        "storage_identifier": "mcap",
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": count} for topic, count in topics],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file} | times],
        "custom_data": {"run": RUN, "complete": "false", "salvaged": "true"},
        "ros_distro": "kilted",
    }


def whole(file: Path) -> bytes:
    """Nine messages in chunks of three, written by mcap."""
    messages = [("/a", "", bytes([time]) * 40, 100 + time, time) for time in range(9)]
    return by_library(file, messages, chunk_size=150, compression=CompressionType.NONE).read_bytes()


@pytest.mark.parametrize("in_place", [False, True])
def test_all_that_is_whole_is_saved(in_place: bool, tmp_path: Path) -> None:
    """Messages, topics, metadata, attachments; beside the torn file, which stays, or in its place."""
    torn = tmp_path / "run"
    torn.mkdir()
    write(torn / "run_0.mcap", *TORN, b"\x05\x10\x00")
    before = (torn / "run_0.mcap").read_bytes()
    if in_place:
        (torn / ".recording").write_text('{"pid": 1}')  # of a process that holds no lock any more
        bag, report = torn, salvage_in_place(str(torn))
    else:
        bag, report = tmp_path / "deep/run", salvage(str(torn), str(tmp_path / "deep/run"))
    kept_bytes, said = unended(*TORN)
    assert report == replace(NOTHING, kept_messages=3, kept_bytes=kept_bytes, dropped_bytes=3, torn=said)
    assert {file.name for file in bag.iterdir()} == {"run_0.mcap", "metadata.yaml"}
    assert in_place or [file.name for file in bag.parent.iterdir()] == ["run"]
    assert in_place or (torn / "run_0.mcap").read_bytes() == before
    found = content(bag / "run_0.mcap")
    name, last = found["metadata"].pop()  # from which `ros2 bag reindex` takes it
    assert (name, yaml.safe_load(last["serialized_metadata"])) == ("rosbag2", described("run_0.mcap"))
    assert information(bag) == described("run_0.mcap")
    kind = (STRING, "ros2msg", b"string data")
    assert found == {
        "header": ("robot", "somebody"),
        "messages": [("/b", 5, 30, 29, b"first"), ("/a", 1, 10, 9, b"second"), ("/b", 6, 20, 20, b"")],
        "metadata": [("another", {"key": "value"}), ("msg_agents", {"record": RECORD})],
        "attachments": [("notes.txt", "text/plain", b"a note", 3)],
        "schemas": [kind],
        "topics": [
            ("/b", "cdr", None, {}),
            ("/a", "cdr", kind, {"offered_qos_profiles": QOS, "topic_type_hash": "RIHS01_x"}),
            ("/silent", "cdr", kind, {}),
        ],
        "compression": {"zstd"},
    }
    with pytest.raises(BagError, match="a bag already"):
        salvage_in_place(bag)
    with pytest.raises(BagError, match=f"{bag}: exists already: choose another name"):
        salvage(torn / "run_0.mcap", bag)
    (bag / "metadata.yaml").unlink()
    assert salvage_in_place(bag) == replace(
        NOTHING, kept_messages=3, kept_bytes=(bag / "run_0.mcap").stat().st_size - 8
    )


def sqlite(file: Path) -> bytes:
    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    connection.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr')")
    connection.execute("INSERT INTO messages VALUES (1, 1, 300, x'00')")
    connection.commit()
    connection.close()
    return file.read_bytes()


@pytest.mark.parametrize("in_place", [False, True])
def test_a_bag_of_files_of_every_kind(in_place: bool, tmp_path: Path) -> None:
    """In place, whole and unreadable ones stay as they are, and the others become MCAP of the same name."""
    torn = tmp_path / "x"
    torn.mkdir()
    first = whole(torn / "x_0.mcap")
    write(torn / "x_1.mcap", *LOOSE)
    (torn / "x_2.mcap.zstd").write_bytes(zstandard.compress((torn / "x_1.mcap").read_bytes()))
    rows = sqlite(torn / "x_3.db3")
    (torn / "x_4.db3.zstd").write_bytes(zstandard.compress(rows))
    (torn / "x_5.mcap").write_text("no bag")
    bag = torn if in_place else tmp_path / "out"
    report = salvage_in_place(torn) if in_place else salvage(torn, bag)
    size, said = unended(*LOOSE)
    assert report.kept_messages == 9 + 1 + 1 + 1 + 1
    assert report.kept_bytes == len(first) - 8 + 2 * (size + len(rows))  # without the closing magic; unpacked
    assert (report.dropped_bytes, report.dropped_files, report.torn) == (6, 1, f"{said}; {said}")
    names = [f"{bag.name}_{number}.mcap" for number in range(5)]
    assert information(bag)["relative_file_paths"] == names
    assert [entry["message_count"] for entry in information(bag)["files"]] == [9, 1, 1, 1, 1]
    assert information(bag)["custom_data"] == {"complete": "false", "salvaged": "true"}
    assert {file.name for file in bag.iterdir()} == {*names, "metadata.yaml", *(["x_5.mcap"] if in_place else [])}
    assert (bag / names[0]).read_bytes() == first
    assert content(bag / names[3])["messages"] == [("/a", 0, 300, 300, b"\0")]
    times = [[time for _, _, time, _, _ in content(bag / name)["messages"]] for name in names]
    assert times == [[*range(100, 109)], [50], [50], [300], [300]]


def test_damaged_chunks(tmp_path: Path) -> None:
    """Of 2, 3, 3 and 1 messages; how many were lost, and the topic of the first, the end of the file says."""
    (tmp_path / "x").mkdir()
    for number, lost in enumerate(([4], [6, 8], [1])):
        data = whole(tmp_path / f"x/x_{number}.mcap")
        for time in lost:
            data = data.replace(bytes([time]) * 40, b"?" * 40, 1)
        (tmp_path / f"x/x_{number}.mcap").write_bytes(data)
    report = salvage(tmp_path / "x", tmp_path / "out")
    assert (report.kept_messages, report.lost_messages, report.damaged_chunks) == (18, 9, 4)
    assert (report.dropped_bytes, report.torn) == (0, None)
    for number, kept in enumerate(([0, 1, 5, 6, 7, 8], [0, 1, 2, 3, 4], [2, 3, 4, 5, 6, 7, 8])):
        found = content(tmp_path / f"out/out_{number}.mcap")
        assert found["messages"] == [("/a", 0, 100 + time, time, bytes([time]) * 40) for time in kept]
        assert found["header"] == ("ros2", "theirs")


def test_a_file_that_cannot_be_read_to_its_end(tmp_path: Path) -> None:
    """Its beginning is saved into a new bag; in place it stays, and what it says of the run counts."""
    torn = tmp_path / "x"
    torn.mkdir()
    write(torn / "x_0.mcap", *LOOSE, b"\x05")
    endless = write(torn / "x_1.mcap", *LOOSE, message(0, b"more", 60), metadata("msg_agents", record=RECORD), TOO_MANY)
    before = endless.read_bytes()
    report = salvage(torn, tmp_path / "out")
    assert (report.kept_messages, report.dropped_files, report.lost_messages) == (3, 0, 0)
    assert report.torn == f"{unended(*LOOSE)[1]}; {endless}: more than 8192 topics: record the topics of the run alone"
    assert [each[-1] for each in content(tmp_path / "out/out_1.mcap")["messages"]] == [b"data", b"more"]
    report = salvage_in_place(torn)
    assert (report.kept_messages, report.dropped_files, report.dropped_bytes) == (1, 1, 1 + len(before))
    assert endless.read_bytes() == before
    assert information(torn)["relative_file_paths"] == ["x_0.mcap"]
    assert (information(torn)["custom_data"]["run"], information(torn)["ros_distro"]) == (RUN, "kilted")


@pytest.mark.parametrize(
    "other",
    [
        metadata("msg_agents", record="{"),
        metadata("msg_agents", record="[" * 100_000),
        metadata("msg_agents", record='["run"]'),
        metadata("msg_agents", record='{"versions": {"ros_distro": "x"}}'),
        metadata("msg_agents", text=RECORD),
        metadata("other", record=RECORD),
    ],
    ids=range(6),
)
def test_a_record_that_is_none(other: bytes, tmp_path: Path) -> None:
    """It says nothing of the run; a later one does, as far as it goes."""
    salvage(write(tmp_path / "x.mcap", *LOOSE, other), tmp_path / "out")
    assert information(tmp_path / "out")["custom_data"] == {"complete": "false", "salvaged": "true"}
    assert information(tmp_path / "out")["ros_distro"] == ""
    for number, versions in enumerate(({}, {"versions": []}, {"versions": {}})):
        later = metadata("msg_agents", record=json.dumps({"run": 7} | versions))
        salvage(write(tmp_path / "x.mcap", *LOOSE, other, later), tmp_path / f"{number}")
        assert information(tmp_path / f"{number}")["custom_data"]["run"] == "7"
        assert information(tmp_path / f"{number}")["ros_distro"] == ""


def test_names_that_are_missing(tmp_path: Path) -> None:
    salvage(write(tmp_path / "x.mcap", header("", ""), *LOOSE[1:]), tmp_path / "out")
    assert content(tmp_path / "out/out_0.mcap")["header"] == ("ros2", "mcap")


def test_a_number_that_two_topics_share(tmp_path: Path) -> None:
    """The messages behind the second channel record still count as those of the first topic."""
    records = [channel(1, "/a"), message(1, b"x"), channel(1, "/b"), message(1, b"y")]
    assert salvage(write(tmp_path / "x.mcap", *records), tmp_path / "out").kept_messages == 2
    assert [each[0] for each in content(tmp_path / "out/out_0.mcap")["messages"]] == ["/a", "/a"]
    (counted,) = information(tmp_path / "out")["topics_with_message_count"]
    assert (counted["topic_metadata"]["name"], counted["message_count"]) == ("/a", 2)


def test_many_torn_files(tmp_path: Path) -> None:
    """Of the first ones, up to 500 characters, is said what is there instead of their end."""
    (tmp_path / "x").mkdir()
    files = [[channel(1, "/a"), message(1, bytes(number))] for number in range(15)]
    for number, records in enumerate(files):
        write(tmp_path / f"x/x_{number}.mcap", *records, b"\x05")
    report = salvage(tmp_path / "x", tmp_path / "out")
    assert (report.kept_messages, report.dropped_bytes) == (15, 15)
    assert report.torn == "; ".join([*(unended(*records)[1] for records in files[:14]), "..."])
    (tmp_path / "x/x_14.mcap").unlink()
    report = salvage(tmp_path / "x", tmp_path / "again")
    assert report.torn == "; ".join(unended(*records)[1] for records in files[:14])


def test_a_full_disk(tmp_path: Path) -> None:
    """Nothing is lost, and nothing is left of the attempt."""
    torn = tmp_path / "x"
    torn.mkdir()
    write(torn / "x_0.mcap", header(), TOPICS, message(0))
    write(torn / "x_1.mcap", *TORN)
    before = {file.name: file.read_bytes() for file in torn.iterdir()}
    with full_disk(1600):  # room for the first file
        with pytest.raises(BagError, match=r"out: cannot be written \(File too large\): choose another place"):
            salvage(torn, tmp_path / "out")
        with pytest.raises(BagError, match=r"x: cannot be written \(File too large\): nothing was lost, try again"):
            salvage_in_place(torn)
    assert [file.name for file in tmp_path.iterdir()] == ["x"]
    assert {file.name: file.read_bytes() for file in torn.iterdir()} == before
    assert salvage_in_place(torn).kept_messages == 4


def test_what_cannot_be_salvaged(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    for name in ("x_0", "x_1", "x_2"):
        (tmp_path / f"x/{name}.mcap").write_text("no bag")
    for attempt in (lambda: salvage(tmp_path / "x", tmp_path / "out"), lambda: salvage_in_place(tmp_path / "x")):
        with pytest.raises(BagError, match=r"x_2\.mcap: not an MCAP file"):
            attempt()
    empty = write(tmp_path / "empty.mcap", header(), TOPICS)
    with pytest.raises(BagError, match=r"empty\.mcap: no whole message is left in it: nothing can be salvaged"):
        salvage(empty, tmp_path / "out")
    good = write(tmp_path / "good.mcap", *LOOSE)
    with pytest.raises(BagError, match=r"out: cannot be written \(Not a directory\)"):
        salvage(good, empty / "out")
    assert {file.name for file in tmp_path.iterdir()} == {"x", "empty.mcap", "good.mcap"}


def test_a_living_recording_is_left_alone(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, network_topics(1)):
        for attempt in (
            lambda: salvage_in_place(bag),
            lambda: salvage(bag, tmp_path / "out"),
            lambda: salvage(bag / "bag_0.mcap", tmp_path / "out"),
        ):
            with pytest.raises(BagError, match=r"process \d+ is recording it: stop that first"):
                attempt()
