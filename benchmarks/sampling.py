"""How fast steady errors are sampled to 1 %, and how often the 95 % intervals hold the exact error.

One thread, CPU time, the start of Python, the file and the sampling of a command included. Prints Markdown: the speed;
with --coverage the share of 400 intervals of each law that hold the exact error, which takes ten minutes.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.sampling import SampledPrediction, sampled_prediction

RATE, DT = 0.5, 0.05
"""At which links come up and go down, and the length of a step."""
GOLDEN_LINKS = [(1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (1, 3), (2, 4), (1, 6), (2, 5)]
GOLDEN_ERROR = 3.41958  # of these links, by a dense solver of the 512 graphs
LAWS: dict[str, dict[str, Any]] = {
    "undirected": {},
    "directed": {"graphs": {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[1, 2], [2, 3, 2.0], [3, 1], [1, 3]]}}},
    "tracking": {"problem": "tracking", "leaders": {"agents": [1], "gain": 0.7}},
    "losses": {"noise": {"loss": 0.3}, "run": {"dt": 0.2}},
    "bursts": {"noise": {"loss": {"arcs": [[1, 2, 0.4], [2, 1, 0.3]]}, "burst": 5}, "run": {"dt": 0.2}},
    "held, noise on the air": {"noise": {"loss": 0.4, "on_loss": "hold", "broadcast": 0.7}, "run": {"dt": 0.2}},
}


def small(changes: dict[str, Any]) -> Experiment:
    """Line and ring of five agents, or three directed ones, with these changes."""
    names = list(changes.get("graphs", {"line": 0, "ring": 0}))
    fields = {
        "name": "small",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"rates": {names[0]: {names[1]: RATE}, names[1]: {names[0]: RATE}}},
    } | changes
    return Experiment.parse(fields | {"run": {"dt": DT, "duration": 10} | changes.get("run", {})})


def links(agents: int, ends: list[tuple[int, int]]) -> Experiment:
    """So many agents, and these links, agents from 1, which switch by themselves."""
    graphs = {"mesh": {"edges": [list(pair) for pair in ends]}}
    switching = {"links": {"up": RATE, "down": RATE}}
    run = {"dt": DT, "duration": 10}
    return Experiment.parse({"name": "links", "agents": agents, "graphs": graphs, "switching": switching, "run": run})


def sixty_links() -> None:
    """60 links of 30 agents, a path and random chords, to 1 %."""
    rng, ends = np.random.default_rng(1), [(i, i + 1) for i in range(1, 30)]
    while len(ends) < 60:
        i, j = sorted((rng.choice(30, 2, replace=False) + 1).tolist())
        if (i, j) not in ends:
            ends.append((i, j))
    report(sampled_prediction(links(30, ends), precision=0.01))


def write_large(directory: Path, agents: int = 100_000) -> Path:
    """An experiment file, and two edge lists in which every agent has four random neighbours."""
    for seed, name in enumerate(("first", "second")):
        rng, pairs = np.random.default_rng(seed), np.empty((0, 2), dtype=np.int64)
        for _ in range(2):
            order = rng.permutation(agents) + 1
            pairs = np.concatenate([pairs, np.stack([order, np.roll(order, 1)], axis=1)])
        rows = (f"{i},{j},undirected\n" for i, j in np.unique(np.sort(pairs, axis=1), axis=0).tolist())
        (directory / f"{name}.csv").write_text("source,target,type\n" + "".join(rows))
    file = directory / "large.yaml"
    rates = f"{{first: {{second: {RATE}}}, second: {{first: {RATE}}}}}"
    file.write_text(
        "name: large\ngraphs: {first: {csv: first.csv}, second: {csv: second.csv}}\n"
        f"switching: {{rates: {rates}}}\nrun: {{dt: 0.1, duration: 10}}\n"
    )
    return file


def report(sampled: SampledPrediction) -> None:
    """Print an error, its relative half width, and how many samples it took."""
    low, high = sampled.interval
    half = 50.0 * (high - low) / sampled.system_error
    print(f"{sampled.system_error:.5g} | {half:.2f} % | {sampled.paths}")


def in_process(*words: str) -> tuple[str, float, float]:
    """The output of this program with these words, its CPU time [s] and its peak memory [GB]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    made = subprocess.run(
        [sys.executable, __file__, *words], env=os.environ | one, check=True, capture_output=True, text=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return made.stdout.strip(), seconds, after.ru_maxrss * 1024 / 1e9


def speed() -> None:
    """Print the first table."""
    print("| case | system error | half width (95 %) | samples | CPU time [s] | largest memory so far [GB] |")
    print("|---|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as directory:
        file = write_large(Path(directory))
        cases = {
            "60 links of 30 agents, each up and down at rate 0.5": ("--links",),
            "100,000 agents of degree 4, two graphs, from CSV files": ("--file", str(file)),
        }
        for case, words in cases.items():
            text, seconds, memory = in_process(*words)
            print(f"| {case} | {text} | {seconds:.1f} | {memory:.2f} |", flush=True)


def coverage(repetitions: int, precision: float) -> None:
    """Print the second table."""
    print(f"\n| law, to {100 * precision:g} % | samples, mean | intervals that hold the exact error |")
    print("|---|---:|---:|")
    experiment = links(6, GOLDEN_LINKS)
    cases: dict[str, tuple[float, Callable[[int], SampledPrediction]]] = {}
    for name, changes in LAWS.items():
        law = small(changes)
        cases[name] = (
            law.predict().emulated.system_error,
            lambda seed, law=law: sampled_prediction(law, precision=precision, seed=seed),  # type: ignore[misc]
        )
    cases["nine links"] = (
        GOLDEN_ERROR,
        lambda seed: sampled_prediction(experiment, precision=precision, seed=seed),
    )
    for name, (exact, sample) in cases.items():
        found = [sample(seed) for seed in range(repetitions)]
        held = sum(low <= exact <= high for low, high in (one.interval for one in found))
        paths = np.mean([one.paths for one in found])
        print(f"| {name} | {paths:.0f} | {held} of {repetitions}: {100 * held / repetitions:.1f} % |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--coverage", action="store_true", help="also the coverage of the intervals")
    parser.add_argument("--repetitions", type=int, default=400, help="intervals of each law")
    parser.add_argument("--precision", type=float, default=0.03, help="at which sampling ends, of the coverage")
    parser.add_argument("--links", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.links:
        sixty_links()
    elif arguments.file:
        report(sampled_prediction(Experiment.load(arguments.file), precision=0.01))
    else:
        speed()
        if arguments.coverage:
            coverage(arguments.repetitions, arguments.precision)


if __name__ == "__main__":
    main()
