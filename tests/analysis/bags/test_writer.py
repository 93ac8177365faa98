"""Bags of ours, opened by the readers of others."""

import json
import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from full_disk import full_disk
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from msg_analysis.bags.salvage import salvage_in_place
from msg_analysis.bags.stored_file import Storage
from msg_analysis.bags.writing import BagWriter, recording_pid
from msg_analysis.errors import BagError
from msg_analysis.messages.messages import StateCodec, encode_string, stamp_ns
from msg_analysis.messages.topics import network_topics
from msg_analysis.report.documents import describe_bag

RUN = bytes(range(16))


def _fill(bag: BagWriter, steps: int = 50) -> None:
    bag.write("/experiment", encode_string("text"), 0)
    codec = StateCodec(RUN, 1, 2, 0.5)
    messages = [codec.wrap(k, min(k, 1), np.array([k, -k], dtype=float).tobytes()) for k in range(steps)]
    size, times = np.full(steps, len(messages[0])), np.array([stamp_ns(data) for data in messages])
    bag.write_many(["/agent_1/state"], np.zeros(steps, int), times, b"".join(messages), np.cumsum(size) - size, size)


def test_metadata_is_that_of_the_channels(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", network_topics(1)) as bag:
        _fill(bag)
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "&id" not in text  # no YAML aliases
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["custom_data"]["complete"] == "true"
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    for entry in information["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        (channel,) = [c for c in summary.channels.values() if c.topic == topic["name"]]
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"]) == topic["offered_qos_profiles"]
        assert channel.metadata["topic_type_hash"] == topic["type_description_hash"]


def test_never_overwrites(tmp_path: Path) -> None:
    """An empty directory is a reserved name."""
    bag = tmp_path / "bag"
    bag.mkdir()
    BagWriter(bag, network_topics(1)).close()
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    assert before.keys() == {"bag_0.mcap", "metadata.yaml"}
    with pytest.raises(BagError, match="exists already"):
        BagWriter(bag, network_topics(1))
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before
    with pytest.raises(BagError, match="cannot be made"):
        BagWriter(bag / "metadata.yaml" / "bag", network_topics(1))


def test_bag_in_progress_is_recognised(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag", network_topics(1))
    with pytest.raises(BagError, match="/agent_2/state"):
        bag.write("/agent_2/state", b"", 0)
    assert recording_pid(tmp_path / "bag") == os.getpid()
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
    bag.close(complete=False)
    bag.close()
    assert recording_pid(tmp_path / "bag") is None
    assert {file.name for file in (tmp_path / "bag").iterdir()} == {"bag_0.mcap", "metadata.yaml"}
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    assert metadata["rosbag2_bagfile_information"]["custom_data"]["complete"] == "false"
    with pytest.raises(BagError, match="closed"):
        bag.write("/graph", b"", 0)


def _record_until_killed(directory: str, ready: Any) -> None:
    bag = BagWriter(Path(directory), network_topics(1), record='{"run": "abc"}', storage=Storage("none", 80_000))
    _fill(bag, 3000)
    bag.flush()
    ready.set()
    signal.pause()


def test_killed_in_a_later_file(tmp_path: Path) -> None:
    """It is not taken for a living one; files that were finished stay as they are; of the last one nothing is lost."""
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    bag = tmp_path / "bag"
    process = context.Process(target=_record_until_killed, args=(str(bag), ready))
    process.start()
    try:
        assert ready.wait(60)
        assert recording_pid(bag) == process.pid
    finally:
        process.kill()
        process.join()
    assert json.loads((bag / ".recording").read_text())["pid"] == process.pid
    assert recording_pid(bag) is None
    files = [bag / f"bag_{i}.mcap" for i in range(len(list(bag.glob("*.mcap"))))]
    assert len(files) > 2
    assert {file.name for file in bag.iterdir()} == {".recording", *(file.name for file in files)}
    finished = {file.name: file.read_bytes() for file in files[:-1]}
    for file in files[:-1]:
        with file.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
            assert summary is not None
    inventory = describe_bag(bag)
    torn = [file["torn"] for file in inventory["files"] if file["name"].endswith(".mcap")]
    assert [reason is None for reason in torn] == [True] * len(finished) + [False]
    report = salvage_in_place(bag)
    messages = 3000 + len(files)  # the experiment is in each
    assert (report.kept_messages, report.dropped_bytes) == (messages, 0)
    assert {name: (bag / name).read_bytes() for name in finished} == finished
    assert {file.name for file in bag.iterdir()} == {"metadata.yaml", *(file.name for file in files)}
    with AnyReader([bag]) as reader:
        assert reader.message_count == messages
        found = [reader.deserialize(raw, c.msgtype).step for c, _, raw in reader.messages() if c.topic != "/experiment"]
    assert found == list(range(3000))
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["custom_data"] == {"run": "abc", "complete": "false", "salvaged": "true"}


def test_a_head_larger_than_a_file_should_be(tmp_path: Path) -> None:
    """The record of a large network may be: still a file holds more than a message."""
    record = json.dumps({"run": "abc", "start": "x" * 200_000})
    with BagWriter(tmp_path / "bag", network_topics(1), record=record, storage=Storage("zstd", 100_000)) as bag:
        _fill(bag, 4000)
    assert len(list((tmp_path / "bag").glob("*.mcap"))) < 4


def test_full_disk(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag", network_topics(1), record=json.dumps({"run": "abc"}))
    file = tmp_path / "bag" / "bag_0.mcap"
    with full_disk(250_000):
        with pytest.raises(BagError, match="cannot be written"):
            _fill(bag, 10**5)
        bag.close()  # what is left to close is closed: no second error
    assert {path.name for path in file.parent.iterdir()} == {".recording", "bag_0.mcap"}
    assert recording_pid(file.parent) is None
    report = salvage_in_place(file.parent)
    assert report.dropped_bytes > 0
    assert report.kept_messages > 1000
    with AnyReader([file.parent]) as reader:
        assert reader.message_count == report.kept_messages
