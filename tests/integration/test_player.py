"""Bags that are played again by one process, and recorded again by others."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from msg_agents.domain import free_domain
from msg_analysis.bags.reader import read_bag
from msg_analysis.bags.store import write_trajectory
from msg_analysis.twin import simulate

PLAIN_RECORDER = """
import sys
import rclpy
from mcap.writer import Writer
from rclpy.executors import SingleThreadedExecutor
from msg_agents_interfaces.msg import ActiveGraph, AgentState
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

KINDS = {"experiment": String, "graph": ActiveGraph, "state": AgentState, "truth": AgentState, "clock": Clock}
file, count, *topics = sys.argv[1:]
rclpy.init()
node = rclpy.create_node("plain")
left = int(count)
with open(file, "wb") as stream:
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("any", "", b"")

    def subscribe(topic):
        kind = KINDS[topic.split("/")[-1]]
        latched = kind in (String, ActiveGraph)
        channel = writer.register_channel(topic, "cdr", schema)
        qos = QoSProfile(
            history=QoSHistoryPolicy.KEEP_ALL,
            reliability=QoSReliabilityPolicy.RELIABLE,
            durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
        )

        def take(data):
            global left
            left -= 1
            now = node.get_clock().now().nanoseconds
            writer.add_message(channel, now, bytes(data), now)

        node.create_subscription(kind, topic, take, qos, raw=True)

    for topic in topics:
        subscribe(topic)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while left > 0:
        executor.spin_once()
    writer.finish()
print("finished")
"""


def contents(*files: Path) -> dict[str, list[bytes]]:
    """The messages of each topic, in the order of the file; by MCAP's own reader."""
    found = defaultdict(list)
    for file in files:
        with file.open("rb") as stream:
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
                found[channel.topic].append(message.data)
    return dict(found)


def texts(messages: list[bytes]) -> list[bytes]:
    """Without the bytes that middleware adds at the end, up to a multiple of four."""
    return [message.rstrip(b"\0") for message in messages]


def mcap(bag: Path) -> Path:
    (file,) = bag.glob("*.mcap")
    return Path(file)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    with free_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture
def bag(network: Any) -> Path:
    """300 steps of five agents."""
    bag = Path(network.directory / "twin")
    write_trajectory(simulate(network.experiment()), bag)
    return bag


@pytest.fixture
def plain(network: Any) -> Any:
    """Start a subscriber that knows nothing of us and writes what comes, until so many messages have come."""
    started = []

    def start(file: Path, topics: dict[str, int]) -> subprocess.Popen[str]:
        total = str(sum(topics.values()))
        started.append(
            subprocess.Popen(
                [sys.executable, "-c", PLAIN_RECORDER, str(file), total, *topics],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def finished(process: subprocess.Popen[str], seconds: float = 60) -> str:
    """What a process that must end well printed on stderr."""
    stdout, stderr = process.communicate(timeout=seconds)
    assert process.returncode == 0, stdout + stderr
    return stderr


def test_a_replay_recorded_again_is_the_original(network: Any, domain: int, plain: Any) -> None:
    """By our recorder and by a plain subscriber at once, as fast as it goes: all messages, their order, their times."""
    result = network.run(network.experiment(run={"processes": 2}), domain=None)
    original = contents(mcap(result.bag))
    assert len(original) == 7
    recorder = network.start("recorder", result.bag / "log" / "run.json", "--out", network.directory / "again")
    other = plain(network.directory / "plain.mcap", {topic: len(data) for topic, data in original.items()})
    played = network.start("play", result.bag, "--rate", "max", "--await", "recorder", "--await", "plain")
    assert f"{sum(map(len, original.values()))} messages played" in finished(played)
    finished(other)
    time.sleep(0.5)
    recorder.send_signal(signal.SIGINT)  # nobody says `end` to it
    recorder.communicate(timeout=30)
    assert contents(network.directory / "plain.mcap") == original
    assert contents(mcap(network.directory / "again")) == original
    again = read_bag(network.directory / "again")
    assert again.completeness.complete
    assert (again.completeness.duplicates, again.completeness.out_of_order) == (0, 0)
    assert (again.states == result.trajectory.states).all()


def test_a_stopped_reader_loses_nothing(network: Any, domain: int, bag: Path, plain: Any) -> None:
    """The bag again and again, to a reader that is stopped for 2 s: the player waits, and goes on where it was."""
    original, file = contents(mcap(bag)), network.directory / "plain.mcap"
    reader = plain(file, dict.fromkeys(original, 2000))
    played = network.start("play", bag, "--rate", "max", "--wait-for-subscribers", "1", "--loop")
    network.wait_for(lambda: file.exists() and file.stat().st_size > 100_000, 30, "messages")
    reader.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    reader.send_signal(signal.SIGCONT)
    finished(reader)
    played.send_signal(signal.SIGINT)
    _, stderr = played.communicate(timeout=30)
    assert played.returncode == 130, stderr
    assert "Traceback" not in stderr
    found = contents(file)
    assert set(found) == set(original)
    for topic, messages in found.items():
        assert texts(messages) == (texts(original[topic]) * 1000)[: len(messages)], topic


def test_a_late_reader_gets_what_is_latched(network: Any, domain: int, bag: Path, plain: Any) -> None:
    """It comes in the middle of a replay that began in the middle: the experiment and the graphs are all there."""
    original = contents(mcap(bag))
    played = network.start("play", bag, "--start-offset", "7", "--rate", "0.5")
    time.sleep(3.0)
    late = plain(network.directory / "plain.mcap", {"/experiment": 1, "/graph": 2})
    finished(late)
    found = contents(network.directory / "plain.mcap")
    assert texts(found["/experiment"]) == texts(original["/experiment"])
    assert texts(found["/graph"]) == texts(original["/graph"][: len(found["/graph"])])
    played.send_signal(signal.SIGTERM)
    _, stderr = played.communicate(timeout=30)
    assert played.returncode == 128 + signal.SIGTERM, stderr


def test_a_part_under_other_names_with_the_time(network: Any, domain: int, bag: Path, plain: Any) -> None:
    """Offset, duration, selection, remapping and /clock."""
    original = contents(mcap(bag))
    wanted = original["/agent_2/state"][100:141]  # of 5.0 .. 7.0
    other = plain(network.directory / "plain.mcap", {"/lab/state": len(wanted), "/clock": 5})
    options = ("--topics", "/agent_[12]/state", "-x", "agent_1/*", "-m", "/agent_2/state:=/lab/state", "--clock", "20")
    played = network.start("play", bag, *options, "--start-offset", "5", "--duration", "2", "--await", "plain")
    finished(other)
    found = contents(network.directory / "plain.mcap")
    assert set(found) == {"/lab/state", "/clock"}
    assert found["/lab/state"] == wanted[: len(found["/lab/state"])]
    times = [int.from_bytes(d[4:8], "little") + int.from_bytes(d[8:12], "little") / 1e9 for d in found["/clock"]]
    assert times == sorted(times)
    assert 5.0 <= times[0] < 5.5
    assert times[-1] <= 7.0
    played.send_signal(signal.SIGINT)
    played.communicate(timeout=30)


class Terminal:
    """A program on a terminal of its own."""

    def __init__(self, *arguments: str | Path) -> None:
        self._master, slave = pty.openpty()
        self.before = termios.tcgetattr(slave)
        self._slave = slave
        self.text = ""
        program = Path(sys.executable).with_name("msg-agents")

        def own() -> None:
            os.setsid()
            import fcntl

            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [program, *map(str, arguments)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=own,
        )

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def mode(self) -> list[Any]:
        return termios.tcgetattr(self._slave)

    def read(self, seconds: float) -> str:
        """What is printed within so much time."""
        end, new = time.monotonic() + seconds, ""
        while (left := end - time.monotonic()) > 0:
            if select.select([self._master], [], [], left)[0]:
                new += os.read(self._master, 65536).decode(errors="replace")
        self.text += new
        return new

    def wait_for(self, text: str, seconds: float = 30) -> None:
        end = time.monotonic() + seconds
        while text not in self.text:
            assert time.monotonic() < end, f"no {text!r} in {self.text!r}"
            self.read(0.1)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def terminal(domain: int) -> Iterator[Any]:
    opened: list[Terminal] = []

    def start(*arguments: str | Path) -> Terminal:
        opened.append(Terminal(*arguments))
        return opened[-1]

    yield start
    for each in opened:
        each.close()


def test_keys_pause_and_step(network: Any, bag: Path, plain: Any, terminal: Any) -> None:
    """Paused, three steps give three messages; the space bar gives the rest; then the terminal is as it was."""
    file = network.directory / "plain.mcap"
    first = plain(file, {"/agent_3/state": 3})
    screen = terminal("play", bag, "--paused", "--rate", "max", "--topics", "/agent_3/state", "--await", "plain")
    screen.wait_for("paused")
    for key in (b"s", b"\x1b[C", b"s"):
        screen.type(key)
        screen.read(0.2)
    finished(first)
    assert contents(file) == {"/agent_3/state": contents(mcap(bag))["/agent_3/state"][:3]}
    assert screen.mode() != screen.before
    screen.type(b" ")
    screen.wait_for("301 messages played")
    assert screen.process.wait(timeout=30) == 0
    assert screen.mode() == screen.before


def test_the_terminal_is_left_as_it_was(bag: Path, terminal: Any) -> None:
    """Whatever ends the player."""
    screens = {number: terminal("play", bag) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    for number, screen in screens.items():
        screen.wait_for("x 1")
        assert screen.mode() != screen.before
        if number == signal.SIGINT:
            screen.type(b"\x03")
        else:
            screen.process.send_signal(number)
        assert screen.process.wait(timeout=30) == 128 + number
        assert screen.mode() == screen.before
        screen.read(0.2)
        assert "Traceback" not in screen.text
