"""The ceiling: a ring of agents in lockstep with nothing but the middleware in it.

Raw bytes of the size of an AgentState, one precompiled struct a message, no arithmetic, no checks, no graph, no
start-up protocol; reliable and keep-all like the real network. With --recorder, one more process writes every message
to an MCAP file and does nothing else. Prints steps per second of the lockstep loop.
"""

from __future__ import annotations

import argparse
import struct
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import rclpy
from mcap.writer import CompressionType, Writer
from msg_agents_interfaces.msg import AgentState
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.process import prefer_throughput
from msg_agents.nodes.ros import RCLError
from msg_agents.process_layout import RECORDER, ProcessSpec, assign_cores, pin_to_core
from msg_analysis.common.resources import available_cores

QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE, depth=0)
FRAME = struct.Struct("<4xQI")  # CDR header, step, agent


def bare_node(name: str) -> Node:
    return Node(name, start_parameter_services=False, enable_rosout=False)


class Agent:
    """Publishes step k + 1 when both neighbours' step k is there."""

    def __init__(self, index: int, agents: int, steps: int, readers: int, payload: bytes) -> None:
        self.node = bare_node(f"agent_{index}")
        self.index, self.steps, self.readers, self.payload = index, steps, readers, payload
        self.step = 0
        self.heard: dict[int, int] = {}
        self.started = 0.0
        self.publisher = self.node.create_publisher(AgentState, f"agent_{index}/state", QOS)
        self.neighbours = {(index - 1) % agents, (index + 1) % agents} - {index}
        for j in self.neighbours:
            self.node.create_subscription(AgentState, f"agent_{j}/state", self.receive, QOS, raw=True)

    def ready(self) -> bool:
        return bool(self.publisher.get_subscription_count() >= self.readers)

    def publish(self) -> None:
        data = FRAME.pack(self.step, self.index) + self.payload
        while True:
            try:
                self.publisher.publish(data)
            except RCLError:
                continue
            return

    def receive(self, data: bytes) -> None:
        step, _ = FRAME.unpack_from(data)
        self.heard[step] = self.heard.get(step, 0) + 1
        while self.step < self.steps and self.heard.get(self.step, 0) == len(self.neighbours):
            del self.heard[self.step]
            self.step += 1
            self.publish()


def run_agents(arguments: argparse.Namespace) -> None:
    if arguments.batch:
        prefer_throughput()
    rclpy.init()
    payload = bytes(68 + 8 * arguments.replicas - FRAME.size)
    # Neighbouring numbers share a process, as in the real network.
    bounds = [(arguments.worker + end) * arguments.agents // arguments.processes for end in (0, 1)]
    mine = range(*bounds)
    readers = min(2, arguments.agents - 1) + arguments.recorder
    agents = [Agent(i, arguments.agents, arguments.steps, readers, payload) for i in mine]
    spin = EventsExecutor()
    for agent in agents:
        spin.add_node(agent.node)
    while not all(agent.ready() for agent in agents):
        time.sleep(0.2)
    started = time.monotonic()
    for agent in agents:
        agent.publish()
    while any(agent.step < arguments.steps for agent in agents):
        spin.spin_once(timeout_sec=1.0)
    elapsed = time.monotonic() - started
    print(f"{arguments.steps / elapsed:.1f}", flush=True)
    for agent in agents:
        agent.publisher.wait_for_all_acked()
    sys.stdin.read()  # leave when everyone is done


def run_recorder(arguments: argparse.Namespace) -> None:
    if arguments.batch:
        prefer_throughput()
    rclpy.init()
    node = bare_node("recorder")
    with tempfile.TemporaryDirectory() as directory, (Path(directory) / "bare.mcap").open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2", "bare")
        schema = writer.register_schema("msg_agents_interfaces/msg/AgentState", "ros2msg", b"")
        received = 0

        def record(channel: int) -> object:
            def receive(data: bytes) -> None:
                nonlocal received
                received += 1
                writer.add_message(channel, received, data, received)

            return receive

        for i in range(arguments.agents):
            channel = writer.register_channel(f"/agent_{i}/state", "cdr", schema)
            node.create_subscription(AgentState, f"agent_{i}/state", record(channel), QOS, raw=True)
        spin = EventsExecutor()
        spin.add_node(node)
        while received < arguments.agents * (arguments.steps + 1):
            spin.spin_once(timeout_sec=1.0)
        writer.finish()
    print(received, flush=True)
    sys.stdin.read()


def measure(
    *,
    agents: int = 5,
    processes: int = 5,
    steps: int = 8000,
    recorder: bool = False,
    replicas: int = 16,
    batch: bool = False,
    pin: bool = False,
) -> float:
    """Steps per second of the slowest process, in the environment that the real network gives its processes.

    Parameters
    ----------
    batch, pin
        batch scheduling, and one core for each process, both of which the real network chooses itself
    """
    common = f"--agents {agents} --processes {processes} --steps {steps} --replicas {replicas}"
    roles = [f"--worker {w}" for w in range(processes)] + (["--worker -1"] if recorder else [])
    command = [sys.executable, __file__, *common.split(), *(["--recorder"] if recorder else [])]
    command += ["--batch"] if batch else []
    with free_domain() as domain:
        children = [
            subprocess.Popen(
                [*command, *role.split()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=node_environment(domain),
            )
            for role in roles
        ]
        if pin:
            for child, core in zip(children, _cores(agents, processes, recorder), strict=False):
                pin_to_core(child.pid, core)
        rates = [float(child.stdout.readline()) for child in children if child.stdout]
        for child in children:
            child.communicate(timeout=30)
    return min(rates[:processes])


def _cores(agents: int, processes: int, recorder: bool) -> list[int]:
    """The core of each process, recorder last, where the real network would have it."""
    bounds = [worker * agents // processes for worker in range(processes + 1)]
    plans = [ProcessSpec(RECORDER, ())] if recorder else []
    plans += [ProcessSpec(f"{first}", (), tuple(range(first, end))) for first, end in pairwise(bounds)]
    placed = list(assign_cores(plans, available_cores()).values())
    return placed[recorder:] + placed[:recorder]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, default=5)
    parser.add_argument("--processes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--replicas", type=int, default=16)
    parser.add_argument("--recorder", action="store_true")
    parser.add_argument("--batch", action="store_true", help="batch scheduling, which the real network chooses itself")
    parser.add_argument("--pin", action="store_true", help="one core for each process, as in the real network")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker is None:
        rate = measure(
            agents=arguments.agents,
            processes=arguments.processes,
            steps=arguments.steps,
            recorder=arguments.recorder,
            replicas=arguments.replicas,
            batch=arguments.batch,
            pin=arguments.pin,
        )
        print(f"{rate:.0f} steps/s")
    elif arguments.worker < 0:
        run_recorder(arguments)
    else:
        run_agents(arguments)


if __name__ == "__main__":
    main()
