"""How much faster two workers are than one, and networks of a sweep than the same runs alone.

First a sweep of 200 predictions at m = 50, n = 3: both what the predictions take once the workers are there, and the
whole command from its start to its end, of which some seconds (imports, starting and ending the workers) do not shrink
with their number. Then networks of 5 agents and 400 steps with their
verdicts; alone, also with the report, which a sweep writes only for a run that does not agree.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Any

import networkx as nx
import numpy as np

from msg_analysis.sweeps.grid import load_sweep
from msg_analysis.sweeps.points import Outcome, evaluate
from msg_analysis.sweeps.workers import LocalWorkers

AGENTS, GRAPHS = 50, 3


def sweep_file(directory: Path, points: int) -> Path:
    """A sweep over the rate of switching between three small-world graphs."""
    graphs: dict[str, Any] = {}
    for seed in range(GRAPHS):
        graph = nx.connected_watts_strogatz_graph(AGENTS, 4, 0.3, seed=seed)
        graphs[f"graph_{seed + 1}"] = {"edges": [[i + 1, j + 1] for i, j in graph.edges]}
    rates = {name: {other: 1.0 for other in graphs if other != name} for name in graphs}
    experiment = {"name": "large", "graphs": graphs, "switching": {"rates": rates}, "run": {"dt": 0.01}}
    over = {"switching.scale": {"from": 0.01, "to": 100, "count": points, "spacing": "log"}}
    path = directory / "large.yaml"
    path.write_text(json.dumps({"experiment": experiment, "over": over}), encoding="utf-8")
    return path


def points_seconds(path: Path, workers: int) -> float:
    """What the predictions take, once the workers are there."""
    jobs = [point.job for point in load_sweep(path).points]
    with LocalWorkers(workers) as pool:
        begin = time.perf_counter()
        with closing(pool.outcomes(evaluate, jobs)) as batches:
            done = [outcome for batch in batches for _, outcome in batch]
        seconds = time.perf_counter() - begin
    assert all(isinstance(outcome, Outcome) and outcome.status == "done" for outcome in done)
    assert len(done) == len(jobs)
    return seconds


def command_seconds(path: Path, workers: int) -> float:
    """The whole command."""
    program = Path(sys.executable).with_name("msg-analysis")
    with tempfile.TemporaryDirectory() as out:
        begin = time.perf_counter()
        subprocess.run(
            [program, "sweep", path, "--workers", str(workers), "--out", Path(out) / "sweep", "--json"],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        return time.perf_counter() - begin


def network_seconds(directory: Path, networks: int) -> tuple[list[float], list[float]]:
    """Wall time of each of several networks of a sweep, and of the same runs with ``msg-agents run``."""
    names = range(1, 6)
    graphs = {"line": {"path": [*names]}, "ring": {"cycle": [*names]}}
    experiment = {"name": "net", "graphs": graphs, "switching": {"generator": [[-1, 1], [1, -1]]}}
    experiment["run"] = {"dt": 0.05, "duration": 20.0, "seed": 1}
    path, alone = directory / "networks.json", directory / "alone.json"
    out = directory / "networks"
    over = {"run.seed": {"from": 1, "to": networks, "step": 1}}
    path.write_text(json.dumps({"kind": "network", "experiment": experiment, "over": over}), encoding="utf-8")
    alone.write_text(json.dumps(experiment), encoding="utf-8")
    programs = Path(sys.executable).parent
    subprocess.run([programs / "msg-analysis", "sweep", path, "--out", out, "--json"], check=True, capture_output=True)
    of_sweep = [json.loads(line)["seconds"] for line in (out / "points.jsonl").read_text().splitlines()]
    runs = []
    for seed in range(1, networks + 1):
        begin = time.perf_counter()
        subprocess.run(
            [programs / "msg-agents", "run", alone, "--seed", str(seed), "--out", directory / "runs", "--json"],
            check=True,
            capture_output=True,
        )
        runs.append(time.perf_counter() - begin)
    return of_sweep, runs


def report(name: str, seconds: Mapping[int, Sequence[float]]) -> float:
    """One line: the least of each, and what two workers gain."""
    one, two = min(seconds[1]), min(seconds[2])
    print(f"| {name} | {one:.2f} s | {two:.2f} s | {one / two:.2f} |")
    return one / two


def main() -> None:
    """Measure in turns, so that what else the machine does falls on both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--networks", type=int, default=6)
    arguments = parser.parse_args()
    predictions: dict[int, list[float]] = {1: [], 2: []}
    commands: dict[int, list[float]] = {1: [], 2: []}
    with tempfile.TemporaryDirectory() as folder:
        path = sweep_file(Path(folder), arguments.points)
        for _ in range(arguments.rounds):
            for workers in (1, 2):
                predictions[workers].append(points_seconds(path, workers))
                commands[workers].append(command_seconds(path, workers))
        of_sweep, alone = network_seconds(Path(folder), arguments.networks)
    print(f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} CPUs, numpy {np.__version__}, best of {arguments.rounds}")
    print(f"\n| {arguments.points} predictions, m = {AGENTS}, n = {GRAPHS} | 1 worker | 2 workers | gain |")
    print("|---|---:|---:|---:|")
    report("the predictions", predictions)
    report("the whole command", commands)
    gain, first = median(alone) / median(of_sweep), of_sweep[0]
    print(f"\n{arguments.networks} networks, medians: alone {median(alone):.2f} s, in a sweep {median(of_sweep):.2f} s")
    print(f"(the first {first:.2f} s): {gain:.2f} times as fast")


if __name__ == "__main__":
    main()
