"""Processes that are introduced to each other, and others in their domain."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from msg_agents.discovery.profiles import FIRST_INTRODUCED
from msg_agents.discovery.ros_domain import free_domain
from msg_agents.discovery.rtps import discovery_port
from msg_agents.processes.environment import node_environment
from msg_analysis.twin.check import check

NODES = sorted(["recorder", "switcher", *(f"agent_{i}" for i in range(1, 6))])
VISITOR = """
import sys, time, rclpy
rclpy.init()
node = rclpy.create_node("visitor")
print("ready", flush=True)
wanted, end = set(sys.argv[1:]), time.monotonic() + 60
while not wanted <= set(node.get_node_names()) and time.monotonic() < end:
    time.sleep(0.05)
print(*sorted(node.get_node_names()), flush=True)
"""


@pytest.fixture
def domain() -> Iterator[int]:
    with free_domain() as number:
        yield number


def visit(environment: dict[str, str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-c", VISITOR, *NODES]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def surroundings(kind: str, domain: int) -> dict[str, str]:
    if kind == "our profile":
        return node_environment(domain)
    return os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@pytest.mark.parametrize("kind", ["ROS's own range", "our profile"])
@pytest.mark.parametrize("first", [True, False], ids=["before the run", "during the run"])
def test_a_visitor_sees_every_process(network: Any, domain: int, kind: str, first: bool) -> None:
    """Of a run in which no process knows more than half of the others."""
    graphs = {"line": {"path": [1, 2, 3, 4, 5]}, "none": {"edges": []}}
    file = network.file(graphs=graphs, run={"duration": 2000, "replicas": 32})  # large states are soon seen in the bag
    with ExitStack() as stack:
        visitors = [stack.enter_context(visit(surroundings(kind, domain)))] if first else []
        for visitor in visitors:
            assert visitor.stdout is not None
            assert visitor.stdout.readline() == "ready\n"
        run = network.record(file, "--domain", str(domain))
        network.wait_until_moving()
        visitors = visitors or [stack.enter_context(visit(surroundings(kind, domain)))]
        said, _ = visitors[0].communicate(timeout=90)
        run.terminate()
        run.communicate(timeout=60)
    assert said.splitlines()[-1].split() == [*NODES, "visitor"]


def test_a_domain_without_room_for_introductions(network: Any, domain: int) -> None:
    """Where others have all the numbers of visitors, the processes look for each other."""
    with ExitStack() as stack:
        for number in range(FIRST_INTRODUCED):
            other = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            other.bind(("127.0.0.1", discovery_port(domain, number)))
        result = network.run(network.experiment(), domain=domain)
    assert result.failures == []
    assert result.trajectory.completeness.complete
    assert check(result.trajectory).difference is None
