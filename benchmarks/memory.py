"""Memory over the length of a run: of the recorder, of agents and switcher, and of what reads and writes long bags.

The recorder gets batches of made-up states by hand, as fast as it takes them. Agents and switcher are those of a real
network. Bags are those of the offline twin. All values are resident memory [MB].

--bags: only bags of 20 agents, of all kinds of messages: simulate, compare with a report, and check.
--hour: recorder and switcher over an hour of 1000 agents, at the speed that they have on two cores. The switcher is a
real process, whose agents say that they have reached a step as soon as they know its graph.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.base import NetworkNode
from msg_agents.nodes.recorder import keep_freed_memory
from msg_agents.nodes.ros import LeanNode
from msg_agents.run.runner import run_network
from msg_agents.stepping.state_receiver import StateReceiver
from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.bags.writing import BagWriter
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import STATE_HEAD, StateCodec
from msg_analysis.messages.topics import GRAPH, PROGRESS, STATE, STATES, agent_node_name, network_topics
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import new_record

POINTS = 5
AGENTS, STEPS_IN_AN_HOUR = 1000, 210_000  # at 58 steps a second, docs/performance.md
TOGETHER = 25  # holding periods after which made-up agents tell their steps


def ring(agents: int, steps: int, *, noise: dict[str, Any] | None = None, **run: Any) -> dict[str, Any]:
    """The document of an experiment with agents on a line and a ring."""
    numbers = list(range(1, agents + 1))
    return {
        "name": "memory",
        "graphs": {"line": {"path": numbers}, "ring": {"cycle": numbers}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
        "noise": noise or {},
        "run": {"dt": 0.05, "duration": steps * 0.05, "start": "zero", **run},
    }


def resident(process: int | str = "self") -> float:
    """Resident memory [MB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def batches(record: RunRecord, steps: int, rounds: int) -> Iterator[bytes]:
    """Batches of so many steps of all agents; from the second on the same bytes, with other steps and stamps."""
    agents = record.experiment.agents
    codecs = [StateCodec(record.run.bytes, i + 1, 1, 0.05) for i in range(agents)]
    payloads = np.random.default_rng(0).random((agents, 8)).tobytes()
    messages: list[bytes] = []
    for first in (0, rounds):
        messages = [
            codec.wrap(k, min(k, 1), payloads[8 * (i + k % 8) : 8 * (i + k % 8) + 8])
            for k in range(first, first + rounds)
            for i, codec in enumerate(codecs)
        ]
        yield encode_batch(record.run.bytes, messages)
    length = len(messages[0])
    batch = bytearray(encode_batch(record.run.bytes, messages))
    rest = f"V{length - STATE_HEAD.itemsize}"
    states = np.frombuffer(batch, [("head", STATE_HEAD), ("rest", rest)], offset=len(batch) - length * len(messages))
    clock, head = StepClock(0.05), states["head"]
    for first in range(2 * rounds, steps, rounds):
        head["step"] += np.uint64(rounds)
        times = [clock.nanoseconds(k) for k in range(first, first + rounds)]
        head["seconds"], head["nanoseconds"] = np.repeat(np.divmod(times, SECOND), agents, axis=1)
        yield bytes(batch)


def recorder(agents: int, steps: int, rounds: int = 20) -> None:
    """Record so many steps, ``rounds`` of each agent in a batch, and print the memory on the way."""
    record = new_record(Experiment.parse(ring(agents, steps)))
    keep_freed_memory()  # as the recorder does
    receiver = StateReceiver(record, STATES, STATE, "/")
    shown = []
    with (
        tempfile.TemporaryDirectory() as folder,
        BagWriter(Path(folder) / "bag", network_topics(agents), record=record.to_json()) as bag,
    ):
        for number, batch in enumerate(batches(record, steps, rounds)):
            receiver.add(batch)
            found = receiver.take()
            assert not found.refused
            bag.write_many(receiver.names, found.agent, found.time, found.data, found.start, found.size)
            if (number + 1) * rounds % (steps // POINTS) < rounds:
                shown.append(f"{resident():.0f}")
    print(f"| recorder, {agents} agents, {steps} steps | {' | '.join(shown)} |", flush=True)


def network(steps: int) -> None:
    """A real network of five agents in one process, not recorded."""
    found: dict[str, list[tuple[float, float]]] = {"agent": [], "switcher": []}
    done = threading.Event()

    def watch() -> None:
        while not done.wait(0.2):
            for entry in Path("/proc").glob("[0-9]*"):
                try:
                    words = (entry / "cmdline").read_bytes().decode().replace("\0", " ").split()
                    if words[:1] == ["msg-agents"] and words[1] in found:
                        found[words[1]].append((time.monotonic(), resident(entry.name)))
                except (OSError, ValueError, IndexError):
                    continue

    thread = threading.Thread(target=watch)
    thread.start()
    run_network(Experiment.parse(ring(5, steps, processes=1)), None)
    done.set()
    thread.join()
    for name, values in found.items():
        chosen = [values[(len(values) - 1) * (i + 1) // POINTS][1] for i in range(POINTS)]
        print(
            f"| {name}, 5 agents in a process, {steps} steps | {' | '.join(f'{v:.0f}' for v in chosen)} |", flush=True
        )


class MadeUpAgents(NetworkNode):
    """The first agent, which speaks for all: each is as far as the graph is known."""

    def __init__(self, record: RunRecord) -> None:
        super().__init__(agent_node_name(0), record=record)
        self.reached, self._holding_periods = 0, 0
        self._progress = self.publisher_of(PROGRESS)
        self.subscribe(GRAPH, self._receive)
        self.finish_at_end()

    def begin(self) -> None:
        """Say that all agents have started."""
        self._tell(0)

    def _receive(self, data: bytes) -> None:
        graph = self.accepted(self.rules.graph(data), GRAPH)
        self._holding_periods += 1
        last = self.record.experiment.steps
        if graph and (self._holding_periods % TOGETHER == 0 or graph.last_step == last - 1):
            self._tell(graph.last_step + 1)

    def _tell(self, step: int) -> None:
        self.reached = step
        self.rules.forget(step)
        for agent in range(self.record.experiment.agents):
            self._progress.publish(self.progress(PROGRESS, agent + 1, step))


def switcher(agents: int, steps: int) -> None:
    """The switcher of so many agents, which take no time."""
    record = new_record(Experiment.parse(ring(agents, steps)))
    shown: list[str] = []
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        file = Path(folder) / "run.json"
        file.write_text(record.to_json(with_key=True), encoding="utf-8")
        os.environ.update(node_environment(domain))
        with subprocess.Popen([sys.executable, "-m", "msg_agents", "switcher", str(file)]) as process:
            rclpy.init()
            node = MadeUpAgents(record)
            others = [LeanNode(agent_node_name(i)) for i in range(1, agents)]
            while "switcher" not in node.get_node_names() or not node.count_publishers(GRAPH.name):
                time.sleep(0.1)
            node.begin()
            while not node.done.done():
                rclpy.spin_once(node, timeout_sec=1.0)
                if node.reached >= steps * (len(shown) + 1) // POINTS:
                    shown.append(f"{resident(process.pid):.0f}")
            for other in [node, *others]:
                other.destroy_node()
            rclpy.shutdown()
    print(f"| switcher, {agents} agents, {steps} steps | {' | '.join(shown)} |", flush=True)


KINDS: dict[str, dict[str, Any]] = {
    "lockstep": {"replicas": 16},
    "lost": {"replicas": 16, "noise": {"loss": 0.1}},
    "held, late": {"replicas": 16, "noise": {"loss": 0.1, "on_loss": "hold", "delay": 2}},
    "noisy": {"replicas": 8, "noise": {"broadcast": 0.3, "link": 0.2}},
    "real time": {"replicas": 8, "noise": {"loss": 0.1, "broadcast": 0.1}, "pace": "realtime"},
}


def bags(kind: str, steps: int) -> None:
    """The commands that write and read a long bag, of 20 agents."""
    with tempfile.TemporaryDirectory() as folder:
        experiment, bag = Path(folder) / "experiment.json", f"{folder}/bag"
        experiment.write_text(json.dumps(ring(20, steps, **KINDS[kind])), encoding="utf-8")
        shown = [
            _cost("msg_analysis", "simulate", str(experiment), "--out", bag),
            _cost("msg_analysis", "compare", bag, "--report", f"{folder}/report.html"),
            _cost("msg_agents", "check", bag),
        ]
        size = sum(file.stat().st_size for file in Path(bag).iterdir())
    print(f"| {kind} | {steps} | {size / 1e6:.0f} MB | {' | '.join(shown)} |", flush=True)


def _cost(*command: str) -> str:
    """Time and largest resident memory of a command."""
    begun, most = time.monotonic(), 0.0
    process = subprocess.Popen([sys.executable, "-m", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:  # not `ru_maxrss`, in which the memory of this process counts
        with suppress(OSError, StopIteration):
            lines = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii").splitlines()
            most = max(most, next(int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM:")))
        time.sleep(0.02)
    failed = f" (exit code {process.returncode})" if process.returncode else ""
    return f"{time.monotonic() - begun:.1f} s, {1.024 * most:.0f} MB{failed}"


def main() -> None:
    """Print the tables of docs/performance.md."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--states", type=int, default=20_000_000, help="states that the recorder gets")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of the network")
    parser.add_argument("--longest", type=int, default=350_000, help="steps of the longest bag")
    parser.add_argument("--bags", action="store_true", help="only what reads and writes bags: a quarter of an hour")
    parser.add_argument("--hour", action="store_true", help="only an hour of 1000 agents: a quarter of an hour")
    arguments = parser.parse_args()
    if arguments.bags:
        long_bags(arguments.longest)
        return
    print(f"| resident memory [MB] after | {' | '.join(f'{100 * (i + 1) // POINTS} %' for i in range(POINTS))} |")
    print(f"|---|{'---:|' * POINTS}")
    if arguments.hour:
        switcher(AGENTS, STEPS_IN_AN_HOUR)
        recorder(AGENTS, STEPS_IN_AN_HOUR)
        return
    for agents in (10, 100, 1000):
        recorder(agents, arguments.states // agents)
    network(arguments.steps)
    long_bags(arguments.longest)


def long_bags(longest: int) -> None:
    """Of all kinds, up to so many steps."""
    print("\n| messages | steps | bag | simulate | compare with a report | check |\n|---|---:|---:|---:|---:|---:|")
    for kind in KINDS:
        for share in (0.1, 0.4, 1.0):
            bags(kind, round(share * longest))


if __name__ == "__main__":
    main()
