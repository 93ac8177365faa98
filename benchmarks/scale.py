"""How a network grows: start-up time, memory and lockstep speed against agents and processes.

Rings with chords, recorded, each run once and short. --plot FILE.svg draws the table.

Start-up is the time from the call to the last agent's x(0). Memory is the proportional set size (what several
processes share is counted once) of all processes of the network, switcher and recorder included, after start-up.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from msg_agents.run.runner import run_network
from msg_analysis.experiment.experiment import Experiment

AGENTS = (5, 20, 40, 100, 300, 1000)
PROCESSES = (1, 2, 4, 40)
REPLICAS = 4


@dataclass(frozen=True, slots=True)
class Point:
    """What one run gave.

    Attributes
    ----------
    agents, processes
        of the network; switcher and recorder have one more process each
    start
        s
    memory
        bytes
    rate
        steps per second
    """

    agents: int
    processes: int
    start: float
    memory: int
    rate: float


def experiment(agents: int, processes: int, steps: int) -> Experiment:
    """A ring, and the same with a chord from every seventh agent."""
    ring = [[i, i % agents + 1] for i in range(1, agents + 1)]
    chords = [[i, (i + agents // 3) % agents + 1] for i in range(1, agents + 1, 7)]
    return Experiment.parse(
        {
            "name": "scale",
            "problem": "consensus",
            "time": "continuous",
            "graphs": {"ring": {"edges": ring}, "chords": {"edges": ring + chords}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {
                "dt": 0.05,
                "duration": round(0.05 * steps, 6),
                "start": "zero",
                "replicas": REPLICAS,
                "seed": 1,
                "processes": processes,
            },
        }
    )


def children_memory() -> int:
    """Proportional set size of all child processes [bytes]."""
    total = 0
    for entry in Path("/proc").iterdir():
        with suppress(OSError, IndexError):
            if entry.name.isdigit() and (entry / "stat").read_text().rpartition(")")[2].split()[1] == str(os.getpid()):
                found = re.search(r"^Pss:\s+(\d+) kB", (entry / "smaps_rollup").read_text(), re.MULTILINE)
                total += 1024 * int(found[1]) if found else 0
    return total


def measure(agents: int, processes: int) -> Point:
    """Run a network of a few seconds."""
    what = experiment(agents, processes, steps=max(300, min(10_000, 300_000 // agents)))
    start, memory = 0.0, 0

    def look(_: int) -> None:
        nonlocal start, memory
        if not start:
            start, memory = time.monotonic() - called, children_memory()

    with tempfile.TemporaryDirectory() as directory:
        called = time.monotonic()
        result = run_network(what, Path(directory), on_progress=look)
    if result.failures:
        raise SystemExit("\n".join(result.failures))
    return Point(agents, processes, start, memory, result.rate)


def plot(path: Path, points: Sequence[Point]) -> None:
    """Start-up time, memory and speed over the number of agents, a line for each number of processes."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "scale"
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(9.0, 3.2), layout="constrained")
    quantities: dict[str, Callable[[Point], float]] = {
        "start-up [s]": lambda point: point.start,
        "memory [MB]": lambda point: point.memory / 1e6,
        "steps/s": lambda point: point.rate,
    }
    for axes, (label, value) in zip(panels, quantities.items(), strict=True):
        for processes in sorted({point.processes for point in points}):
            line = [point for point in points if point.processes == processes]
            name = f"{processes} process" + "es" * (processes > 1)
            axes.loglog([point.agents for point in line], [value(point) for point in line], "o-", label=name)
        axes.set_xticks(AGENTS, [str(agents) for agents in AGENTS])
        axes.minorticks_off()
        axes.set_xlabel("agents")
        axes.set_ylabel(label)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), frameon=False, fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="draw it")
    parser.add_argument("--agents", type=int, nargs="+", default=AGENTS)
    parser.add_argument("--processes", type=int, nargs="+", default=PROCESSES)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    points = []
    for agents in arguments.agents:
        for processes in sorted({min(agents, number) for number in arguments.processes}):
            points.append(measure(agents, processes))
            print(points[-1], file=sys.stderr)
    if arguments.json:
        print(json.dumps([asdict(point) for point in points]))
    else:
        print("| agents | processes | start-up [s] | memory [MB] | steps/s |\n|---:|---:|---:|---:|---:|")
        for p in points:
            print(f"| {p.agents} | {p.processes} | {p.start:.1f} | {p.memory / 1e6:.0f} | {p.rate:.0f} |")
    if arguments.plot:
        plot(arguments.plot, points)


if __name__ == "__main__":
    main()
