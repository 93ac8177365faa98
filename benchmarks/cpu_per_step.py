"""Where the time of a lockstep step goes: CPU time of every process of the demo network, beside the bare loop.

The kernel's account of each process over some seconds of a run (in ticks of 10 ms), divided by the steps made.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bare_loop
from network import network

START, LENGTH = 5.0, 4.0  # s after the call: when to look, and for how long; start-up takes three
RUN = START + LENGTH + 4.0  # s that a run should last
TICK = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used.

    Attributes
    ----------
    user, system
        s of CPU time
    switches
        from one process to another, of all its threads
    """

    user: float
    system: float
    switches: int


def children() -> dict[str, Usage]:
    """Usage of each child process, by what it is."""
    found = {}
    for entry in Path("/proc").iterdir():
        with suppress(OSError, IndexError):
            if not entry.name.isdigit():
                continue
            numbers = (entry / "stat").read_text().rpartition(")")[2].split()
            if numbers[1] != str(os.getpid()):
                continue
            lines = [line for task in entry.glob("task/*/status") for line in task.read_text().splitlines()]
            switches = sum(int(line.split()[1]) for line in lines if "ctxt_switches" in line)
            usage = Usage(int(numbers[11]) * TICK, int(numbers[12]) * TICK, switches)
            found[_name((entry / "cmdline").read_text().split("\0"))] = usage
    return found


def _name(command: list[str]) -> str:
    if "--worker" in command:
        worker = int(command[command.index("--worker") + 1])
        return f"bare agent {worker + 1}" if worker >= 0 else "bare recorder"
    agent = " " + command[command.index("--agent") + 1] if "--agent" in command else ""
    return command[command.index("msg_agents") + 1] + agent


def watch(run: Callable[..., float], guess: int) -> None:
    """Print what each process of a run uses per step.

    Parameters
    ----------
    run
        makes ``steps`` steps, gives steps per second
    guess
        steps per second
    """
    looks: list[dict[str, Usage]] = []

    def look() -> None:
        time.sleep(START)
        looks.append(children())
        time.sleep(LENGTH)
        looks.append(children())

    observer = threading.Thread(target=look)
    observer.start()
    rate = run(steps=round(RUN * guess))
    observer.join()
    steps = rate * LENGTH
    total = 0.0
    for name in sorted(looks[1].keys() & looks[0].keys()):
        before, after = looks[0][name], looks[1][name]
        user, system = (after.user - before.user) / steps * 1e6, (after.system - before.system) / steps * 1e6
        total += user + system
        switches = (after.switches - before.switches) / steps
        print(f"    {name:16} {user:6.0f} {system:6.0f} {switches:10.1f}")
    print(f"    {'all':16} {total:13.0f}    {rate:.0f} steps/s")


def main() -> None:
    """Print a table for each of four runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    print(f"{'us per step of':20} {'user':>6} {'system':>6} {'switches':>10}")
    for recorded in (False, True):
        print("bare loop, batch and pinned" + recorded * ", recorded")
        watch(partial(bare_loop.measure, recorder=recorded, batch=True, pin=True), 3000)
        print("network" + recorded * ", recorded")
        watch(partial(network, record=recorded), 3500)


if __name__ == "__main__":
    main()
