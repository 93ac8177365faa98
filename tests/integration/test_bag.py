"""The bag of a run, as programs that know nothing of us see it."""

import json
import os
import re
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from msg_agents.run.result import RunResult
from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.simulate import simulate

STEPS, AGENTS = 300, 5


def test_any_reader_finds_everything(network: Any) -> None:
    """One run, looked at from all sides: rosbags, the plain MCAP reader, metadata.yaml, the logs; and run again."""
    result: RunResult = network.run(network.experiment(run={"processes": 2}))
    _rosbags(result)
    _mcap(result.bag)
    _metadata(result.bag)
    logs = sorted(file.name for file in (result.bag / "log").iterdir())
    assert logs == ["agents_1_to_2.log", "agents_3_to_5.log", "recorder.log", "run.json", "switcher.log"]
    assert [file.name for file in result.bag.glob(".*")] == []
    _the_seed_is_the_run(network, result)


def _the_seed_is_the_run(network: Any, result: RunResult) -> None:
    """The same seed gives the same contents, whatever the processes; another seed gives others."""
    first = result.trajectory
    again = network.run(network.experiment(run={"processes": 1})).trajectory
    assert again.record.run != first.record.run
    assert np.array_equal(again.states, first.states)
    assert np.array_equal(again.modes, first.modes)
    other = simulate(network.experiment(run={"seed": 8}))  # equal to its network: test_lockstep.py
    assert not np.array_equal(other.states[-1], first.states[-1])
    assert not np.array_equal(other.modes, first.modes)


def _rosbags(result: RunResult) -> None:
    """All messages decoded with the definitions in the bag itself."""
    twin = simulate(result.trajectory.record.experiment)
    states = np.full_like(twin.states, np.nan)
    modes = np.full_like(twin.modes, -1)
    experiments, sequences = [], []
    with AnyReader([result.bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        for connection, time, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/experiment":
                experiments.append(json.loads(message.data))
                continue
            assert bytes(message.run) == result.trajectory.record.run.bytes
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
            if connection.topic == "/graph":
                sequences.append(message.sequence)
                modes[message.first_step : message.last_step + 1] = message.mode - 1
                assert message.name == ["line", "ring"][message.mode - 1]
                arcs = set(zip(message.source.tolist(), message.target.tolist(), strict=True))
                neighbours = {(i, i + 1) for i in range(1, 5)} | ({(5, 1)} if message.mode == 2 else set())
                assert arcs == neighbours | {(j, i) for i, j in neighbours}
                assert set(message.weight.tolist()) == {1.0}
            else:
                assert connection.topic == f"/agent_{message.agent}/state"
                assert time == message.step * 50_000_000
                assert len(message.heard) == 0
                assert message.mode == (modes[message.step - 1] + 1 if message.step else 0)
                states[message.step, message.agent - 1] = message.state
    assert np.array_equal(states, twin.states)
    assert np.array_equal(modes, twin.modes)
    assert [experiment["run"] for experiment in experiments] == [str(result.trajectory.record.run)]
    # A holding period too short for any step to see is left out: two of the same graph may follow each other.
    assert len(sequences) >= 1 + int((np.diff(twin.modes) != 0).sum())
    assert sequences == list(range(len(sequences)))
    expected = {f"/agent_{i}/state": STEPS + 1 for i in range(1, AGENTS + 1)}
    assert counts == expected | {"/experiment": 1, "/graph": len(sequences)}


def _mcap(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        read = sum(1 for _ in reader.iter_messages())
        assert read == summary.statistics.message_count
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
            assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["reliability"] == "reliable"
        names = {schema.name for schema in summary.schemas.values()}
        ours = {f"msg_agents_interfaces/msg/{name}" for name in ("ActiveGraph", "AgentState")}
        assert names == {"std_msgs/msg/String", *ours}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}


def _metadata(bag: Path) -> None:
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert list(information) == [
        *("version", "storage_identifier", "duration", "starting_time", "message_count"),
        *("topics_with_message_count", "compression_format", "compression_mode", "relative_file_paths", "files"),
        *("custom_data", "ros_distro"),
    ]
    wheels = [name for package in distributions() if (name := re.match(r"ros-(\w+)-rclpy$", package.name))]
    assert information["ros_distro"] == (wheels[0][1] if wheels else os.environ.get("ROS_DISTRO", ""))
    assert (information["version"], information["storage_identifier"]) == (9, "mcap")
    assert information["duration"]["nanoseconds"] == 15 * 10**9
    assert information["starting_time"]["nanoseconds_since_epoch"] == 0
    assert information["custom_data"]["complete"] == "true"
    assert information["relative_file_paths"] == [f"{bag.name}_0.mcap"]
    topics = information["topics_with_message_count"]
    assert sum(topic["message_count"] for topic in topics) == information["message_count"]
    for topic in topics:
        assert list(topic["topic_metadata"]) == [
            *("name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
        ]
        assert isinstance(topic["topic_metadata"]["offered_qos_profiles"], list)


def test_compressed_and_split(network: Any) -> None:
    """What is asked for on the command line is what is recorded; nothing is lost at the seams."""
    # The result is printed, as one object in a line, and kept with a report.
    # The files are in the order of time, and each has the experiment, and the graph of every step between its states.
    file = network.file(run={"processes": 2, "replicas": 32})
    options = ("--out", network.directory / "runs", "--compression", "lz4", "--split-size", "0.1", "--json")
    result = network.completed(network.start("run", file, *options))
    assert (result["verdict"], result["failures"]) == ("agrees", [])
    assert Path(result["report"]).read_text(encoding="utf-8").startswith("<!")
    bag = Path(result["bag"])
    files = sorted(bag.glob("*.mcap"))
    assert [path.name for path in files] == [f"{bag.name}_{i}.mcap" for i in range(len(files))]
    assert len(files) > 1
    end = -1
    for path in files:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert {index.compression for index in summary.chunk_indexes} == {"lz4"}
            times = [message.log_time for _, _, message in reader.iter_messages()]
        assert min(times) > end
        end = max(times)
        alone = read_bag(path)
        steps = np.flatnonzero(~np.isnan(alone.states).any(axis=(1, 2)))
        assert (alone.modes[steps.min() : steps.max()] >= 0).all()
        assert alone.completeness.refused == {}
    with AnyReader([bag]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items() if topic.endswith("state")}
    assert counts == {f"/agent_{i}/state": STEPS + 1 for i in range(1, AGENTS + 1)}


def test_recorder_killed_between_two_files(network: Any) -> None:
    """The files that were finished stay as they are, the last one is salvaged, and what was run says so."""
    file = network.file(run={"processes": 2, "replicas": 64, "duration": 5000})
    run = network.record(file, "--split-size", "0.2")

    def files() -> list[Path]:
        found = (network.directory / "runs").glob("*/*.mcap")
        return sorted(found, key=lambda path: int(path.stem.rpartition("_")[2]))

    network.wait_for(lambda: len(files()) > 2, 60, "three files")
    (recorder,) = network.processes("recorder")
    recorder.kill()
    recorded = files()
    contents = {path: path.read_bytes() for path in recorded}
    # One may still have waited for late states, beside the last one.
    finished = {path: content for path, content in contents.items() if content.endswith(b"\x89MCAP0\r\n")}
    assert len(finished) in (len(recorded) - 2, len(recorded) - 1)
    _, stderr = network.ended(run, 3)
    assert "the bag was salvaged" in stderr
    assert "Traceback" not in stderr
    assert {path: path.read_bytes() for path in finished} == finished
    bag = recorded[0].parent
    trajectory = read_bag(bag)
    assert trajectory.prefix > 100
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        states = sum(info.msgcount for topic, info in reader.topics.items() if topic.endswith("state"))
        assert states == trajectory.completeness.received
        assert sum(1 for _ in reader.messages()) == reader.message_count
