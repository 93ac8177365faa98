"""A run that the user ends: in order, with a valid bag, and nothing left behind."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import time
from typing import Any

import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from msg_analysis.bags.reading import read_bag
from msg_analysis.runs import read_result
from msg_analysis.twin.check import check

NAMES = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
# 20,000 steps: no test waits for them; of states that are soon seen in the bag
LONG = {"duration": 1000, "replicas": 16, "processes": 2}


def test_in_the_middle(network: Any, repetition: int, rng: random.Random) -> None:
    number = signal.SIGTERM if repetition % 2 else signal.SIGINT
    run = network.start("run", network.file(run=LONG), "--out", network.directory / "runs", "--json")
    network.wait_until_moving()
    time.sleep(rng.uniform(0.0, 1.0) if repetition else 0.0)
    assert network.shared_memory() == set()
    run.send_signal(number)
    stdout, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    assert network.processes() == []
    assert re.search(rf"^failed: stopped by {NAMES[number]} at step \d+ of 20000$", stderr, re.M)
    assert "Traceback" not in stderr
    assert stdout.count("\n") == 1  # one JSON object

    (bag,) = (network.directory / "runs").iterdir()
    result = json.loads(stdout)
    assert (result["verdict"], result["bag"], result["report"]) == ("incomplete", str(bag), None)
    assert result == json.loads((bag / "result.json").read_text())
    assert read_result(bag).verdict == "incomplete"  # as `msg-analysis tabulate` does
    custom = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["custom_data"]
    assert custom["complete"] == "false"
    assert "salvaged" not in custom
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        count = sum(1 for connection, *_ in reader.messages() if connection.topic.endswith("/state"))
    trajectory = read_bag(bag)
    assert trajectory.completeness.received == count > 0
    assert not trajectory.completeness.complete
    assert check(trajectory).difference is None


def test_before_anything_has_begun(network: Any, repetition: int, rng: random.Random) -> None:
    """While the processes start and look for each other."""
    run = network.record(network.file(run=LONG))
    network.wait_for(network.nodes, 60, "a child")
    time.sleep(rng.uniform(0.0, 1.5) if repetition else 0.0)
    number = signal.SIGINT if repetition % 2 else signal.SIGTERM
    run.send_signal(number)
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    assert f"failed: stopped by {NAMES[number]} " in stderr
    assert "Traceback" not in stderr
    assert network.processes() == []


def test_while_the_run_is_compared_with_the_prediction(network: Any) -> None:
    """The network has ended; the user does not wait for the verdict. The bag is whole, and can be compared later."""
    graphs = {"line": {"path": list(range(1, 31))}, "ring": {"cycle": list(range(1, 31))}}
    file = network.file(graphs=graphs, run={"duration": 100, "replicas": 1, "processes": 1})
    run = network.start("run", file, "--out", network.directory / "runs", "--json")
    network.wait_for(lambda: list(network.directory.glob("runs/*/log/run.json")), 60, "the end of the network")
    time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    stdout, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    assert stderr.splitlines()[-1] == "failed: stopped by Ctrl-C while the run was compared with the prediction"
    (bag,) = (network.directory / "runs").iterdir()
    result = json.loads(stdout)
    assert (result["verdict"], result["bag"], result["report"]) == ("incomplete", str(bag), None)
    assert result == json.loads((bag / "result.json").read_text())
    assert read_bag(bag).completeness.complete


def test_at_any_moment_after_the_network(network: Any) -> None:
    """As soon as the logs are being kept: whatever is done then, the result is printed, and the bag is whole."""
    many = {"duration": 5, "replicas": 500}  # so that the comparison takes longer than this test needs to see the logs
    run = network.start("run", network.file(run=many), "--out", network.directory / "runs", "--json")
    network.wait_for(lambda: list(network.directory.glob("runs/*/log")), 60, "the end of the network")
    run.send_signal(signal.SIGINT)
    stdout, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    assert stderr.splitlines()[-1].startswith("failed: stopped by Ctrl-C while the ")
    (bag,) = (network.directory / "runs").iterdir()
    assert json.loads(stdout)["verdict"] == "incomplete"
    assert read_bag(bag).completeness.complete


def test_agents_that_are_interrupted_say_nothing(network: Any) -> None:
    """A signal shuts rclpy down between two calls of a callback, and what is then published is no error of ours."""
    fast = LONG | {"pace": "realtime", "speed": 60.0}
    run = network.record(network.file(run=fast), "--restarts", "0")
    network.wait_until_moving()
    agents = network.processes("agent")
    for process in agents:
        os.kill(process.pid, signal.SIGINT)
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == 3, stderr
    (bag,) = (network.directory / "runs").iterdir()
    for log in (bag / "log").glob("*.log"):
        assert not re.search("FATAL|Traceback|Error", log.read_text()), log


def test_a_killed_runner_takes_everybody_along(network: Any) -> None:
    run = network.record(network.file(run=LONG))
    network.wait_until_moving()
    assert {process.kind for process in network.nodes()} == {"agent", "switcher", "recorder"}
    run.kill()
    run.communicate(timeout=60)
    network.wait_for(lambda: network.processes() == [], 10, "the end of every child")
    network.traces.clear()  # whoever runs the next network clears its folder away
    (bag,) = (network.directory / "runs").iterdir()
    trajectory = read_bag(bag)  # its recorder had the time to close it
    assert trajectory.completeness.received > 0
    assert check(trajectory).difference is None
