"""How long a killed agent is away: from the signal to its next new state, as another node hears it.

python benchmarks/restart.py [--kills N]

The demo network in lockstep, recorded; two seconds after the last one is back, another agent is killed. Once its
processes are forked, and once they start on their own.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from functools import partial
from itertools import cycle, islice
from pathlib import Path

import rclpy
import yaml
from msg_agents_interfaces.msg import AgentState
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment

AGENTS = 5
PAUSE = 2.0  # s before each kill
ON_THEIR_WAY = 0.05  # s after the signal in which states are heard that were sent before
DURATION = 3e4  # of the experiment, more than is needed; the benchmark ends it
PROGRAM = Path(sys.executable).with_name("msg-agents")


def experiment() -> dict[str, object]:
    """Line and ring."""
    numbers = list(range(1, AGENTS + 1))
    return {
        "name": "restart",
        "problem": "consensus",
        "time": "continuous",
        "graphs": {"line": {"path": numbers}, "ring": {"cycle": numbers}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
        "run": {"dt": 0.05, "duration": DURATION, "start": "zero", "seed": 1},
    }


def process_of(agent: int, run: int) -> int:
    """Number of the process of an agent of the run that this process has started."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                command = (entry / "cmdline").read_text().replace("\0", " ")
            except OSError:
                continue
            if parent == run and f"--agent {agent} " in command:
                return int(entry.name)
    raise SystemExit(f"agent {agent} is not there")


class Listener(Node):  # type: ignore[misc]  # rclpy has no type hints that mypy can follow
    """Notes when the newest step of each agent was heard, without slowing the agents."""

    def __init__(self) -> None:
        super().__init__("listener")
        quality = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.newest = dict.fromkeys(range(1, AGENTS + 1), (-1, 0.0))  # by agent: stamp [ns], time [s]
        for agent in self.newest:
            topic = f"/agent_{agent}/state"
            self.create_subscription(AgentState, topic, partial(self._hear, agent), quality, raw=True)

    def _hear(self, agent: int, data: bytes) -> None:
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)  # after the CDR header
        stamp = seconds * 10**9 + nanoseconds
        if stamp > self.newest[agent][0]:
            self.newest[agent] = stamp, time.monotonic()

    def listen(self, seconds: float) -> None:
        """Listen for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self, timeout_sec=left)

    def away(self, agent: int, process: int) -> float:
        """Kill a process; the seconds until something new comes from its agent."""
        os.kill(process, signal.SIGKILL)
        moment = time.monotonic()
        self.listen(ON_THEIR_WAY)
        before = self.newest[agent]
        while self.newest[agent] == before:
            rclpy.spin_once(self, timeout_sec=1.0)
        return self.newest[agent][1] - moment


def measure(kills: int, options: list[str], listener: Listener, environment: dict[str, str]) -> list[float]:
    """Seconds for which each killed agent was away."""
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "restart.yaml"
        file.write_text(yaml.safe_dump(experiment()))
        command = [PROGRAM, "run", file, "--out", directory, "--no-analyse", "--restarts", str(kills)]
        run = subprocess.Popen(
            [*map(str, command), "--domain", environment["ROS_DOMAIN_ID"], *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        found = []
        while any(stamp < 0 for stamp, _ in listener.newest.values()):
            listener.listen(PAUSE)
        for agent in islice(cycle(range(1, AGENTS + 1)), kills):
            listener.listen(PAUSE)
            found.append(listener.away(agent, process_of(agent, run.pid)))
        run.send_signal(signal.SIGINT)
        run.wait()
        return found


def main() -> None:
    """Print medians and ranges."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    kills = parser.parse_args().kills
    as_it_was = dict(os.environ)
    for name, options in (("forked", []), ("on their own", ["--no-fork"])):
        with free_domain() as domain:
            os.environ.update({**node_environment(domain), "ROS_DOMAIN_ID": str(domain)})
            rclpy.init()
            times = measure(kills, options, Listener(), as_it_was | {"ROS_DOMAIN_ID": str(domain)})
            rclpy.shutdown()
        print(f"{name:12} median {statistics.median(times):.2f} s, {min(times):.2f} to {max(times):.2f} s", flush=True)


if __name__ == "__main__":
    main()
