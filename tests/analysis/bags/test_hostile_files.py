"""Files that are small, and are meant to take long or to fill the memory; and a share of `make fuzz`."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mcap_by_hand import channel, chunk, header, message, metadata, schema, write

from msg_analysis.bags.files import FileInventory
from msg_analysis.bags.reading import read_bag
from msg_analysis.errors import BagError
from msg_analysis.messages.messages import encode_string

STATE = "msg_agents_interfaces/msg/AgentState"


def _file(path: Path, *records: bytes) -> Path:
    return write(path, header(), schema(1, STATE), *records)


def test_chunks_that_expand_to_fill_the_memory(tmp_path: Path) -> None:
    """A file of 20 kB whose only chunk has 250 MB, all of it messages: one error, before they are looked at."""
    file = _file(tmp_path / "bomb.mcap", chunk(message(1) * (250_000_000 // len(message(1)))))
    assert file.stat().st_size < 50_000
    with pytest.raises(BagError, match=r"bomb.mcap: 238 MB in chunks of \d+ kB: expected at most 1000 times as much"):
        read_bag(file)


def test_too_many_topics(tmp_path: Path) -> None:
    topics = [channel(number, f"/t{number}") for number in range(1, 10_000)]
    for name, records in (("loose", b"".join(topics)), ("chunk", chunk(b"".join(topics)))):
        file = _file(tmp_path / f"{name}.mcap", records)
        with pytest.raises(BagError, match=f"{name}.mcap: more than 8192 topics"):
            read_bag(file)


def test_too_many_run_records(tmp_path: Path) -> None:
    records = b"".join(message(2, encode_string(f'{{"run": "{i}"}}')) for i in range(101))
    file = _file(tmp_path / "x.mcap", schema(2, "std_msgs/msg/String") + channel(2, "/experiment", 2) + records)
    with pytest.raises(BagError, match="more than 100 different messages on the topic `experiment`"):
        read_bag(file)


def test_metadata_in_a_chunk_is_not_kept(tmp_path: Path) -> None:
    """Chunks have messages, channels and schemas; the others could be a thousand times as large as the file."""
    inventory: list[FileInventory] = []
    file = _file(tmp_path / "x.mcap", chunk(metadata("msg_agents") * 1000 + channel(1, "/t") + message(1)))
    with pytest.raises(BagError, match="not a run of msg-agents"):
        read_bag(file, inventory)
    assert inventory[0].file.metadata == []
    assert inventory[0].count.messages == 1


def test_times_that_no_clock_shows(tmp_path: Path) -> None:
    """The error names the damage; before, it said that a topic had not been recorded."""
    file = _file(tmp_path / "x.mcap", chunk(channel(1, "/agent_1/state") + message(1, time=2**64 - 1)) * 2)
    with pytest.raises(BagError, match=r"x.mcap: 2 chunks are damaged \(wrong checksums, or times that no clock shows"):
        read_bag(file)


SCRIPT = Path(__file__).parents[3] / "benchmarks/fuzz.py"


def test_a_share_of_the_fuzzing(tmp_path: Path) -> None:
    """Other seeds than those of `make fuzz`, which begins at 0."""
    numbers = ["--bags", "30", "--experiments", "100", "--logs", "60", "--seed", "1000000", "--jobs", "1", "--no-bombs"]
    command = [sys.executable, str(SCRIPT), *numbers, "--findings", str(tmp_path)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False, env=environment)
    assert result.returncode == 0, result.stderr + result.stdout
    bags, experiments, logs = result.stdout.splitlines()
    assert re.search(r"^bags: 30 damaged: \d+ complete, \d+ incomplete, \d+ refused, 0 findings", bags)
    assert re.search(r"^experiments: 100 damaged: \d+ refused, \d+ valid, 0 findings", experiments)
    assert re.search(r"^logs: 60 damaged: .*\d+ equal, \d+ refused, 0 findings", logs)
    assert list(tmp_path.iterdir()) == []
