"""How long `--help` takes, of both command lines and of every command, beside Python that does nothing; a network of
one step, as a command; and how long the processes of a network need from the call to the last x(0): forked, or
on their own.

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
from msg_agents.run.runner import run_network
from msg_analysis.cli.main import main as analysis
from msg_analysis.experiment.experiment import Experiment

ROUNDS = 7
STARTS = 3  # of each network
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
        file = Path(directory) / "network.yaml"
        file.write_text(yaml.safe_dump(network(NETWORKS[0])))
        command = [str(BIN / "msg-agents"), "run", str(file), "--no-record"]
        report(
            {f"run, {NETWORKS[0]} agents": command, f"run, {NETWORKS[0]} agents, --no-fork": [*command, "--no-fork"]}
        )
    print("\nagents   from the call to the last x(0): forked   on their own   ratio")
    for size in NETWORKS:
        forked, alone = (min(values) for values in zip(*(starts(size) for _ in range(STARTS)), strict=True))
        print(f"{size:6} {forked:39.2f} s {alone:12.2f} s {alone / forked:7.1f}", flush=True)


def starts(agents: int) -> tuple[float, float]:
    """Start-up times [s] of a network: forked, and without forks."""
    return start_up(agents, fork=True), start_up(agents, fork=False)


def start_up(agents: int, *, fork: bool) -> float:
    """Seconds until all agents have their x(0), as ``run_network`` reports it."""
    what = Experiment.parse(network(agents))
    ready: list[float] = []
    begun = time.perf_counter()
    result = run_network(what, None, fork=fork, on_progress=lambda _: ready.append(time.perf_counter()))
    if result.failures or not ready:
        raise SystemExit("\n".join(result.failures) or "the run was over before it was seen")
    return ready[0] - begun


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
