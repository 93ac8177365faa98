"""Bags that are played again by one process and recorded by others; keys, Ctrl-C, Ctrl-Z and `fg`."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer
from recorded import contents, mcap, texts
from terminal import Terminal
from waiting import state_of

from msg_analysis.bags.reading import read_bag


def test_a_replay_recorded_again_is_the_original(network: Any, domain: int, plain: Any) -> None:
    """By our recorder and by a plain subscriber at once, as fast as it goes: all messages, their order, their times."""
    result = network.run(network.experiment(run={"processes": 2}), domain=None)
    original = contents(mcap(result.bag))
    assert len(original) == 7
    recorder = network.start("recorder", result.bag / "log" / "run.json", "--out", network.directory / "again")
    other = plain(network.directory / "plain.mcap", {topic: len(data) for topic, data in original.items()})
    played = network.start("play", result.bag, "--rate", "max", "--await", "recorder", "--await", "plain")
    assert f"{sum(map(len, original.values()))} messages played" in network.ended(played)[1]
    network.ended(other)
    time.sleep(0.5)
    recorder.send_signal(signal.SIGINT)  # nobody says `end` to it
    recorder.communicate(timeout=30)
    assert contents(network.directory / "plain.mcap") == original
    assert contents(mcap(network.directory / "again")) == original
    again = read_bag(network.directory / "again")
    assert again.completeness.complete
    assert (again.completeness.duplicates, again.completeness.out_of_order) == (0, 0)
    assert (again.states == result.trajectory.states).all()


@pytest.mark.timeout(240)
def test_a_stopped_reader_loses_nothing(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """The bag again and again, to a reader that is stopped for 2 s: the player waits, and goes on where it was."""
    original, file = contents(mcap(twin_bag)), network.directory / "plain.mcap"
    reader = plain(file, {topic: 6 * len(messages) for topic, messages in original.items()})
    played = network.start("play", twin_bag, "--rate", "max", "--wait-for-subscribers", "1", "--loop")
    network.wait_for(lambda: file.exists() and file.stat().st_size > 50_000, 60, "messages")
    reader.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    reader.send_signal(signal.SIGCONT)
    network.ended(reader)
    played.send_signal(signal.SIGINT)
    network.ended(played, 130)
    found = contents(file)
    assert set(found) == set(original)
    for topic, messages in found.items():
        assert texts(messages) == (texts(original[topic]) * 1000)[: len(messages)], topic


def test_a_late_reader_gets_what_is_latched(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """It comes in the middle of a replay that began in the middle: the experiment and the graphs are all there."""
    original = contents(mcap(twin_bag))
    played = network.start("play", twin_bag, "--start-offset", "7", "--rate", "0.5")
    time.sleep(2.0)
    late = plain(network.directory / "plain.mcap", {"/experiment": 1, "/graph": 2})
    network.ended(late)
    found = contents(network.directory / "plain.mcap")
    assert texts(found["/experiment"]) == texts(original["/experiment"])
    assert texts(found["/graph"]) == texts(original["/graph"][: len(found["/graph"])])
    played.send_signal(signal.SIGTERM)
    network.ended(played, 128 + signal.SIGTERM)


def test_a_part_under_other_names_with_the_time(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """Offset, duration, selection, remapping and /clock."""
    original = contents(mcap(twin_bag))
    wanted = original["/agent_2/state"][100:141]  # of 5.0 .. 7.0
    other = plain(network.directory / "plain.mcap", {"/lab/state": len(wanted), "/clock": 5})
    options = ("--topics", "/agent_[12]/state", "-x", "agent_1/*", "-m", "/agent_2/state:=/lab/state", "--clock", "20")
    played = network.start("play", twin_bag, *options, "--start-offset", "5", "--duration", "2", "--await", "plain")
    network.ended(other)
    found = contents(network.directory / "plain.mcap")
    assert set(found) == {"/lab/state", "/clock"}
    assert found["/lab/state"] == wanted[: len(found["/lab/state"])]
    times = [int.from_bytes(d[4:8], "little") + int.from_bytes(d[8:12], "little") / 1e9 for d in found["/clock"]]
    assert times == sorted(times)
    assert 5.0 <= times[0] < 5.5
    assert times[-1] <= 7.0
    played.send_signal(signal.SIGINT)
    played.communicate(timeout=30)


def test_nothing_but_the_time_is_refused(network: Any, domain: int) -> None:
    """With --clock, the bag's own /clock is not played; where that was all, somebody should know."""
    file = network.directory / "clock.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema("rosgraph_msgs/msg/Clock", "ros2msg", b"")
        channel = writer.register_channel("/clock", "cdr", schema)
        writer.add_message(channel, 1, bytes([0, 1, 0, 0]) + bytes(8), 1)
        writer.finish()
    played = network.start("play", file, "--clock", "10")
    _, stderr = network.ended(played, 2)
    assert "error: --clock: publishes /clock itself, and nothing else is chosen" in stderr
    assert "1 messages played" in network.ended(network.start("play", file, "--rate", "max"))[1]


PROGRAM = Path(sys.executable).with_name("msg-agents")
SINGLE_KEYS = 0  # of ICANON and ECHO


def test_keys_pause_and_step(network: Any, domain: int, twin_bag: Path, plain: Any, terminal: Any) -> None:
    """Paused, three steps give three messages; the space bar gives the rest; then the terminal is as it was."""
    file = network.directory / "plain.mcap"
    first = plain(file, {"/agent_3/state": 3})
    screen = terminal(
        "msg-agents", "play", twin_bag, "--paused", "--rate", "max", "--topics", "/agent_3/state", "--await", "plain"
    )
    screen.wait_for("paused")
    screen.wait_for("space: pause")
    for key in (b"s", b"\n", b"s"):
        screen.type(key)
        screen.read(0.2)
    assert first.wait(timeout=60) == 0
    assert contents(file) == {"/agent_3/state": contents(mcap(twin_bag))["/agent_3/state"][:3]}
    assert screen.mode() != screen.before
    screen.type(b" ")
    screen.wait_for("301 messages played")
    assert screen.process.wait(timeout=30) == 0
    assert screen.mode() == screen.before


def paused_player(terminal: Any, bag: Path) -> Terminal:
    """One that waits for the node `plain`, and shows that it stands still."""
    screen: Terminal = terminal(
        *("msg-agents", "play", bag, "--paused", "--rate", "max", "--await", "plain"),
        *("--topics", "/agent_3/state", "--topics", "/graph"),
    )
    screen.wait_for("paused")
    return screen


def test_forward(network: Any, domain: int, twin_bag: Path, plain: Any, terminal: Any) -> None:
    """The right arrow leaves out 5 % of 15 s, but no graph; the reader then has those of the new place."""
    recorded = contents(mcap(twin_bag))
    file = network.directory / "plain.mcap"
    first = plain(file, {"/agent_3/state": 301 - 45, "/graph": len(recorded["/graph"])})
    screen = paused_player(terminal, twin_bag)
    screen.type(3 * b"\x1b[C")
    screen.wait_for("2.2/15.0 s")
    screen.type(b" ")
    assert first.wait(timeout=60) == 0
    screen.wait_for("messages played")
    assert screen.process.wait(timeout=30) == 0
    assert contents(file) == {"/agent_3/state": recorded["/agent_3/state"][45:], "/graph": recorded["/graph"]}


def test_to_a_typed_time(network: Any, domain: int, twin_bag: Path, plain: Any, terminal: Any) -> None:
    """Forward only; what is no time, or before or past what is left, is said, and nothing happens."""
    recorded = contents(mcap(twin_bag))
    file = network.directory / "plain.mcap"
    first = plain(file, {"/agent_3/state": 301 - 250, "/graph": len(recorded["/graph"])})
    screen = paused_player(terminal, twin_bag)
    for typed, said in (
        (b"1.2.5\n", "1.2.5: expected a time in seconds"),
        (b"150\n", "150 s: expected a time up to 15 s"),
        (b"12.7\x7f5", "go to 12.5 s"),
        (b"\n", "12.5/15.0 s"),
        (b"3\n", "3 s: there is no way back from 12.5 s: start again with --start-offset 3"),
    ):
        screen.type(typed)
        screen.wait_for(said)
    screen.type(b" ")
    assert first.wait(timeout=60) == 0
    screen.wait_for("messages played")
    assert screen.process.wait(timeout=30) == 0
    assert contents(file) == {"/agent_3/state": recorded["/agent_3/state"][250:], "/graph": recorded["/graph"]}


def test_the_terminal_is_left_as_it_was(domain: int, twin_bag: Path, terminal: Any) -> None:
    """Whatever ends the player; the bag alone never does."""
    screens = {
        number: terminal("msg-agents", "play", "--loop", twin_bag)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    for number, screen in screens.items():
        screen.wait_for("x 1")
        assert screen.mode() != screen.before
        if number == signal.SIGINT:
            screen.type(b"\x03")
        else:
            screen.process.send_signal(number)
        # Reads meanwhile: a full terminal would hold up the end, and what it shows is said if there is none.
        assert screen.read_to_the_end(30) == 128 + number
        assert screen.mode() == screen.before
        assert "Traceback" not in screen.text


def test_stopped_and_continued(
    network: Any, domain: int, twin_bag: Path, terminal: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-Z twice, `fg`, `bg` and `fg`, under a shell: while it stands the terminal is as the shell left it."""
    # The time that it stands is no time of the bag. A shell that restores nothing by itself shows most.
    # Fast DDS 2.14 sometimes leaves the port of a process that stood in shared memory, which is not the matter here.
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    screen = terminal("/bin/sh", "-i")
    screen.wait_for("$ ", "# ")
    usual = screen.local_flags()
    began = time.monotonic()
    screen.type(f"{PROGRAM} play {twin_bag} --rate 0.5\n".encode())
    screen.wait_for("x 0.5")
    assert screen.local_flags() == SINGLE_KEYS
    (player,) = network.processes("play")
    stood = 0.0
    for continued in (b"fg\n", b"bg\n"):
        screen.type(b"\x1a")
        network.wait_for(lambda: state_of(player.pid) == "T", 10, "a stopped player")
        standing = time.monotonic()
        assert screen.local_flags() == usual
        screen.read(1.5)
        stood += time.monotonic() - standing
        screen.type(continued)
        network.wait_for(lambda: state_of(player.pid) != "T", 10, "a player that goes on")
    assert screen.local_flags() == usual
    screen.type(b"fg\n")
    network.wait_for(lambda: screen.local_flags() == SINGLE_KEYS, 10, "single keys")
    screen.type(b" ")
    screen.wait_for("paused")
    screen.type(b"\x03")
    screen.wait_for("stopped at")
    took = time.monotonic() - began - stood
    found = re.search(r"stopped at ([\d.]+) s of the bag", screen.text)
    assert 0 < float(found[1]) <= 0.5 * took
    network.wait_for(lambda: not network.processes("play"), 10, "the end of the player")
    assert screen.local_flags() == usual


def test_standing_is_no_time_of_the_bag_without_a_terminal(network: Any, domain: int, twin_bag: Path) -> None:
    """SIGSTOP, of which no process hears, and no stdin at all: 3 s of the bag take 3 s beside the 2 s that it stood."""
    began = time.monotonic()
    played = subprocess.Popen(
        ["/bin/sh", "-c", f"exec {PROGRAM} play {twin_bag} --duration 3 --topics graph --clock 50 <&-"],
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(2.5)
    played.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    played.send_signal(signal.SIGCONT)
    _, stderr = network.ended(played)
    assert "messages played" in stderr
    # It looks for readers for 0.8 s at least; the last message before the third second is a little before it.
    assert time.monotonic() - began > 0.8 + 2.5 + 2.0


def test_ctrl_c_while_waiting_for_readers(network: Any, domain: int, twin_bag: Path, terminal: Any) -> None:
    """It says for whom it waits, and what was played: nothing."""
    screen = terminal("msg-agents", "play", twin_bag, "--await", "nobody")
    screen.wait_for("waiting for readers, 30 s at most: nobody does not read /agent_1/state")
    screen.type(b"\x03")
    assert screen.process.wait(timeout=30) == 130
    assert screen.mode() == screen.before
    screen.wait_for("stopped before the start")
    assert "Traceback" not in screen.text
