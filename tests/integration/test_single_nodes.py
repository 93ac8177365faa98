"""The single nodes, as another launcher would start them."""

import json
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from networks import assert_equal_to_twin, run_file

from msg_analysis.bags.reading import read_bag
from msg_analysis.twin.check import check


@pytest.fixture
def record(network: Any) -> Path:
    return run_file(network.directory, 5)


def test_started_by_hand(network: Any, domain: int, record: Path) -> None:
    """In any order, with the environment that ROS has by default but for the domain."""
    bag = network.directory / "mine"
    await_recorder = ("--await", "recorder")
    nodes = [
        network.execute("switcher", record, *await_recorder),
        network.execute("agent", record, "--agent", "5", *await_recorder),
        network.execute("recorder", record, "--out", bag),
        network.execute("agent", record, *agents("2413"), *await_recorder),
    ]
    assert [network.ended(node)[0] for node in nodes] == [""] * 4
    assert_equal_to_twin(read_bag(bag))


def agents(numbers: str) -> list[str]:
    return [part for number in numbers for part in ("--agent", number)]


def test_interrupted_again_and_again(network: Any, domain: int) -> None:
    """Until the last moment of a process: it ends in order, and leaves no shared memory (``network`` looks)."""
    record = run_file(network.directory, 5, run={"duration": 5000})
    await_recorder = ("--await", "recorder")
    older = set(Path("/dev/shm").glob("fastrtps*"))  # of killed processes of others
    nodes = [  # executed, not forked: a process that ends has a Python of its own to take down
        network.execute("switcher", record, *await_recorder),
        network.execute("agent", record, *agents("12345"), *await_recorder),
        network.execute("recorder", record, "--out", network.directory / "runs" / "mine"),
    ]
    network.wait_until_moving()
    network.processes()
    while running := [node for node in nodes if node.poll() is None]:
        for node in running:
            node.send_signal(signal.SIGINT)
        time.sleep(0.002)
    for node in nodes:
        network.ended(node, 3)
    network.traces.difference_update(older)


def test_alone(network: Any, domain: int, record: Path) -> None:
    """Nobody comes: exit code 2 (something is wrong with what was started), naming everyone who is missing."""
    options = ("--agent", "1", "--await", "recorder", "--discovery-timeout", "1")
    stdout, stderr = network.ended(network.start("agent", record, *options), 2)
    assert stdout == ""
    error = re.search(r"^error: after 1 s (.*) did not discover: (.*?)\. Are they running", stderr, re.MULTILINE)
    assert error, stderr
    assert error[2].split(", ") == ["agent_2", "agent_5", "recorder"]
    assert f"in ROS_DOMAIN_ID {domain} and" in stderr


def test_the_others_end_without_an_agent(network: Any, domain: int) -> None:
    """A process of agents leaves and does not come back: all end by themselves, and the bag is closed."""
    record = run_file(network.directory, 5, run={"pace": "realtime", "duration": 900, "speed": 5})
    bag = network.directory / "runs/mine"
    options = ("--await", "recorder", "--timeout", "2")
    others = [
        network.start("switcher", record, *options),
        network.start("agent", record, *agents("2345"), *options),
        network.start("recorder", record, "--out", bag, *options[2:]),
    ]
    leaving = network.start("agent", record, "--agent", "1", *options)
    network.wait_until_moving()
    leaving.terminate()
    assert leaving.wait(30) == 3
    assert all("left the network" in network.ended(node, 2)[1] for node in others)
    trajectory = read_bag(bag)
    assert (trajectory.completeness.complete, check(trajectory).difference) == (False, None)
    assert "complete: 'false'" in (bag / "metadata.yaml").read_text()


@pytest.mark.parametrize("other", ["agents", "recorder"])
def test_two_records_of_one_run(network: Any, domain: int, record: Path, other: str) -> None:
    """One process has a record with another seed, but the same id and key: it ends, and says so; the others end, too.

    One that has not found all others by then waits for the end of its time for that.
    """
    document = json.loads(record.read_text())
    document["experiment"]["run"]["seed"] += 1
    changed = record.with_name("changed.json")
    changed.write_text(json.dumps(document))
    files = {"agents": record, "recorder": record} | {other: changed}
    options = ("--await", "recorder", "--timeout", "2", "--discovery-timeout", "15")
    nodes = {
        "switcher": network.start("switcher", record, *options),
        "agents": network.start("agent", files["agents"], *agents("12345"), *options),
        "recorder": network.start(
            "recorder", files["recorder"], "--out", network.directory / "runs/mine", *options[2:]
        ),
    }
    words = f"has another run record than the switcher, both of run {document['run']}: give"
    assert words in network.ended(nodes.pop(other), 2)[1]
    for node in nodes.values():
        assert re.search("left the network|did not discover", network.ended(node, 2)[1])


@pytest.mark.timeout(150)
def test_a_missing_agent_is_named_by_the_others(network: Any, domain: int, record: Path) -> None:
    """The switcher gives up first: the agents are still there, so it misses nobody else."""
    nodes = [
        network.start("switcher", record, "--discovery-timeout", "6"),
        network.start("agent", record, *agents("1235"), "--discovery-timeout", "10"),
    ]
    for node in nodes:
        assert "did not discover: agent_4. Are they running" in network.ended(node, 2)[1]
