"""Bags and tables of others, written by rosbags, the mcap library, csv, pyarrow and numpy, read by a map."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

from experiments import line_ring, simulate
from msg_analysis.bags.first_map import check_log, first_map
from msg_analysis.bags.log_map import json_schema, load_map, parse_map
from msg_analysis.bags.mapped_log import read_log
from msg_analysis.bags.reading import read_bag
from msg_analysis.errors import BagError, InputError
from msg_analysis.experiment.examples import FOLDER as EXAMPLES
from msg_analysis.experiment.experiment import Experiment, ExperimentError

START = 1_760_000_000_000_000_000  # ns
LAW = line_ring(3)
STATES = np.random.default_rng(1).normal(size=(60, 3))
TIMES = np.sort(np.random.default_rng(2).integers(0, 10**10, 60))  # ns
PATH = [(-1, "line"), (3 * 10**9 + 1, "ring"), (5 * 10**9, "ring"), (7 * 10**9, "line")]
POSE = {"agents": {"*": {"topic": "/robot_{i}/pose", "field": "pose.position.y"}}}
GRAPH = {"graph": {"topic": "/network/active", "field": "data"}}
Write = Callable[..., Path]


def expect(log: Any, states: np.ndarray = STATES) -> None:
    assert np.array_equal(log.states[:, :, 0], states)
    np.testing.assert_allclose(log.times, (TIMES - TIMES[0]) / 1e9, atol=1e-9)
    np.testing.assert_allclose(log.starts, (np.array([-1, 3e9 + 1, 7e9]) - TIMES[0]) / 1e9, atol=1e-9)
    assert log.graphs.tolist() == [0, 1, 0]


@pytest.fixture
def write(tmp_path: Path, typestore: Any) -> Write:
    """A bag with poses whose stamps are ``TIMES``, recorded 5 ms later, and names of graphs."""
    types = typestore.types

    def pose(time: int, value: float, frame: str) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
        point = types["geometry_msgs/msg/Point"](0.5, value, -1.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        header = types["std_msgs/msg/Header"](stamp, frame)
        return types["geometry_msgs/msg/PoseStamped"](header, types["geometry_msgs/msg/Pose"](point, turn))

    def make(
        storage: StoragePlugin = StoragePlugin.MCAP,
        compression: CompressionMode = CompressionMode.NONE,
        states: np.ndarray = STATES,
        times: np.ndarray = TIMES,
        graph_name: str = "/network/active",
    ) -> Path:
        bag = tmp_path / "robots"
        writer = Writer(bag, version=9, storage_plugin=storage)
        if compression != CompressionMode.NONE:
            writer.set_compression(compression, CompressionFormat.ZSTD)
        kind, text = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
        with writer:
            robots = [writer.add_connection(f"/robot_{i}/pose", kind, typestore=typestore) for i in (1, 2, 3)]
            network = writer.add_connection(graph_name, text, typestore=typestore)
            for time, name in PATH:
                writer.write(network, START + time, typestore.serialize_cdr(types[text](name), text))
            for k, time in enumerate(times.tolist()):
                for i, robot in enumerate(robots):
                    if not np.isnan(states[k, i]):  # frames of other lengths, so that the layouts differ
                        message = pose(START + time, float(states[k, i]), "map" * (k % 4))
                        writer.write(robot, START + time + 5_000_000, typestore.serialize_cdr(message, kind))
        return bag

    return make


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_poses(storage: StoragePlugin, compression: CompressionMode, write: Write) -> None:
    if (storage, compression) == (StoragePlugin.MCAP, CompressionMode.STORAGE):
        pytest.skip("not a mode of rosbags")
    log = read_log(write(storage, compression), parse_map(POSE | GRAPH, "map"), LAW)
    expect(log)
    assert log.notes == ("The messages on /network/active have no header: the times of the log count.",)


def test_times_of_the_log_units_and_a_period(write: Write) -> None:
    bag = write()
    document = POSE | GRAPH | {"time": "log", "units": {"time": 2.0, "state": 0.1}, "measurement_noise": 0.5}
    log = read_log(bag, parse_map(document, "map"), LAW)
    np.testing.assert_allclose(log.states[:, :, 0], STATES / 0.1)
    np.testing.assert_allclose(log.times, (TIMES - TIMES[0]) / 2e9, atol=1e-9)
    np.testing.assert_allclose(log.starts[1] - log.starts[0], (3e9 + 2) / 2e9)
    assert log.measurement_noise is not None
    assert log.measurement_noise.tolist() == [5.0] * 3
    thinned = read_log(bag, parse_map(POSE | GRAPH | {"period": 1.0}, "map"), LAW)
    first = [k for k, t in enumerate((TIMES - TIMES[0]) // 10**9) if k == 0 or t != (TIMES[k - 1] - TIMES[0]) // 10**9]
    assert np.array_equal(thinned.states[:, :, 0], STATES[first])


def test_missing_and_bad_values(write: Write) -> None:
    """A missing message is a missing value; NaN is left out and said."""
    states = STATES.copy()
    states[10, 1] = np.nan
    expected = states.copy()
    expected[20, 2] = np.nan
    states[20, 2] = np.inf
    log = read_log(write(states=states), parse_map(POSE | GRAPH, "map"), LAW)
    assert np.array_equal(log.states[:, :, 0], expected, equal_nan=True)
    assert "Agent 3: 1 value that are not finite not used." in log.notes


def test_a_clock_that_jumps_back(write: Write) -> None:
    bag = write(times=np.concatenate([TIMES[30:], TIMES[:30]]))
    with pytest.raises(InputError, match=r"/robot_1/pose: the clock jumps back by 9\.\d+ s after 30 values"):
        read_log(bag, parse_map(POSE | GRAPH, "map"), LAW)
    assert check_log(bag, parse_map(POSE | GRAPH, "map"))["agents"][0]["clock_jumps"] == 1


def test_a_first_map_finds_the_robots(write: Write, tmp_path: Path) -> None:
    bag = write()
    file = tmp_path / "map.yaml"
    file.write_text(first_map(bag))
    found = load_map(file)
    assert found.agents["*"].topic == "/robot_{i}/pose"
    assert found.agents["*"].field == "pose.position.x"
    assert found.graph is not None
    assert found.graph.topic == "/network/active"
    assert found.measurement_noise == "estimate"
    assert np.array_equal(read_log(bag, found, LAW).states[:, :, 0], np.full((60, 3), 0.5))
    checked = check_log(bag, None)
    assert [each["values"] for each in checked["agents"]] == [60] * 3
    assert checked["graph"]["switches"] == 2
    assert checked["together"] == 1.0
    assert checked["agents"][0]["period"] == pytest.approx(np.median(np.diff(TIMES)) / 1e9)


def test_a_bag_of_others_points_to_the_map(write: Write) -> None:
    with pytest.raises(BagError, match=r"not a run of msg-agents.*`msg-analysis map .*` writes a first map"):
        read_bag(write())


IDL = """
================================================================================
IDL: lab_msgs/msg/Tank
#include "lab_msgs/msg/Level.idl"
module lab_msgs { module msg {
  struct Tank { string name; sequence<double> history; lab_msgs::msg::Level levels[2]; boolean full; };
}; };
================================================================================
IDL: lab_msgs/msg/Level
module lab_msgs { module msg { struct Level { int16 count; float height; }; }; };
"""
MSG = """string name
float64[] history
lab_msgs/Level[2] levels
bool full
================================================================================
MSG: lab_msgs/Level
int16 count
float32 height
"""


def tank(name: str, history: list[float], heights: list[float], big: bool) -> bytes:
    """In CDR, by hand."""
    order = ">" if big else "<"
    data = bytearray()

    def put(kind: str, value: Any) -> None:
        size = np.dtype(kind).itemsize
        data.extend(b"\0" * (-len(data) % size) + np.array(value, np.dtype(order + kind)).tobytes())

    put("u4", len(name) + 1)
    data.extend(name.encode() + b"\0")
    put("u4", len(history))
    for value in history:
        put("f8", value)
    for k, height in enumerate(heights):
        put("i2", k)
        put("f4", height)
    data.extend(b"\1")
    return bytes([0, 0 if big else 1, 0, 0]) + bytes(data)


def write_tanks(bag: Path, encoding: str, definition: str, messages: list[bytes]) -> None:
    with bag.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("lab_msgs/msg/Tank", encoding, definition.encode())
        channels = [writer.register_channel(f"/tank_{i}", "cdr", schema) for i in (1, 2, 3)]
        for k, data in enumerate(messages):
            for channel in channels:
                writer.add_message(channel, START + k * 10**8, data, START + k * 10**8)
        writer.finish()


@pytest.mark.parametrize(("encoding", "definition"), [("ros2msg", MSG), ("ros2idl", IDL)])
@pytest.mark.parametrize("big", [False, True])
def test_messages_of_any_type(encoding: str, definition: str, big: bool, tmp_path: Path) -> None:
    """Texts and sequences of any length before the field, two entries of an array, either order of bytes."""
    bag = tmp_path / "tanks.mcap"
    rng = np.random.default_rng(3)
    heights = rng.normal(size=(100, 2)).astype(np.float32)
    messages = [tank("t" * (k % 7), [1.0] * (k % 5), heights[k].tolist(), big) for k in range(100)]
    write_tanks(bag, encoding, definition, messages)
    fields = ["levels[0].height", "levels[1].height"]
    document = {"agents": {"*": {"topic": "/tank_{i}", "fields": fields}}, "time": "log", "graph": {"fixed": "ring"}}
    log = read_log(bag, parse_map(document, "map"), LAW)
    for i in range(3):
        assert np.array_equal(log.states[:, i], heights)
    document["agents"]["*"]["fields"] = ["levels[1].count", "history[3]"]
    short = read_log(bag, parse_map(document, "map"), LAW)
    assert len(short.times) == 20  # others are too short
    assert (short.states == [1.0, 1.0]).all()


HOSTILE = {
    "not a definition": "%$ nonsense",
    "an unknown type": "other_msgs/Thing thing\nfloat64 x",
    "in itself": "lab_msgs/Tank tank\nfloat64 x",
    "python": "float64 __import__('os').system('touch hacked')",
    "endless": "float64 x\n" * 40_000,
    "huge array": "float64[1000000000] big\nfloat64 x",
    "shift": "",
}


@pytest.mark.parametrize("name", list(HOSTILE))
def test_hostile_definitions_end_in_one_error(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bag = tmp_path / "hostile.mcap"
    encoding = "ros2idl" if name == "shift" else "ros2msg"
    shift = "module lab_msgs { module msg { const long A = 1 << 999999999; struct Tank { double x; }; }; };"
    write_tanks(bag, encoding, HOSTILE[name] or shift, [b"\0\1\0\0" + b"\0" * 24] * 60)
    document = {"agents": {"*": {"topic": "/tank_{i}", "field": "x"}}, "time": "log", "graph": {"fixed": "ring"}}
    with pytest.raises(InputError, match=r"hostile\.mcap: topic /tank_1: "):
        read_log(bag, parse_map(document, "map"), LAW)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hostile.mcap"]


def test_random_bytes_in_messages_are_left_out(tmp_path: Path) -> None:
    bag = tmp_path / "tanks.mcap"
    rng = np.random.default_rng(4)
    good = tank("good", [2.0], [1.0, 1.0], False)
    messages = [good if k % 2 else bytes([0, 1, 0, 0]) + rng.bytes(int(rng.integers(0, 60))) for k in range(200)]
    write_tanks(bag, "ros2msg", MSG, messages)
    document = {
        "agents": {"*": {"topic": "/tank_{i}", "field": "history[0]"}},
        "time": "log",
        "graph": {"fixed": "ring"},
    }
    log = read_log(bag, parse_map(document, "map"), LAW)
    assert (log.states == 2.0).all(axis=(1, 2)).sum() == 100


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": {"*": {"topic": "/robot/pose", "field": "pose.position.x"}}}, r"agents\.\*: missing \{i\}"),
        ({"agents": {1: {"topic": "/robot_1/pose"}}}, r"agents\.1: field: expected one of `field` and `fields`"),
        ({"agents": {1: {"topic": "/robot_1/pose", "feild": "x"}}}, "did you mean 'field'"),
        ({"agents": {}}, "agents: .*expected at least 1 entries"),
        ({"time": 3}, "time: 3: expected a text"),
        ({"period": 0}, "period: 0: expected a number >= 1e-09"),
        ({"measurement_noise": "much"}, "expected a standard deviation >= 0, one per agent, or 'estimate'"),
        ({"graph": {"topic": "/network/active"}}, "graph: none: expected one of `topic` with `field`"),
        ({"graph": {"fixed": "line", "hold": 1.0}}, r"graph\.hold: given: expected with `file` only"),
        ({"graph": {"fixed": "line", "file": "a.csv"}}, "graph: file, fixed: expected one of"),
        ({"law": "euler"}, "law: \"euler\": expected 'continuous' or 'steps'"),
        ({"units": {"time": -1}}, r"units\.time: -1: expected a number >= 1e-09"),
    ],
)
def test_mistakes_in_a_map(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_map(POSE | GRAPH | changes, "map")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": {1: {"topic": "/robot_1/pose", "field": "pose.position.y"}}}, "agents: 2, 3: not in the map"),
        ({"agents": {"*": {"topic": "/robot_{i}/odom", "field": "x"}}}, "topic /robot_1/odom: no message: the bag has"),
        ({"agents": {"*": {"topic": "/robot_{i}/pose", "field": "pose.x"}}}, "expected one such as header.stamp.sec"),
        ({"agents": {"*": {"topic": "/robot_{i}/pose", "field": "pose.position"}}}, "such as pose.position.x"),
        ({"agents": {"*": {"topic": "/robot_{i}/pose", "field": "header.frame_id"}}}, "expected a number, and it is a"),
        ({"agents": {"*": {"topic": "/robot_{i}/pose", "field": "a..b"}}}, "'a..b': expected a field such as"),
        ({"agents": {"*": {"field": "x{i}"}}}, "is a bag: expected a topic for every agent"),
        ({"time": "t"}, "is a bag: expected 'header' or 'log'"),
        ({"graph": {"topic": "/robot_1/pose", "field": "header.frame_id"}}, "graph '': expected one of line, ring"),
        ({"graph": {"fixed": "star"}}, "graph: star: expected one of line, ring"),
        ({"graph": {"file": "missing.csv"}}, "missing.csv"),
    ],
)
def test_maps_that_do_not_fit_the_bag(changes: dict[str, Any], message: str, write: Write) -> None:
    with pytest.raises(InputError, match=message):
        read_log(write(), parse_map(POSE | GRAPH | changes, "map"), LAW)


@pytest.mark.parametrize("form", ["csv", "parquet", "npz"])
def test_tables(form: str, tmp_path: Path) -> None:
    states = STATES.copy()
    states[4, 1] = np.nan
    told = [[name for time, name in PATH if time <= now][-1] for now in TIMES.tolist()]
    columns: dict[str, Any] = {"t": TIMES / 1e9} | {f"tank {i + 1}": states[:, i] for i in range(3)}
    columns["topology"] = np.array(told)
    file = tmp_path / f"data.{form}"
    if form == "csv":
        with file.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                writer.writerow(
                    [
                        "" if value != value else repr(float(value)) if isinstance(value, float) else value
                        for value in row
                    ]
                )
    elif form == "npz":
        np.savez(file, **columns)
    else:
        pyarrow = pytest.importorskip("pyarrow")
        pytest.importorskip("pyarrow.parquet").write_table(pyarrow.table(columns), file)
    document = {"agents": {"*": {"field": "tank {i}"}}, "time": "t", "graph": {"field": "topology"}}
    log = read_log(file, parse_map(document, "map"), LAW)
    assert np.array_equal(log.states[:, :, 0], states, equal_nan=True)
    changes = [TIMES[k] for k in range(60) if k == 0 or told[k] != told[k - 1]]
    np.testing.assert_allclose(log.starts, (np.array(changes) - TIMES[0]) / 1e9, atol=2e-9)
    for wrong, message in (
        ({"time": "time"}, "column time: missing: expected one of t, "),
        ({"agents": {"*": {"topic": "/a_{i}", "field": "x"}}}, "is a table: expected columns"),
        ({"agents": {i: {"field": "topology"} for i in (1, 2, 3)}}, "column topology: expected numbers"),
    ):
        with pytest.raises(InputError, match=message):
            read_log(file, parse_map(document | wrong, "map"), LAW)


def test_no_pickle_and_no_damaged_table_is_read(tmp_path: Path) -> None:
    hostile = tmp_path / "data.npz"
    np.savez(hostile, t=np.array([print], dtype=object))
    document = parse_map({"agents": {"*": {"field": "x{i}"}}, "time": "t"}, "map")
    with pytest.raises(InputError, match=r"cannot be read as NPZ .*pickle"):
        read_log(hostile, document, LAW)
    for name in ("data.parquet", "other.npz", "data.csv"):
        (tmp_path / name).write_bytes(b"\xff\xfe not this")
        with pytest.raises(InputError, match=name):
            read_log(tmp_path / name, document, LAW)


@pytest.mark.parametrize("kind", ["schedule", "intervals"])
def test_the_path_of_a_trace(kind: str, write: Write, tmp_path: Path) -> None:
    """Times in s since 1970, as the stamps; links are those of a graph of the law."""
    ends = [START / 1e9 + 3, START / 1e9 + 7, START / 1e9 + 11]
    begin = START / 1e9 - 1
    rows = [["time", "graph"], [begin, "line"], [ends[0], "ring"], [ends[1], "line"]]
    if kind == "intervals":
        rows = [["start", "end", "source", "target"], [begin, ends[2], 1, 2], [begin, ends[2], 2, 3]]
        rows.append([ends[0], ends[1], 3, 1])
    with (tmp_path / "trace.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([[f"{x:.6f}" if isinstance(x, float) else x for x in row] for row in rows])
    more = {} if kind == "schedule" else {"undirected": True}
    document = POSE | {"graph": {"file": "trace.csv", **more}}
    log = read_log(write(), parse_map(document, "map"), LAW, tmp_path)
    assert log.graphs.tolist()[:3] == [0, 1, 0]
    np.testing.assert_allclose(log.starts[:3], (np.array([-1, 3, 7]) * 1e9 - TIMES[0]) / 1e9, atol=2e-6)


def test_the_schema_of_the_map_fits_its_examples() -> None:
    properties = json_schema()["properties"]
    assert set(properties) == {"agents", "time", "period", "graph", "units", "measurement_noise", "law"}
    examples = {key: each["examples"][0] for key, each in properties.items()}
    assert parse_map(yaml.safe_load(yaml.safe_dump(examples)), "examples").law == "continuous"
    assert all(each["description"] for each in properties.values())


def test_positions_of_a_bag_are_a_recorded_topology(tmp_path: Path, typestore: Any) -> None:
    """The example's CSV file as messages with stamps since 1970: the same graphs at the same times."""
    example = Experiment.load("recorded_robots")
    document = yaml.safe_load((EXAMPLES / "recorded_robots.yaml").read_text())
    types, kind = typestore.types, "geometry_msgs/msg/PointStamped"
    with (EXAMPLES / "recorded_robots.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    names = list(dict.fromkeys(row["agent"] for row in rows))
    with Writer(tmp_path / "robots", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {name: writer.add_connection(f"/{name}/place", kind, typestore=typestore) for name in names}
        for row in rows:
            time = START + round(10**9 * float(row["time"]))
            stamp = types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
            point = types["geometry_msgs/msg/Point"](float(row["x"]), float(row["y"]), 0.0)
            message = types[kind](types["std_msgs/msg/Header"](stamp, "map"), point)
            writer.write(topics[row["agent"]], time, typestore.serialize_cdr(message, kind))
    places = {name: {"topic": f"/{name}/place", "fields": ["point.x", "point.y"]} for name in names}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({"agents": places}))
    document["switching"] |= {"trace": "robots", "map": "map.yaml"}
    found = Experiment.parse(document, directory=tmp_path)
    assert found == example
    for changes, message in (
        ({"map": None}, "switching.map: missing: expected with a bag"),
        ({"trace": "none"}, "none: not found: expected the directory of a bag"),
        ({"radius": None}, "switching.radius: missing"),
    ):
        wrong = {key: value for key, value in (document["switching"] | changes).items() if value is not None}
        with pytest.raises(ExperimentError) as error:
            Experiment.parse(document | {"switching": wrong}, directory=tmp_path)
        assert message in str(error.value), str(error.value)
    (tmp_path / "map.yaml").write_text('agents: {"*": {topic: "/r{i}/place", fields: [point.x, point.y]}}')
    with pytest.raises(ExperimentError, match=r"switching\.map: .*list them"):
        Experiment.parse(document, directory=tmp_path)


@pytest.mark.parametrize("replicas", [1, 2])
def test_the_first_map_of_a_bag_of_ours_gives_the_numbers_of_its_run(tmp_path: Path, replicas: int) -> None:
    run = simulate(line_ring(3, run={"dt": 0.1, "duration": 50, "replicas": replicas, "seed": 2}))
    run.save(tmp_path / "own")
    found = parse_map(yaml.safe_load(first_map(tmp_path / "own")), "first map")
    log = read_log(tmp_path / "own", found, run.experiment)
    assert log.sampled_law == "steps"
    assert np.array_equal(log.states[:, :, 0], run.values[:, :, 0])
    np.testing.assert_allclose(log.times, run.times, atol=1e-9)
    steps = np.searchsorted(log.starts, run.times[:-1] + 1e-6, side="right") - 1
    assert np.array_equal(log.graphs[steps], run.modes)
    assert log.compare().verdict == "agrees"
