"""Processes that the discovery relay connects, others in their domain, and how agents receive states."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from joining_node import assert_delivery
from networks import assert_equal_to_twin

from msg_agents.discovery.rtps import FIRST_RELAYED, discovery_port, free_domain
from msg_agents.environment import node_environment
from msg_analysis.twin.simulate import simulate

NODES = sorted(["recorder", "switcher", *(f"agent_{i}" for i in range(1, 6))])
JOINING = """
import sys, time, rclpy
rclpy.init()
name, *wanted = sys.argv[1:]
node = rclpy.create_node(name)
print("ready", flush=True)
wanted, end = set(wanted), time.monotonic() + 60
while not wanted <= set(node.get_node_names()) and time.monotonic() < end:
    time.sleep(0.05)
print(*sorted(node.get_node_names()), flush=True)
"""


@pytest.fixture
def domain() -> Iterator[int]:
    with free_domain() as number:
        yield number


def joining(stack: ExitStack, when: str, domain: int) -> dict[str, subprocess.Popen[str]]:
    """Joining nodes with each kind of environment, by the names of their nodes."""
    environments = {
        "our_profile": node_environment(domain),
        "range_of_ros": os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    }
    found = {}
    for kind, environment in environments.items():
        command = [sys.executable, "-P", "-c", JOINING, f"other_{when}_{kind}", *NODES]
        other = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        found[command[4]] = stack.enter_context(other)
    return found


def test_others_see_every_process(network: Any, domain: int) -> None:
    """Those that were there before the run and those that come during it, with our profile and in ROS's own range."""
    # Of a run in which no process knows more than half of the others. In real time, agents hear each other with best
    # effort if nothing is said of it; all else is reliable.
    graphs = {"line": {"path": [1, 2, 3, 4, 5]}, "none": {"edges": []}}
    # Few steps, and large states, which are soon seen in the bag.
    file = network.file(graphs=graphs, run={"pace": "realtime", "duration": 2000, "replicas": 128})
    with ExitStack() as stack:
        others = joining(stack, "before", domain)
        for other in others.values():
            assert other.stdout.readline() == "ready\n"
        run = network.record(file, "--domain", str(domain))
        network.wait_until_moving()
        others |= joining(stack, "during", domain)
        for name, other in others.items():
            said, _ = other.communicate(timeout=90)
            seen = said.splitlines()[-1].split()
            assert name in seen
            assert [node for node in seen if node not in others] == NODES, name
        assert_delivery("BEST_EFFORT", [2], domain)
        run.terminate()
        run.communicate(timeout=60)


def test_a_domain_without_a_port_for_the_relay(network: Any, domain: int) -> None:
    """Where others have all its numbers, the processes look for each other; the result is the same."""
    # One process per agent: the twin says, from the experiment alone, what they record.
    what = network.experiment(run={"processes": "one_per_agent"})
    with ExitStack() as stack:
        for number in range(FIRST_RELAYED):
            other = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            other.bind(("127.0.0.1", discovery_port(domain, number)))
        result = network.run(what, domain=domain)
    trajectory, twin = result.trajectory, simulate(what)
    assert trajectory.completeness == twin.completeness
    assert_equal_to_twin(trajectory)
    assert trajectory.completeness.expected == 5 * 301
    assert np.array_equal(trajectory.states, twin.states)
    assert np.array_equal(trajectory.modes, twin.modes)
    assert np.array_equal(trajectory.agent_modes[1:], np.repeat(twin.modes[:, None], 5, axis=1))


@pytest.mark.parametrize("delivery", ["best_effort", "reliable"])
def test_readers_of_states(network: Any, domain: int, delivery: str) -> None:
    """Agents 2 and 5 hear agent 1. What holds if nothing is said: above."""
    # Few steps, and large states, which are soon seen in the bag.
    file = network.file(run={"pace": "realtime", "duration": 1000, "replicas": 128})
    run = network.record(file, "--domain", str(domain), "--delivery", delivery)
    network.wait_until_moving()
    assert_delivery(delivery.upper(), [2, 5], domain)
    run.terminate()
    run.communicate(timeout=60)
