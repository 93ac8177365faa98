"""Other publishers on the topics of a run: refused, counted, and without any effect on the result."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_agents.check import check
from msg_agents.domain import free_domain
from msg_agents.environment import node_environment
from msg_agents.network import ProcessPlan, plan_network
from msg_agents.supervisor import Supervisor
from msg_analysis.bags.cdr import ActiveGraph, AgentState, Progress, encode_string
from msg_analysis.bags.reader import read_bag
from msg_analysis.model.record import RunRecord
from msg_analysis.model.trajectory import Trajectory
from msg_analysis.twin import new_record

STEPS = 300
# Waits for every reader of the run, publishes everything, waits until they have it, and only then appears as the node
# that the agents and the switcher have been told to wait for.
STRANGER = """
import sys, time
from pathlib import Path
import rclpy
from rclpy.duration import Duration
from msg_agents_interfaces.msg import ActiveGraph, AgentState, Progress
from std_msgs.msg import String
from msg_agents.qos import LATCHED, STREAM

AGENTS, PROCESSES = 5, 2
rclpy.init()
node = rclpy.create_node("stranger", enable_rosout=False)
kinds = {"graph": ActiveGraph, "progress": Progress, "end": Progress, "experiment": String}
readers = {"graph": PROCESSES + 1, "progress": 1, "end": PROCESSES + 1, "experiment": 1}
readers |= {f"agent_{i}/state": 2 for i in (1, 2, 3, 5)}  # the recorder and the neighbour in the other process
readers["agent_4/state"] = 1
messages = [line.split() for line in Path(sys.argv[1]).read_text().splitlines()]
publishers = {
    topic: node.create_publisher(kinds.get(topic, AgentState), topic, LATCHED) for topic in dict(messages)
}
for topic, publisher in publishers.items():
    while publisher.get_subscription_count() < readers[topic]:
        time.sleep(0.1)
for topic, data in messages:
    publishers[topic].publish(bytes.fromhex(data))
for publisher in publishers.values():
    assert publisher.wait_for_all_acked(Duration(seconds=30))
referee = rclpy.create_node("referee", enable_rosout=False)
topics = {"graph": ActiveGraph} | {f"agent_{i}/state": AgentState for i in range(1, AGENTS + 1)}
for topic, kind in topics.items():
    referee.create_subscription(kind, topic, lambda _: None, LATCHED if topic == "graph" else STREAM)
time.sleep(600)
"""
Forgery = tuple[str, bytes]  # topic, message


@pytest.fixture
def run_beside(network: Any) -> Callable[[RunRecord, list[Forgery]], tuple[Trajectory, dict[str, str]]]:
    """Runs a network while a stranger's messages meet every reader before those of the run."""

    def run(record: RunRecord, forgeries: list[Forgery]) -> tuple[Trajectory, dict[str, str]]:
        directory: Path = network.directory
        (directory / "run.json").write_text(record.to_json())
        (directory / "forged").write_text("".join(f"{topic} {data.hex()}\n" for topic, data in forgeries))
        with free_domain() as domain:
            environment = node_environment(domain)
            with _stranger(directory / "forged", environment), Supervisor(directory, environment) as nodes:
                plans = plan_network(record.experiment, directory / "run.json", directory / "bag")
                nodes.start([plans[0], *(_awaiting_referee(plan) for plan in plans[1:])])
                network.wait_for(lambda: not nodes.running or nodes.failures, 90, "the end of the run")
                failures = [(child.plan.name, child.failure, child.last_words()) for child in nodes.failures]
        assert failures == []
        return read_bag(directory / "bag"), {child.plan.name: child.log.read_text() for child in nodes.children}

    return run


def _awaiting_referee(plan: ProcessPlan) -> ProcessPlan:
    return dataclasses.replace(plan, arguments=(*plan.arguments, "--await", "referee"))


@contextmanager
def _stranger(file: Path, environment: dict[str, str]) -> Iterator[None]:
    command = [sys.executable, "-P", "-c", STRANGER, str(file)]
    with subprocess.Popen(command, env=environment) as process:
        try:
            yield
        finally:
            process.kill()


def states(run: bytes, agent: int, *, replicas: int = 2, value: float = 9.0) -> list[Forgery]:
    """A whole run of one agent."""
    state = np.full(replicas, value)
    return [
        (f"agent_{agent}/state", AgentState(k * 50_000_000, run, agent, k, 1 if k else 0, state).encode())
        for k in range(STEPS + 1)
    ]


def graph(run: bytes, **changes: Any) -> Forgery:
    fields: dict[str, Any] = {
        "sequence": 0,
        "mode": 2,
        "name": "ring",
        "first_step": 0,
        "last_step": STEPS - 1,
    } | changes
    return "graph", ActiveGraph(stamp=0, run=run, **fields).encode()


def test_another_run_of_the_same_experiment(network: Any, run_beside: Any) -> None:
    """Complete and well-formed, but of another run: its states, its graph, its progress, its record, its end."""
    record = new_record(network.experiment(run={"processes": 2}))
    other = new_record(network.experiment(run={"processes": 2, "seed": 8}))
    run = other.run.bytes
    forged = [("experiment", encode_string(other.to_json())), graph(run)]
    forged += [message for agent in range(1, 6) for message in states(run, agent)]
    forged += [("progress", Progress(0, run, agent, STEPS).encode()) for agent in range(6)]
    forged += [("end", Progress(0, run, 0, STEPS).encode())]
    trajectory, logs = run_beside(record, forged)
    assert trajectory.completeness.complete
    assert trajectory.record.run == record.run
    outcome = check(trajectory)
    assert (outcome.difference, outcome.missing) == (None, 0)
    for name, log in logs.items():
        assert "refused a message on" in log, name


def test_nonsense(network: Any, run_beside: Any) -> None:
    """Bytes that are no message, and messages of this run that cannot be."""
    record = new_record(network.experiment(run={"processes": 2}))
    run = record.run.bytes
    garbage = [
        b"",
        b"\x00",
        b"\x00\x01\x00\x00",
        bytes(range(40)),
        b"\xff" * 200,
        b"\x00\x01\x00\x00" + b"\xff" * 96,
    ]
    topics = ["agent_1/state", "agent_3/state", "graph", "progress", "end", "experiment"]
    forged = [(topic, data) for topic in topics for data in garbage if data]
    forged += states(run, 1, replicas=3) + states(run, 2, replicas=1)
    forged += [("agent_4/state", data) for _, data in states(run, 5)[:10]]  # on another agent's topic
    forged += [graph(run, sequence=7), graph(run, first_step=5), graph(run, first_step=9, last_step=3)]
    forged += [("progress", Progress(0, run, agent, STEPS).encode()) for agent in (6, 2**32 - 1)]
    forged += [("experiment", encode_string(text)) for text in ("", "{}", "[1]", '{"run": 1}', "hello")]
    trajectory, _ = run_beside(record, forged)
    assert trajectory.completeness.received == trajectory.completeness.expected
    assert check(trajectory).difference is None
    assert trajectory.completeness.duplicates == 0
    assert trajectory.completeness.refused["wrong length"] == 2 * (STEPS + 1)
    # Sojourns that the agents refused are in the bag beside the true ones: no verdict rather than a wrong one.
    assert trajectory.completeness.missing_modes > 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_states_of_this_run_that_are_not_finite(network: Any, run_beside: Any, value: float) -> None:
    """Right run, right agent, right steps, and there before the truth."""
    record = new_record(network.experiment(run={"processes": 2}))
    forged = [message for agent in range(1, 6) for message in states(record.run.bytes, agent, value=value)]
    trajectory, _ = run_beside(record, forged)
    assert trajectory.completeness.complete
    assert trajectory.completeness.refused["not finite"] == 5 * (STEPS + 1)
    assert check(trajectory).difference is None
