"""Bags that are played again by one process, and recorded again by others."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from mcap.writer import Writer
from recorded import contents, mcap, texts

from msg_analysis.bags.reading import read_bag


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


def test_a_stopped_reader_loses_nothing(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """The bag again and again, to a reader that is stopped for 2 s: the player waits, and goes on where it was."""
    original, file = contents(mcap(twin_bag)), network.directory / "plain.mcap"
    reader = plain(file, dict.fromkeys(original, 1000))
    played = network.start("play", twin_bag, "--rate", "max", "--wait-for-subscribers", "1", "--loop")
    network.wait_for(lambda: file.exists() and file.stat().st_size > 50_000, 30, "messages")
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


def test_a_late_reader_gets_what_is_latched(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """It comes in the middle of a replay that began in the middle: the experiment and the graphs are all there."""
    original = contents(mcap(twin_bag))
    played = network.start("play", twin_bag, "--start-offset", "7", "--rate", "0.5")
    time.sleep(3.0)
    late = plain(network.directory / "plain.mcap", {"/experiment": 1, "/graph": 2})
    finished(late)
    found = contents(network.directory / "plain.mcap")
    assert texts(found["/experiment"]) == texts(original["/experiment"])
    assert texts(found["/graph"]) == texts(original["/graph"][: len(found["/graph"])])
    played.send_signal(signal.SIGTERM)
    _, stderr = played.communicate(timeout=30)
    assert played.returncode == 128 + signal.SIGTERM, stderr


def test_a_part_under_other_names_with_the_time(network: Any, domain: int, twin_bag: Path, plain: Any) -> None:
    """Offset, duration, selection, remapping and /clock."""
    original = contents(mcap(twin_bag))
    wanted = original["/agent_2/state"][100:141]  # of 5.0 .. 7.0
    other = plain(network.directory / "plain.mcap", {"/lab/state": len(wanted), "/clock": 5})
    options = ("--topics", "/agent_[12]/state", "-x", "agent_1/*", "-m", "/agent_2/state:=/lab/state", "--clock", "20")
    played = network.start("play", twin_bag, *options, "--start-offset", "5", "--duration", "2", "--await", "plain")
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
    _, stderr = played.communicate(timeout=60)
    assert played.returncode == 2, stderr
    assert "error: --clock: publishes /clock itself, and nothing else is chosen" in stderr
    assert "1 messages played" in finished(network.start("play", file, "--rate", "max"))
