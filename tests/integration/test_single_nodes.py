"""The single nodes, as another launcher would start them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from networks import run_file

from msg_agents.discovery.rtps import free_domain
from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check


@pytest.fixture
def record(network: Any) -> Path:
    return run_file(network.directory, 5)


def test_started_by_hand(network: Any, record: Path) -> None:
    """In any order, with the environment that ROS has by default but for the domain."""
    bag = network.directory / "mine"
    await_recorder = ("--await", "recorder")
    with free_domain() as domain:
        nodes: list[subprocess.Popen[str]] = [
            network.execute(*command, ROS_DOMAIN_ID=str(domain))
            for command in (
                ("switcher", record, *await_recorder),
                ("agent", record, "--agent", "5", *await_recorder),
                ("recorder", record, "--out", bag),
                ("agent", record, *(p for i in "2413" for p in ("--agent", i)), *await_recorder),
            )
        ]
        for node in nodes:
            stdout, stderr = node.communicate(timeout=90)
            assert (node.returncode, stdout) == (0, ""), stderr
    trajectory = read_bag(bag)
    assert trajectory.completeness.complete
    assert check(trajectory).difference is None


def test_interrupted_again_and_again(network: Any) -> None:
    """Until the last moment of a process: it ends in order, and leaves no shared memory (``network`` looks)."""
    record = run_file(network.directory, 5, run={"duration": 5000})
    await_recorder = ("--await", "recorder")
    older = set(Path("/dev/shm").glob("fastrtps*"))  # of killed processes of others
    with free_domain() as domain:
        nodes = [
            # Executed, not forked: a process that ends has a Python of its own to take down.
            subprocess.Popen(
                [sys.executable, "-m", "msg_agents", *map(str, command)],
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONSAFEPATH": "1"},
            )
            for command in (
                ("switcher", record, *await_recorder),
                ("agent", record, *(p for i in "12345" for p in ("--agent", i)), *await_recorder),
                ("recorder", record, "--out", network.directory / "runs" / "mine"),
            )
        ]
        network.wait_until_moving()
        network.processes()
        while running := [node for node in nodes if node.poll() is None]:
            for node in running:
                node.send_signal(signal.SIGINT)
            time.sleep(0.002)
    for node in nodes:
        _, stderr = node.communicate()
        assert (node.returncode, "Traceback" in stderr) == (3, False), stderr
    network.traces.difference_update(older)


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        (("agent", "--agent", "1", "--await", "recorder"), ["agent_2", "agent_5", "recorder"]),
        (("switcher",), [f"agent_{i}" for i in range(1, 6)]),
    ],
    ids=["agent", "switcher"],
)
def test_alone(network: Any, record: Path, command: tuple[str, ...], missing: list[str]) -> None:
    """Nobody comes: exit code 2 (something is wrong with what was started), naming everyone who is missing."""
    kind, *options = command
    with free_domain() as domain:
        node = network.execute(kind, record, *options, "--discovery-timeout", "3", ROS_DOMAIN_ID=str(domain))
        stdout, stderr = node.communicate(timeout=60)
    assert (node.returncode, stdout) == (2, ""), stderr
    error = re.search(r"^error: after 3 s (.*) did not discover: (.*?)\. Are they running", stderr, re.MULTILINE)
    assert error, stderr
    assert error[2].split(", ") == missing
    assert f"in ROS_DOMAIN_ID {domain} and" in stderr
    assert "Traceback" not in stderr


def test_the_others_end_without_an_agent(network: Any) -> None:
    """A process of agents leaves and does not come back: all end by themselves, and the bag is closed."""
    record = run_file(network.directory, 5, run={"pace": "realtime", "duration": 900, "speed": 5})
    bag = network.directory / "runs/mine"
    options = ("--await", "recorder", "--timeout", "2")
    with free_domain() as domain:
        *others, leaving = (
            network.execute(*command, ROS_DOMAIN_ID=str(domain))
            for command in (
                ("switcher", record, *options),
                ("agent", record, *(p for i in "2345" for p in ("--agent", i)), *options),
                ("recorder", record, "--out", bag, *options[2:]),
                ("agent", record, "--agent", "1", *options),
            )
        )
        network.wait_until_moving()
        leaving.terminate()
        assert leaving.wait(30) == 3
        for node in others:
            _, stderr = node.communicate(timeout=60)
            assert (node.returncode, "left the network" in stderr) == (2, True), stderr
    trajectory = read_bag(bag)
    assert (trajectory.completeness.complete, check(trajectory).difference) == (False, None)
    assert "complete: 'false'" in (bag / "metadata.yaml").read_text()


@pytest.mark.timeout(150)
def test_a_missing_agent_is_named_by_the_others(network: Any, record: Path) -> None:
    """The switcher gives up first: the agents are still there, so it misses nobody else."""
    others = [part for number in "1235" for part in ("--agent", number)]
    with free_domain() as domain:
        nodes = [
            network.execute(*command, ROS_DOMAIN_ID=str(domain))
            for command in (
                ("switcher", record, "--discovery-timeout", "6"),
                ("agent", record, *others, "--discovery-timeout", "10"),
            )
        ]
        texts = [node.communicate(timeout=60)[1] for node in nodes]
    assert [node.returncode for node in nodes] == [2, 2], texts
    for text in texts:
        assert "did not discover: agent_4. Are they running" in text
