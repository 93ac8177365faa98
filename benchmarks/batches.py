"""What the messages between a process of agents and the recorder cost, by the size of a batch: CPU time of both sides
for a hundred states of 16 replicas, at a thousand such steps a second at most, without checks and without a bag.

python benchmarks/batches.py
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.ros import LeanNode, RCLError
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.topics import STATES

SIZES = (8192, 16384, 32768, 60000)  # bytes
STATE = 196  # bytes of a state of 16 replicas
STEP = 100  # states
ROUNDS = 3


def spent(since: float = 0.0) -> float:
    """CPU time of this process [s]."""
    return time.process_time() - since


def send(node: LeanNode, messages: list[bytes], batches: int) -> float:
    """Send so many batches; CPU time [s]."""
    publisher = node.publisher_of(STATES)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(0.5)
    begun = spent()
    for _ in range(batches):
        batch = encode_batch(bytes(16), messages)
        while True:
            try:
                publisher.handle.publish_raw(batch)
                break
            except RCLError:  # the reader is slow
                continue
        time.sleep(len(messages) / STEP / 1000)
    return spent(begun)


def receive(node: LeanNode, batches: int) -> float:
    """Receive so many batches, as a recorder does; CPU time [s]."""
    begun: list[float] = []
    done = rclpy.task.Future()
    waiting: list[bytes] = []

    def collect(data: bytes) -> None:
        waiting.append(data)
        begun.append(spent())
        if len(begun) == batches:
            done.set_result(None)
        if len(waiting) * len(data) > 2**20:
            waiting.clear()

    node.subscribe(STATES, collect)
    executor = EventsExecutor()
    executor.add_node(node)
    while not done.done():
        executor.spin_until_future_complete(done, timeout_sec=0.5)
    return spent(begun[0])


def take_part(part: str, size: int, steps: int) -> None:
    """In a process of its own: print the CPU time of this side [us] for each step."""
    messages = [bytes(STATE)] * -(-size // STATE)
    batches = steps * STEP // len(messages)
    rclpy.init()
    node = LeanNode(part)
    used = send(node, messages, batches) if part == "sender" else receive(node, batches)
    print(used / steps * 1e6, flush=True)
    if part == "sender":
        time.sleep(1)  # until the last ones have been acknowledged
    _leave(node)


def _leave(node: Node) -> None:
    node.destroy_node()
    rclpy.try_shutdown()


def measure(size: int, steps: int) -> tuple[float, float]:
    """CPU time [us] of sender and receiver for each step."""
    with free_domain() as domain:
        environment = os.environ | node_environment(domain)
        parts = [
            subprocess.Popen(
                [sys.executable, __file__, "--part", part, "--size", str(size), "--steps", str(steps)],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            )
            for part in ("receiver", "sender")
        ]
        received, sent = (float(part.communicate()[0]) for part in parts)
    return sent, received


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--size", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part:
        take_part(arguments.part, arguments.size, arguments.steps)
        return
    least: dict[int, tuple[float, ...]] = {size: (float("inf"),) * 2 for size in SIZES}
    for _ in range(ROUNDS):  # paired; the least counts, since others on the machine only add to it
        for size in SIZES:
            least[size] = tuple(map(min, least[size], measure(size, arguments.steps)))
    print("CPU time [us] for 100 states\n| bytes of a batch | sender | receiver |\n|---:|---:|---:|")
    for size, (sent, received) in least.items():
        print(f"| {size} | {sent:.0f} | {received:.0f} |", flush=True)


if __name__ == "__main__":
    main()
