"""Files that are small, and are meant to take long or to fill the memory; and a share of `make fuzz`."""

import os
import re
import struct
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader

from msg_analysis.bags.files import FileInventory
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.salvage import salvage, salvage_in_place
from msg_analysis.errors import BagError

STATE = "msg_agents_interfaces/msg/AgentState"


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def _schema(number: int, name: str) -> bytes:
    return _record(3, struct.pack("<H", number) + _text(name) + _text("ros2msg") + struct.pack("<I", 0))


def _channel(number: int, topic: str, schema: int = 1) -> bytes:
    return _record(4, struct.pack("<HH", number, schema) + _text(topic) + _text("cdr") + struct.pack("<I", 0))


def _message(channel: int, data: bytes = b"", time: int = 0) -> bytes:
    return _record(5, struct.pack("<HIQQ", channel, 0, time, time) + data)


def _chunk(records: bytes) -> bytes:
    packed = zstandard.ZstdCompressor(3).compress(records)
    head = struct.pack("<QQQI", 0, 1, len(records), 0) + _text("zstd") + struct.pack("<Q", len(packed))
    return _record(6, head + packed)


def _file(path: Path, records: bytes) -> Path:
    path.write_bytes(b"\x89MCAP0\r\n" + _record(1, _text("ros2") + _text("x")) + _schema(1, STATE) + records)
    return path


def _string(text: str) -> bytes:
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def test_chunks_that_expand_to_fill_the_memory(tmp_path: Path) -> None:
    """A file of 20 kB whose only chunk has 250 MB, all of it messages: one error, before they are looked at."""
    message = _message(1)
    file = _file(tmp_path / "bomb.mcap", _chunk(message * (250_000_000 // len(message))))
    assert file.stat().st_size < 50_000
    with pytest.raises(BagError, match=r"bomb.mcap: 238 MB in chunks of \d+ kB: expected at most 1000 times as much"):
        read_bag(file)


def test_what_is_before_such_a_chunk_is_salvaged(tmp_path: Path) -> None:
    good = _chunk(_channel(1, "/agent_1/state") + _message(1) * 3)
    file = _file(tmp_path / "bomb.mcap", good + _chunk(_message(1) * 8_000_000))
    report = salvage(file, tmp_path / "out")
    assert (report.kept_messages, report.dropped_files, report.damaged_chunks) == (3, 0, 0)
    assert "expected at most 1000 times as much" in (report.torn or "")
    with (tmp_path / "out" / "out_0.mcap").open("rb") as stream:
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == 3


def test_in_place_nothing_of_such_a_file_is_lost(tmp_path: Path) -> None:
    """Another file of the bag is torn, and replaced by what is whole of it."""
    good = _chunk(_channel(1, "/agent_1/state") + _message(1) * 3)
    _file(tmp_path / "a_0.mcap", good)
    bomb = _file(tmp_path / "a_1.mcap", good + _chunk(_message(1) * 8_000_000))
    before = bomb.read_bytes()
    report = salvage_in_place(tmp_path)
    assert (report.kept_messages, report.dropped_files) == (3, 1)
    assert bomb.read_bytes() == before


def test_too_many_topics(tmp_path: Path) -> None:
    topics = [_channel(number, f"/t{number}") for number in range(1, 10_000)]
    for name, records in (("loose", b"".join(topics)), ("chunk", _chunk(b"".join(topics)))):
        file = _file(tmp_path / f"{name}.mcap", records)
        for read in (read_bag, lambda file: salvage(file, tmp_path / "out")):
            with pytest.raises(BagError, match=f"{name}.mcap: more than 8192 topics"):
                read(file)


def test_too_many_run_records(tmp_path: Path) -> None:
    records = b"".join(_message(2, _string(f'{{"run": "{i}"}}')) for i in range(101))
    file = _file(tmp_path / "x.mcap", _schema(2, "std_msgs/msg/String") + _channel(2, "/experiment", 2) + records)
    with pytest.raises(BagError, match="more than 100 different messages on the topic `experiment`"):
        read_bag(file)


def test_metadata_in_a_chunk_is_not_kept(tmp_path: Path) -> None:
    """Chunks have messages, channels and schemas; the others could be a thousand times as large as the file."""
    metadata = _record(12, _text("msg_agents") + struct.pack("<I", 0))
    inventory: list[FileInventory] = []
    with pytest.raises(BagError, match="`experiment` is missing"):
        read_bag(_file(tmp_path / "x.mcap", _chunk(metadata * 1000 + _channel(1, "/t") + _message(1))), inventory)
    assert inventory[0].file.metadata == []
    assert inventory[0].count.messages == 1


def test_times_that_no_clock_shows(tmp_path: Path) -> None:
    """The error names the damage; before, it said that a topic had not been recorded."""
    file = _file(tmp_path / "x.mcap", _chunk(_channel(1, "/agent_1/state") + _message(1, time=2**64 - 1)) * 2)
    with pytest.raises(BagError, match=r"x.mcap: 2 chunks are damaged \(wrong checksums, or times that no clock shows"):
        read_bag(file)


def test_a_number_that_two_topics_share(tmp_path: Path) -> None:
    """The messages behind the second channel record still count as those of the first topic."""
    records = _channel(1, "/a") + _message(1, b"x") + _channel(1, "/b") + _message(1, b"y")
    report = salvage(_file(tmp_path / "x.mcap", records), tmp_path / "out")
    assert report.kept_messages == 2
    with (tmp_path / "out/out_0.mcap").open("rb") as stream:
        topics = Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())
    assert topics == {"/a": 2}


def test_many_torn_files(tmp_path: Path) -> None:
    """What is said of them stays short."""
    (tmp_path / "bag").mkdir()
    for number in range(50):
        _file(tmp_path / f"bag/bag_{number}.mcap", _channel(1, "/a") + _message(1, bytes(number)))
    report = salvage(tmp_path / "bag", tmp_path / "out")
    assert report.kept_messages == 50
    assert report.torn.startswith("ends after")
    assert report.torn.endswith("; ...")
    assert len(report.torn) < 600


SCRIPT = Path(__file__).parents[3] / "benchmarks/fuzz.py"


def test_a_share_of_the_fuzzing(tmp_path: Path) -> None:
    """Other seeds than those of `make fuzz`, which begins at 0."""
    numbers = ["--bags", "30", "--experiments", "100", "--seed", "1000000", "--jobs", "1", "--no-bombs"]
    command = [sys.executable, str(SCRIPT), *numbers, "--findings", str(tmp_path)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False, env=environment)
    assert result.returncode == 0, result.stderr + result.stdout
    bags, experiments = result.stdout.splitlines()
    assert re.search(r"^bags: 30 damaged: \d+ complete, \d+ incomplete, \d+ refused, 0 findings", bags)
    assert re.search(r"^experiments: 100 damaged: \d+ refused, \d+ valid, 0 findings", experiments)
    assert list(tmp_path.iterdir()) == []
