"""How long `--help` takes, of both command lines and of every command, beside Python that does nothing; and a network
of one step, whose processes are forked or start on their own.

python benchmarks/startup.py

Paired: a round is one run of each in turn; the least of the rounds counts, since others on the machine only add to it.
Seconds of the wall, and of the CPU, which a busy machine changes less.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

from msg_agents.cli.main import main as agents
from msg_analysis.cli.main import main as analysis

ROUNDS = 7
NETWORKS = (5, 20, 40, 90)  # agents, each with a process of its own
BIN = Path(sys.executable).parent


def measure(command: list[str]) -> tuple[float, float]:
    before, begin = os.times(), time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    wall, after = time.perf_counter() - begin, os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    commands = {"python -c pass": [sys.executable, "-c", "pass"]}
    for program, group in (("msg-analysis", analysis), ("msg-agents", agents)):
        for name in ("", *group.commands):
            commands[f"{program} {name}".strip()] = [str(BIN / program), *([name] if name else []), "--help"]
    report(commands)
    with tempfile.TemporaryDirectory() as directory:
        networks: dict[str, list[str]] = {}
        for size in NETWORKS:
            file = Path(directory) / f"{size}.yaml"
            file.write_text(yaml.safe_dump(network(size)))
            command = [str(BIN / "msg-agents"), "run", str(file), "--no-record"]
            networks |= {f"{size} agents": command, f"{size} agents, --no-fork": [*command, "--no-fork"]}
        report(networks, rounds=2)


def network(agents: int) -> dict[str, object]:
    """A path of agents, one step."""
    return {
        "name": "start",
        "problem": "consensus",
        "time": "continuous",
        "graphs": {"path": {"path": list(range(1, agents + 1))}},
        "switching": {"generator": [[0]]},
        "run": {"dt": 0.05, "duration": 0.05, "start": "zero", "processes": "one_per_agent"},
    }


def report(commands: dict[str, list[str]], rounds: int = ROUNDS) -> None:
    least = dict.fromkeys(commands, (float("inf"), float("inf")))
    for _ in range(rounds):
        for name, command in commands.items():
            wall, cpu = measure(command)
            least[name] = min(least[name][0], wall), min(least[name][1], cpu)
    for name, (wall, cpu) in least.items():
        print(f"{name:24} {wall:.3f} s, CPU {cpu:.3f} s", flush=True)


if __name__ == "__main__":
    main()
