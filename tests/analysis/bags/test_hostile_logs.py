"""Maps, definitions and messages that nobody should write: one error, soon, or the right numbers. See `make fuzz`."""

import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
import pytest
import yaml
import zstandard
from scipy.linalg import expm

from experiments import line_ring
from msg_analysis.bags.first_map import check_log, first_map
from msg_analysis.bags.log_map import parse_map
from msg_analysis.bags.mapped_log import read_log
from msg_analysis.bags.message_fields import MOST_LEAVES, leaves
from msg_analysis.errors import InputError
from msg_analysis.model.log import Log

LAW = line_ring(3)
START = 1_760_000_000_000_000_000  # ns
LINE = "=" * 80
STAMPED = f"std_msgs/Header header\nfloat64 x\n{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n{LINE}\n"
STAMPED += "MSG: builtin_interfaces/Time\n"
DOCUMENT: dict[str, Any] = {
    "agents": {"*": {"topic": "/tank_{i}", "field": "x"}},
    "time": "log",
    "graph": {"fixed": "ring"},
}


def write(
    file: Path, definition: str, messages: list[bytes], times: list[int] | None = None, encoding: str = "ros2msg"
) -> Path:
    with file.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("lab_msgs/msg/Tank", encoding, definition.encode())
        for i in (1, 2, 3):
            channel = writer.register_channel(f"/tank_{i}", "cdr", schema)
            for k, data in enumerate(messages):
                time = START + (times[k] if times else k * 10**8)
                writer.add_message(channel, time, b"\0\1\0\0" + data, time)
        writer.finish()
    return file


@pytest.mark.parametrize(
    "kind", ["string sec\nuint32 nanosec", "float64 sec\nuint32 nanosec", "uint64 sec\nuint32 nanosec"]
)
def test_a_stamp_of_another_type_is_none(kind: str, tmp_path: Path) -> None:
    """A text times 10^9 would fill the memory."""
    bag = write(tmp_path / "tanks.mcap", STAMPED + kind, [bytes(32)] * 60)
    with pytest.raises(InputError, match="lab_msgs/msg/Tank has no header: expected `time: log`"):
        read_log(bag, parse_map(DOCUMENT | {"time": "header"}, "map"), LAW)


def test_unsigned_numbers_beyond_the_signed_ones(tmp_path: Path) -> None:
    values = [2**64 - 1 if k % 2 else 7 for k in range(60)]
    bag = write(tmp_path / "tanks.mcap", "uint64 x", [struct.pack("<Q", value) for value in values])
    checked = check_log(bag, parse_map(DOCUMENT, "map"))["agents"][0]
    assert (checked["least"], checked["largest"]) == ([7.0], [float(2**64 - 1)])


def test_a_type_with_too_many_numbers() -> None:
    """1000^4 of them: the first ones are listed."""
    fields = {name: (None, [(f"f{k}", (2, inner)) for k in range(1000)]) for name, inner in ("ab", "bc", "cd")}
    types: Any = fields | {"d": (None, [("x", (1, ("float64", 0)))]), "e": (None, [("f", (2, "a"))])}
    found = leaves(types, "e")
    assert 9_000 < len(found) <= MOST_LEAVES
    assert found[0] == ("f.f0.f0.f0.x", "float64")


IDL = "module lab_msgs {{ module msg {{ {} struct Tank {{ {} double x; }}; }}; }};"


def test_expressions_of_idl_are_refused_and_annotations_are_not(tmp_path: Path) -> None:
    """The parser takes 70 times longer for each parenthesis within another one."""
    data = [struct.pack("<d", k) for k in range(60)]
    wrong = IDL.format("const long A = " + "(" * 9 + "1" + ")" * 9 + ";", "")
    with pytest.raises(InputError, match=r"/tank_1: .* has expressions: expected plain numbers"):
        read_log(write(tmp_path / "a.mcap", wrong, data, encoding="ros2idl"), parse_map(DOCUMENT, "map"), LAW)
    right = IDL.format("", '@verbatim (language="comment", text="a (b" "c)") @unit(value="m")')
    log = read_log(write(tmp_path / "b.mcap", right, data, encoding="ros2idl"), parse_map(DOCUMENT, "map"), LAW)
    assert log.states[:, 0, 0].tolist() == list(range(60))


def test_definitions_that_are_too_long(tmp_path: Path) -> None:
    text = IDL.format("".join(f"const long A{k} = 1; " for k in range(12_000)), "")
    bag = write(tmp_path / "tanks.mcap", text, [bytes(8)] * 60, encoding="ros2idl")
    with pytest.raises(InputError, match="its definition, or all before it, are too long to be read"):
        read_log(bag, parse_map(DOCUMENT, "map"), LAW)


def test_messages_that_rosbag2_compressed_in_several_threads(tmp_path: Path) -> None:
    """They are written in the order in which they are done: half a second too late, which is no jump of the clock."""
    order = [*range(20), *range(25, 30), *range(20, 25), *range(30, 60)]
    values = [struct.pack("<d", k) for k in order]
    times = [k * 10**8 for k in order]
    bag = tmp_path / "packed.mcap"
    with bag.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("lab_msgs/msg/Tank", "ros2msg", b"float64 x")
        for i in (1, 2, 3):
            channel = writer.register_channel(f"/tank_{i}", "cdr", schema)
            for time, data in zip(times, values, strict=True):
                packed = zstandard.compress(b"\0\1\0\0" + data)
                writer.add_message(channel, START + time, packed, START + time)
        writer.finish()
    assert read_log(bag, parse_map(DOCUMENT, "map"), LAW).states[:, 1, 0].tolist() == list(range(60))
    plain = write(tmp_path / "plain.mcap", "float64 x", values, times)
    with pytest.raises(InputError, match="the clock jumps back"):
        read_log(plain, parse_map(DOCUMENT, "map"), LAW)


def test_names_of_topics_make_no_lines_of_a_map(tmp_path: Path) -> None:
    name = 'x", field: y}\ngraph: {fixed: line}\n#'
    with (tmp_path / "robots.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channel = writer.register_channel(f"/{name}", "cdr", schema)
        writer.add_message(channel, START, b"\0\1\0\0" + bytes(8), START)
        writer.finish()
    found = yaml.safe_load(first_map(tmp_path / "robots.mcap"))
    assert found["agents"] == {1: {"topic": f"/{name}", "field": "data"}}
    assert "graph" not in found


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": {1: {"field": "x"}, "1": {"field": "y"}}}, r"agents\.1: given twice"),
        ({"agents": {1: {"fields": ["x", "x"]}}}, "a field twice"),
        ({"agents": {1: {"field": "x" * 2000}}}, "expected at most 1000 characters"),
        ({"period": 1e-12}, "period: 1e-12: expected a number >= 1e-09"),
        ({"units": {"time": 1e99}}, r"units\.time: 1e\+99: expected a number <= 1e\+09"),
    ],
)
def test_maps(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_map(DOCUMENT | changes, "map")


def test_how_many_agents_there_are(tmp_path: Path) -> None:
    """Neither a hundred million of them, nor an endless count."""
    bag = write(tmp_path / "tanks.mcap", "float64 x", [bytes(8)] * 60)
    for agents, message in (
        ({10**8: {"topic": "/tank_1", "field": "x"}}, "agents: 100000000: expected all agents from 1"),
        ({"*": {"topic": "/tank_1", "fields": ["x", "{name}"]}}, "by name: how many are there"),
        ({"*": {"topic": "/tank_{name}", "field": "x"}}, "by name: how many are there"),
    ):
        with pytest.raises(InputError, match=message):
            check_log(bag, parse_map(DOCUMENT | {"agents": agents}, "map"))


def test_a_trace_that_would_be_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    bag = write(tmp_path / "tanks.mcap", "float64 x", [bytes(8)] * 60)
    for name, message in (("pipe", "not a regular file"), ("a\0b", "cannot be read")):
        with pytest.raises(InputError, match=message):
            read_log(bag, parse_map(DOCUMENT | {"graph": {"file": name}}, "map"), LAW, tmp_path)


def test_tables_that_fill_the_memory(tmp_path: Path) -> None:
    place = tmp_path / "data.npz"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed, packed.open("t.npy", "w") as out:
        for _ in range(600):
            out.write(bytes(10**6))
    document = parse_map({"agents": {"*": {"field": "x{i}"}}, "time": "t"}, "map")
    with pytest.raises(InputError, match=r"data\.npz: 600 MB: expected at most 537 MB"):
        read_log(place, document, LAW)


def test_numbers_and_intervals_without_digits() -> None:
    times, states = np.arange(60.0), np.zeros((60, 3))
    with pytest.raises(InputError, match=r"states: up to 1e\+16: expected at most 1e\+15"):
        Log.from_arrays(times, states + 1e16, law=LAW, graph="ring")
    with pytest.raises(InputError, match=r"times: 1e\+08 units without a sample"):
        Log.from_arrays(times * 1e8, states, law=LAW, graph="ring")


def test_no_two_agents_are_measured_at_the_same_time() -> None:
    """As of robots with clocks of their own; noise estimated, within four of its standard errors (p 0.0001)."""
    rng, step, noise = np.random.default_rng(4), 0.02, 0.2
    law = line_ring(3).with_noise(process=[1.0, 1.0, 1.0])
    transition = expm(-step * np.array([[2.0, -1, -1], [-1, 2, -1], [-1, -1, 2]]))
    x, states = np.zeros(3), np.full((6000, 3), np.nan)
    for k in range(len(states)):
        x = transition @ x + np.sqrt(step) * rng.normal(size=3)  # the noise of a short step
        states[k, k % 3] = x[k % 3] + noise * rng.normal()
    found = Log.from_arrays(
        step * np.arange(len(states)), states, law=law, graph="ring", measurement_noise="estimate"
    ).compare()
    low, high = found.measurement_noise.interval or (0.0, 0.0)
    assert abs(found.measurement_noise.values[0] - noise) < high - low
