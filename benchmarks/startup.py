"""How long `--help` takes, of both command lines and of every command, beside Python that does nothing.

python benchmarks/startup.py

Paired: a round is one run of each in turn; the least of the rounds counts, since others on the machine only add to it.
Seconds of the wall, and of the CPU, which a busy machine changes less.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from msg_agents.cli.main import main as agents
from msg_analysis.cli.main import main as analysis

ROUNDS = 7
BIN = Path(sys.executable).parent


def measure(command: list[str]) -> tuple[float, float]:
    before, begin = os.times(), time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    wall, after = time.perf_counter() - begin, os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    commands = {"python -c pass": [sys.executable, "-c", "pass"]}
    for program, group in (("msg-analysis", analysis), ("msg-agents", agents)):
        for name in ("", *group.commands):
            commands[f"{program} {name}".strip()] = [str(BIN / program), *([name] if name else []), "--help"]
    least = dict.fromkeys(commands, (float("inf"), float("inf")))
    for _ in range(ROUNDS):
        for name, command in commands.items():
            wall, cpu = measure(command)
            least[name] = min(least[name][0], wall), min(least[name][1], cpu)
    for name, (wall, cpu) in least.items():
        print(f"{name:24} {wall:.3f} s, CPU {cpu:.3f} s")


if __name__ == "__main__":
    main()
