"""A foreign node in the ROS domain of a run: what it publishes arrives before anything of the run."""

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from awaiting_network import BAG, failures_of, network_awaiting

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_analysis.bags.reading import read_bag
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import ActiveGraph, AgentState
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord

STEPS = 300
# Waits for every reader of the run, publishes, waits until they have everything, and only then appears as the node that
# the agents and the switcher have been told to wait for; then it publishes the rest.
FOREIGN = """
import sys, time
from pathlib import Path
import rclpy
from rclpy.duration import Duration
from msg_agents_interfaces.msg import ActiveGraph, AgentState, Progress, StateBatch
from std_msgs.msg import String
from msg_agents.nodes.ros import ros_profile
from msg_agents.nodes.ros import RCLError
from msg_analysis.messages.topics import LATCHED, STREAM

AGENTS, PROCESSES, OF_BATCHES = int(sys.argv[3]), 2, int(sys.argv[4])
latched, stream = ros_profile(LATCHED), ros_profile(STREAM)
rclpy.init()
node = rclpy.create_node("foreign", enable_rosout=False)
kinds = dict.fromkeys(("progress", "end", "epoch", "resend"), Progress)
kinds |= {"graph": ActiveGraph, "experiment": String, "states": StateBatch}
readers = {"graph": PROCESSES + 1, "progress": 1, "end": PROCESSES + 1, "epoch": PROCESSES, "experiment": 1}
readers |= {"resend": PROCESSES, "states": OF_BATCHES}
messages = [line.split() for line in Path(sys.argv[1]).read_text().splitlines()]
recorder = "agent_1/state" in dict(messages)  # it reads the agents' own topics when it sees another node on this one
readers |= {f"agent_{i}/state": recorder + 1 for i in (1, 2, 3, 5)}  # the neighbour in the other process
readers["agent_4/state"] = recorder
publishers = {
    topic: node.create_publisher(kinds.get(topic, AgentState), topic, latched) for topic in dict(messages)
}
for topic, publisher in publishers.items():
    while publisher.get_subscription_count() < readers[topic]:
        time.sleep(0.1)
def publish(topic, data):
    while True:
        try:
            return publishers[topic].publish(bytes.fromhex(data))
        except RCLError:  # on a busy machine: readers have not acknowledged yet what it keeps for them
            time.sleep(0.001)

early = int(sys.argv[2])
for topic, data in messages[:early]:
    publish(topic, data)
for publisher in publishers.values():
    assert publisher.wait_for_all_acked(Duration(seconds=30))
referee = rclpy.create_node("referee", enable_rosout=False)
topics = {"graph": ActiveGraph} | {f"agent_{i}/state": AgentState for i in range(1, AGENTS + 1)}
for topic, kind in topics.items():
    referee.create_subscription(kind, topic, lambda _: None, latched if topic == "graph" else stream)
for topic, data in messages[early:]:
    publish(topic, data)
    time.sleep(0.0001)
of_states = [message for message in dict(messages).items() if message[0].endswith("/state")]
while int(sys.argv[5]):
    for topic, data in of_states:
        publish(topic, data)
    time.sleep(0.01)
time.sleep(600)
"""
Forgery = tuple[str, bytes]  # topic, message
Refused = Counter[tuple[str, str, str]]


def run_beside(
    network: Any,
    record: RunRecord,
    early: Sequence[Forgery],
    meanwhile: Sequence[Forgery] = (),
    *,
    of_batches: int = 1,
    endless: bool = False,
) -> tuple[Run, dict[str, str], Refused]:
    """Run a network of five agents in two processes; the messages of a foreign node meet every reader before its own.

    More are sent ``meanwhile``; with ``endless``, one of each topic of states is then sent again and again, since
    readers with best effort see only some. In another network, only batches can be sent, for so many readers. What
    comes back: trajectory, logs by process, and what was refused by (node, topic, reason).
    """
    directory: Path = network.directory
    (directory / "forged").write_text("".join(f"{topic} {data.hex()}\n" for topic, data in [*early, *meanwhile]))
    arguments = [directory / "forged", len(early), record.experiment.agents, of_batches, int(endless)]
    with (
        free_domain() as domain,
        _foreign_node(arguments, node_environment(domain)),
        network_awaiting("referee", record, directory, domain) as nodes,
    ):
        network.wait_for(lambda: not nodes.running or nodes.failures, 90, "the end of the run")
        failures = failures_of(nodes)
    assert failures == []
    logs = {child.spec.name: child.log.read_text() for child in nodes.children}
    return read_bag(directory / BAG), logs, nodes.status().refused


@contextmanager
def _foreign_node(arguments: Sequence[Path | int], environment: dict[str, str]) -> Iterator[None]:
    command = [sys.executable, "-P", "-c", FOREIGN, *map(str, arguments)]
    with subprocess.Popen(command, env=environment) as process:
        try:
            yield
        finally:
            process.kill()


def batch(run: bytes, forged: Sequence[Forgery]) -> Forgery:
    """Messages on their way to the recorder."""
    return "states", encode_batch(run, [data for _, data in forged])


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
