"""The files of a split bag follow each other in time and read alone; read and played together, nothing comes twice.

The messages come as from a network: agents drift apart, and holding periods are published long before their time.
Files are read by mcap's reader.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_by_hand import by_library

from experiments import Run, read_bag, write_trajectory
from msg_analysis.bags.playback import Playback
from msg_analysis.bags.salvage import salvage_in_place
from msg_analysis.bags.stored_file import Storage
from msg_analysis.bags.writing import BagWriter
from msg_analysis.messages.messages import ActiveGraph
from msg_analysis.messages.topics import network_topics

MakeRun = Callable[..., Run]
AGENTS, STEPS, STEP = 4, 400, 50_000_000
LATCHED = ("/experiment", "/graph")


def messages_of(file: Path) -> list[tuple[str, Any]]:
    """(topic, message) in the order of the file."""
    with file.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message) for _, channel, message in found]


def files_of(bag: Path) -> list[Path]:
    return [bag / f"{bag.name}_{number}.mcap" for number in range(len(list(bag.glob("*.mcap"))))]


@pytest.fixture(scope="module")
def whole(make_run: MakeRun) -> Run:
    return make_run(AGENTS, STEPS, 3)


@pytest.fixture(scope="module")
def unsplit(whole: Run, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, Any]]:
    directory = tmp_path_factory.mktemp("unsplit") / "bag"
    write_trajectory(whole, directory)
    return messages_of(directory / "bag_0.mcap")


@pytest.fixture(scope="module")
def arriving(unsplit: list[tuple[str, Any]]) -> list[tuple[str, bytes, int]]:
    """As a recorder receives the run: agents are up to 15 steps apart, holding periods come up to 100 steps early."""
    # Each agent's states come in order.
    drift = {f"/agent_{i + 1}/state": 7.5 * np.sin(np.arange(STEPS + 1) / 20 + i) for i in range(AGENTS)}
    keyed = []
    for number, (topic, message) in enumerate(unsplit):
        step = message.log_time / STEP
        place = -1 if topic == "/experiment" else step - 100 if topic == "/graph" else step + drift[topic][int(step)]
        keyed.append((place, number, topic, message.data, message.log_time))
    return [(topic, data, time) for _, _, topic, data, time in sorted(keyed)]


def until(topic: str, data: bytes) -> int | None:
    return (ActiveGraph.decode(data).last_step + 1) * STEP if topic == "/graph" else None


def record(bag: BagWriter, messages: list[tuple[str, bytes, int]], portion: int = 37) -> None:
    """States in portions, as the recorder writes them."""
    names = [f"/agent_{i + 1}/state" for i in range(AGENTS)]
    waiting: list[tuple[str, bytes, int]] = []

    def write() -> None:
        size = np.array([len(data) for _, data, _ in waiting], dtype=np.int64)
        of = np.array([names.index(topic) for topic, _, _ in waiting], dtype=np.int64)
        times = np.array([time for _, _, time in waiting], dtype=np.int64)
        bag.write_many(names, of, times, b"".join(data for _, data, _ in waiting), np.cumsum(size) - size, size)
        waiting.clear()

    for topic, data, time in messages:
        if topic in LATCHED:
            bag.write(topic, data, time, until(topic, data))
        else:
            waiting.append((topic, data, time))
            if len(waiting) == portion:
                write()
    write()


@pytest.fixture(scope="module", params=[1, 37])
def bag(
    request: pytest.FixtureRequest,
    whole: Run,
    arriving: list[tuple[str, bytes, int]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    storage, directory = Storage("zstd", 12_000), tmp_path_factory.mktemp("split") / "split"
    with BagWriter(directory, network_topics(AGENTS), record=whole.record.to_json(), storage=storage) as writer:
        record(writer, arriving, request.param)
        assert writer.messages == len(arriving)
    assert len(files_of(directory)) > 4
    return directory


def test_files_follow_each_other_in_time(bag: Path) -> None:
    """No time is in two files, by the files and by metadata.yaml, and the bag is as long as its files together."""
    ends, lengths = [-1], 0
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    for file, entry in zip(files_of(bag), information["files"], strict=True):
        times = [message.log_time for _, message in messages_of(file)]
        assert min(times) > ends[-1]
        assert entry["starting_time"]["nanoseconds_since_epoch"] == min(times)
        assert entry["duration"]["nanoseconds"] == max(times) - min(times)
        assert entry["message_count"] == len(times)
        ends.append(max(times))
        lengths += max(times) - min(times)
    assert ends[-1] == STEPS * STEP
    assert information["duration"]["nanoseconds"] == STEPS * STEP
    assert lengths + len(ends) - 2 == STEPS * STEP  # a file begins a nanosecond after the end of the one before
    assert information["message_count"] == sum(entry["message_count"] for entry in information["files"])


def test_every_file_reads_alone(whole: Run, bag: Path) -> None:
    """With the experiment, and the graph of every step between two of its states."""
    covered = np.zeros((STEPS + 1, AGENTS), dtype=int)
    for file in files_of(bag):
        assert [topic for topic, _ in messages_of(file)].count("/experiment") == 1
        alone = read_bag(file)
        there = ~np.isnan(alone.states[:, :, 0])
        covered += there
        assert np.array_equal(alone.states[there], whole.states[there])
        steps = np.flatnonzero(there.all(axis=1))
        between = slice(int(steps.min()), int(steps.max()))
        assert np.array_equal(alone.modes[between], whole.modes[between])
        assert alone.completeness.refused == {}
    assert (covered == 1).all()


def test_repetitions_say_what_they_repeat(bag: Path) -> None:
    """Logged when the file begins, published when the original was, with its number: and only what is in force."""
    originals: dict[tuple[str, int], Any] = {}
    for number, file in enumerate(files_of(bag)):
        messages = messages_of(file)
        begin = min(message.log_time for _, message in messages)
        firsts = [originals.setdefault((topic, message.sequence), message) for topic, message in messages]
        repeated = [(*each, first) for each, first in zip(messages, firsts, strict=True) if each[1] is not first]
        assert all(first.log_time == first.publish_time for first in firsts)
        for topic, message, first in repeated:
            assert topic in LATCHED
            assert (message.log_time, message.publish_time) == (begin, first.publish_time)
            assert message.data == first.data
            assert (until(topic, message.data) or begin) >= begin
        assert [topic for topic, *_ in repeated].count("/experiment") == min(number, 1)
        assert len(repeated) < 5
    for topic in ("/graph", "/agent_1/state"):
        numbers = {number for name, number in originals if name == topic}
        assert numbers == set(range(len(numbers)))


def test_the_whole_bag_is_that_which_is_not_split(whole: Run, bag: Path) -> None:
    found = read_bag(bag)
    assert found.completeness.complete
    assert (found.completeness.duplicates, found.completeness.refused) == (0, {})
    assert np.array_equal(found.states, whole.states)
    assert np.array_equal(found.modes, whole.modes)


def test_it_is_played_once(bag: Path, unsplit: list[tuple[str, Any]]) -> None:
    """Every topic as from the bag that is not split, with an offset too."""
    for until_time in (2**63, 7 * 10**9):
        played: dict[str, list[tuple[int, bytes]]] = {}
        playback = Playback(bag)
        for message in playback.messages(list(playback.topics), until_time):
            played.setdefault(message.topic, []).append((message.time, message.data))
        wanted: dict[str, list[tuple[int, bytes]]] = {}
        for topic, message in unsplit:
            if message.log_time <= until_time:
                wanted.setdefault(topic, []).append((message.log_time, message.data))
        assert played == wanted


def test_an_agent_that_is_far_behind(whole: Run, arriving: list[tuple[str, bytes, int]], tmp_path: Path) -> None:
    """Its states come when all files that waited for them are closed: nothing is lost, and the graphs are there."""
    late = [message for message in arriving if message[0] == "/agent_2/state"]
    bag = tmp_path / "split"
    with BagWriter(bag, network_topics(AGENTS), record=whole.record.to_json(), storage=Storage("none", 9000)) as writer:
        record(writer, [message for message in arriving if message not in late] + late)
    assert np.array_equal(read_bag(bag).states, whole.states)
    assert np.array_equal(read_bag(bag).modes, whole.modes)


def test_a_latched_message_that_is_late(whole: Run, arriving: list[tuple[str, bytes, int]], tmp_path: Path) -> None:
    """It is in the file of its time, and at once in the later one that has begun already."""
    states = [message for message in arriving if message[0] not in LATCHED]
    experiment = next(message for message in arriving if message[0] == "/experiment")
    bag = tmp_path / "split"
    with BagWriter(bag, network_topics(AGENTS), record=whole.record.to_json(), storage=Storage("none", 9000)) as writer:
        for topic, data, time in states:
            if topic != "/agent_2/state":  # all files wait for this agent
                record(writer, [(topic, data, time)])
            if len(files_of(bag)) == 2:
                break
        writer.write(*experiment)
    assert [[topic for topic, _ in messages_of(file)].count("/experiment") for file in files_of(bag)] == [1, 1]


def test_torn_in_two_files(whole: Run, arriving: list[tuple[str, bytes, int]], tmp_path: Path) -> None:
    """The recorder is killed while a file waits for late states: both are salvaged, with true counts."""
    bag = tmp_path / "split"
    writer = BagWriter(bag, network_topics(AGENTS), record=whole.record.to_json(), storage=Storage("zstd", 9000))
    late = [message for message in arriving if message[0] == "/agent_2/state"]
    record(writer, [message for message in arriving if message not in late][: 3 * STEPS // 2])
    writer.flush()
    files = files_of(bag)
    del writer  # nothing is closed
    report = salvage_in_place(bag)
    assert report.torn.count("footer") == len(files) == 3
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert [entry["message_count"] for entry in information["files"]] == [len(messages_of(file)) for file in files]
    found = read_bag(bag)
    others = np.delete(~np.isnan(found.states[:, :, 0]), 1, axis=1)
    assert others.sum() > STEPS
    assert np.array_equal(found.states[:, [0, 2, 3]][others], whole.states[:, [0, 2, 3]][others])
    played = Playback(bag).messages(LATCHED)
    assert [message.topic for message in played].count("/experiment") == 1


def _theirs(folder: Path, files: list[list[tuple[bytes, int]]], latched: bool = True) -> Iterator[bytes]:
    """What is played of a bag of another recorder: on one topic, data and time of publication; logged 5 ns later."""
    qos = f"- durability: {'transient_local' if latched else 'volatile'}\n"
    for number, messages in enumerate(files):
        logged = [("/switch", "std_msgs/msg/Bool", data, time + 5, time) for data, time in messages]
        by_library(folder / f"theirs_{number}.mcap", logged, qos=qos)
    return (message.data for message in Playback(folder).messages(["/switch"]))


def test_what_others_publish_again_is_no_repetition(tmp_path: Path) -> None:
    """Equal bytes at another time are another message; the same publication in a second file is not."""
    on, off = b"on", b"off"
    assert [*_theirs(tmp_path / "again", [[(on, 1), (off, 2)], [(on, 3), (off, 4)]])] == [on, off, on, off]
    assert [*_theirs(tmp_path / "repeated", [[(on, 1), (off, 2)], [(off, 2), (on, 3)]])] == [on, off, on]
    assert [*_theirs(tmp_path / "twice", [[(on, 1)], [(off, 2), (off, 2)]])] == [on, off, off]
    assert [*_theirs(tmp_path / "volatile", [[(on, 1)], [(on, 1)]], latched=False)] == [on, on]
