"""Bags in sqlite3, made by hand in the schemas of rosbag2's versions, and by rosbags: read, played, salvaged."""

import contextlib
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zstandard
from programs import call
from rosbags.highlevel import AnyReader

from experiments import Run, read_bag, write_trajectory
from msg_analysis.bags.files import stored_file
from msg_analysis.bags.playback import Playback
from msg_analysis.bags.salvage import salvage
from msg_analysis.errors import BagError
from msg_analysis.report.documents import describe_bag

MakeRun = Callable[..., Run]
Message = tuple[str, str, int, bytes]  # topic, type, time, data
TOPICS = {  # columns by version: of Foxy (1), Galactic and Humble (2, 3), Iron, Jazzy and later (4)
    1: "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL",
    3: "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, "
    "offered_qos_profiles TEXT NOT NULL",
    4: "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, "
    "offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL",
}
MESSAGES = "id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL"
# As rosbag2 writes it: in numbers until version 8 of its metadata, then in words.
QOS = """- history: {0[0]}
  depth: 0
  reliability: {0[1]}
  durability: {0[2]}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: {0[3]}
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false
"""
WORDS = {
    3: ((2, 1, 1, 1), (2, 1, 2, 1)),
    4: [("keep_all", "reliable", w, "automatic") for w in ("transient_local", "volatile")],
}


@pytest.fixture(scope="module")
def ours(make_run: MakeRun) -> Run:
    return make_run(3, 200, 2)


@pytest.fixture(scope="module")
def messages(ours: Run, tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    bag = tmp_path_factory.mktemp("ours") / "bag"
    write_trajectory(ours, bag)
    with AnyReader([bag]) as reader:
        return [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]


def database(file: Path, messages: list[Message], version: int = 4, mode: str = "MEMORY") -> Path:
    connection = sqlite3.connect(file)
    connection.execute(f"PRAGMA journal_mode={mode}")
    connection.execute(f"CREATE TABLE topics({TOPICS[version]})")
    connection.execute(f"CREATE TABLE messages({MESSAGES})")
    connection.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    numbers: dict[str, int] = {}
    for topic, kind, time, data in messages:
        if topic not in numbers:
            numbers[topic] = 10 * len(numbers) + 3
            row: list[Any] = [numbers[topic], topic, kind, "cdr"]
            if version > 1:
                latched = topic in ("/experiment", "/graph")
                row.append(QOS.format(WORDS[version][0 if latched else 1]))
            if version > 3:
                row.append("")
            connection.execute(f"INSERT INTO topics VALUES ({', '.join('?' * len(row))})", row)
        connection.execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", (numbers[topic], time, data))
    connection.commit()
    connection.close()
    return file


@pytest.mark.parametrize("version", TOPICS)
def test_every_version_is_read_and_played(version: int, ours: Run, messages: list[Message], tmp_path: Path) -> None:
    file = database(tmp_path / "theirs_0.db3", messages, version)
    found = read_bag(file)
    assert found.completeness.complete
    assert np.array_equal(found.states, ours.states)
    assert np.array_equal(found.modes, ours.modes)
    playback = Playback(file)
    played = [(message.topic, message.time, message.data) for message in playback.messages(list(playback.topics))]
    assert sorted(played) == sorted((topic, time, data) for topic, _, time, data in messages)
    assert [time for _, time, _ in played] == sorted(time for _, time, _ in played)
    latched = {name for name, topic in playback.topics.items() if topic.latched}
    assert latched == (set() if version == 1 else {"/experiment", "/graph"})
    assert playback.topics["/graph"].type_name == "msg_agents_interfaces/msg/ActiveGraph"


def test_several_files_with_the_names_of_old_versions(ours: Run, messages: list[Message], tmp_path: Path) -> None:
    """Until version 3 of metadata.yaml, names of files begin with that of the bag. Without it, they go by number."""
    bag = tmp_path / "theirs"
    bag.mkdir()
    for number in range(12):
        database(bag / f"theirs_{number}.db3", messages[number::12], 1)
    information = {"version": 3, "storage_identifier": "sqlite3", "compression_format": "", "compression_mode": ""}
    names = [f"theirs/theirs_{number}.db3" for number in range(12)]
    (bag / "metadata.yaml").write_text(
        yaml.safe_dump({"rosbag2_bagfile_information": information | {"relative_file_paths": names}})
    )
    for _ in range(2):
        assert np.array_equal(read_bag(bag).states, ours.states)
        document = describe_bag(bag)
        files = [file["name"] for file in document["files"] if file["name"].endswith(".db3")]
        assert files == [f"theirs_{number}.db3" for number in range(12)]
        assert sum(topic["messages"] for topic in document["topics"]) == len(messages)
        (bag / "metadata.yaml").unlink(missing_ok=True)
    shutil.copy(bag / "theirs_3.db3", tmp_path / "x")
    (bag / "theirs_3.db3").write_bytes((tmp_path / "x").read_bytes()[:5000])
    found = read_bag(bag)
    assert found.completeness.missing > 0
    assert {"torn file", "unreadable file"} & found.completeness.refused.keys()


WRITER = """
import os, signal, sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute("PRAGMA journal_mode=WAL")
connection.execute("PRAGMA wal_autocheckpoint=0")
connection.execute("DELETE FROM messages WHERE id % 2 = 0")
connection.commit()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_log_of_a_killed_recorder_counts(messages: list[Message], tmp_path: Path) -> None:
    """`--storage-preset-profile resilient`: what was committed is in a log beside the file."""
    file = database(tmp_path / "theirs_0.db3", messages)
    killed = subprocess.run([sys.executable, "-c", WRITER, file], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "theirs_0.db3-wal").stat().st_size > 0
    before = file.read_bytes()
    found = read_bag(file)
    assert found.completeness.received == sum(1 for topic, *_ in messages[::2] if topic.endswith("state"))
    assert file.read_bytes() == before


def test_nothing_is_left_beside_a_file_in_wal_mode(ours: Run, messages: list[Message], tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    file = database(tmp_path / "bag/theirs_0.db3", messages, mode="WAL")
    assert np.array_equal(read_bag(file).states, ours.states)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_salvage_makes_mcap_of_it(ours: Run, messages: list[Message], tmp_path: Path) -> None:
    """Also of a file that is cut off, as far as SQLite can read it; others read the new bag."""
    file = database(tmp_path / "theirs_0.db3", messages)
    report = salvage(file, tmp_path / "whole")
    assert (report.kept_messages, report.dropped_bytes, report.torn) == (len(messages), 0, None)
    assert [path.name for path in sorted((tmp_path / "whole").iterdir())] == ["metadata.yaml", "whole_0.mcap"]
    with AnyReader([tmp_path / "whole"]) as reader:
        found = [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]
    assert sorted(found) == sorted(messages)
    assert np.array_equal(read_bag(tmp_path / "whole").states, ours.states)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2] + bytes(4096))
    report = salvage(file, tmp_path / "half")
    assert 0 < report.kept_messages < len(messages)
    assert report.torn is not None
    assert 0 < read_bag(tmp_path / "half").completeness.received < 603


def test_messages_compressed_one_by_one_are_salvaged_unpacked(
    ours: Run, messages: list[Message], tmp_path: Path
) -> None:
    packed = [(topic, kind, time, zstandard.compress(data)) for topic, kind, time, data in messages]
    file = database(tmp_path / "theirs_0.db3", packed)
    salvage(file, tmp_path / "whole")
    with AnyReader([tmp_path / "whole"]) as reader:
        assert sorted(bytes(data) for _, _, data in reader.messages()) == sorted(data for *_, data in messages)


NUMBERED = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i{} FROM n{})"
NO_BAGS: list[tuple[bytes | tuple[str, ...], str]] = [  # of these bytes, or made by these statements
    (b"", "empty: nothing was recorded"),
    (b"SQLite format 3\0" + bytes(4000), "cannot be read"),
    (b"name: line_ring\n" * 300, "cannot be read"),
    (("CREATE TABLE topics(id)",), "not a bag: expected the tables"),
    (
        (
            f"CREATE TABLE topics({TOPICS[1]})",
            f"CREATE VIEW messages AS {NUMBERED.format('', '')} "
            "SELECT i AS rowid, i AS topic_id, i AS timestamp, x'00' AS data FROM n",
        ),
        "not a bag: expected the tables",
    ),
    (
        (
            f"CREATE TABLE topics({TOPICS[1]})",
            f"CREATE TABLE messages({MESSAGES})",
            f"INSERT INTO topics {NUMBERED.format(' + 1', ' LIMIT 9000')} SELECT i, 'a', 'b', 'cdr' FROM n",
        ),
        "more than 8192 topics",
    ),
    (
        (
            f"CREATE TABLE topics({TOPICS[1]})",
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data GENERATED ALWAYS AS (zeroblob(200000000)) VIRTUAL)",
            "INSERT INTO messages VALUES (1, 1, 1), (2, 1, 1), (3, 1, 1), (4, 1, 1)",
        ),
        "made to fill the memory",
    ),
]


@pytest.mark.parametrize(("content", "expected"), NO_BAGS)
def test_files_that_are_no_bags(content: bytes | tuple[str, ...], expected: str, tmp_path: Path) -> None:
    """One error each; as a bag of a command, with exit code 2 and without a traceback."""
    file = tmp_path / "x.db3"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        _made(file, *content)
    for function in (read_bag, Playback):
        with pytest.raises(BagError, match=expected):
            function(file)
    result = call("info", file)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def _made(file: Path, *statements: str) -> None:
    connection = sqlite3.connect(file)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


def test_rows_that_are_no_messages(ours: Run, messages: list[Message], tmp_path: Path) -> None:
    """They are left out and counted, like a message of a topic that is not there; also the last one."""
    file = database(tmp_path / "theirs_0.db3", messages)
    _made(
        file,
        *(
            f"INSERT INTO messages VALUES (NULL, {row})"
            for row in ("3, -1, x'00'", "3, 'noon', x'00'", "3, 1, 'text'", "77, 1, x'00'", "'x', 1.5, 2")
        ),
    )
    found = read_bag(file)
    assert np.array_equal(found.states, ours.states)
    assert found.completeness.refused == {"damaged chunk": 4}


def test_a_hot_journal(ours: Run, messages: list[Message], tmp_path: Path) -> None:
    """Copied while the file was written: rolled back in a copy, and nothing is changed."""
    connection = sqlite3.connect(database(tmp_path / "x.db3", messages))
    for statement in ("journal_mode=DELETE", "cache_size=1"):
        connection.execute(f"PRAGMA {statement}")
    connection.execute("UPDATE messages SET data = zeroblob(3000)")
    (tmp_path / "copy").mkdir()
    for file in tmp_path.glob("x.db3*"):
        shutil.copy(file, tmp_path / "copy")
    connection.close()
    before = {file.name: file.read_bytes() for file in (tmp_path / "copy").iterdir()}
    assert set(before) == {"x.db3", "x.db3-journal"}
    assert np.array_equal(read_bag(tmp_path / "copy").states, ours.states)
    assert {file.name: file.read_bytes() for file in (tmp_path / "copy").iterdir()} == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give up its rights and take them back")
@pytest.mark.parametrize("ends", [["-wal"], ["-wal", "-shm"], ["-journal"]])
def test_what_cannot_be_written(ends: list[str], messages: list[Message]) -> None:
    """Read-only copies from a running recorder, of a user without rights: SQLite would make or mend a file there."""
    with tempfile.TemporaryDirectory() as here, tempfile.TemporaryDirectory() as there, contextlib.ExitStack() as stack:
        connection = sqlite3.connect(database(Path(here) / "x.db3", messages))
        for statement in (f"journal_mode={'WAL' if '-wal' in ends else 'DELETE'}", "cache_size=1"):
            connection.execute(f"PRAGMA {statement}")
        connection.execute("DELETE FROM messages WHERE id > 100")
        if "-wal" in ends:
            connection.commit()
        for end in ("", *ends):
            shutil.copy(f"{here}/x.db3{end}", there)
        connection.close()
        Path(there).chmod(0o555)
        os.seteuid(65534)
        stack.callback(os.seteuid, 0)
        with pytest.raises(PermissionError):
            Path(there, "y").touch()
        found = sum(len(batch.size) for batch in stored_file(Path(there, "x.db3")).batches())
        assert found == (100 if "-wal" in ends else len(messages))
        assert {path.name for path in Path(there).iterdir()} == {f"x.db3{end}" for end in ("", *ends)}


@pytest.mark.parametrize("form", ["{}::msg::dds_::{}_", "{}/{}", "{}::msg::{}", "{}/msg/{}", ""])
def test_names_of_types(form: str, ours: Run, messages: list[Message], tmp_path: Path) -> None:
    """Those of DDS and ROS 1, and none: then the names of the topics count."""
    named = [("rt" + topic, form.format(*kind.split("/msg/")), time, data) for topic, kind, time, data in messages]
    database(tmp_path / "x.db3", named)
    assert np.array_equal(read_bag(tmp_path).states, ours.states)


@pytest.mark.parametrize("identifier", ["storage_identifier: ''", "other: 1"])
def test_no_storage_in_the_metadata(identifier: str, ours: Run, tmp_path: Path) -> None:
    """As after a reindex: the names of the files tell."""
    write_trajectory(ours, tmp_path / "bag")
    file = tmp_path / "bag/metadata.yaml"
    file.write_text(file.read_text().replace("storage_identifier: mcap", identifier))
    assert np.array_equal(read_bag(tmp_path / "bag").states, ours.states)
