"""Which errors to trust: coverage over all paths and given the path, in runs with few holding periods or heavy tails.

    python benchmarks/trust.py

Few holding periods: 400 units, 16 replicas, with ever slower switching. Heavy tails: laws with infinite fourth moments,
2,000 steps, one replica, twice as many runs. Every run of a law has its own seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import Any

import numpy as np

from msg_analysis.common.resources import count_cores
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.estimates import estimates
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.verdict import Evidence, evaluate
from msg_analysis.theory.prediction import Prediction, predict
from msg_analysis.twin.simulate import simulate

SWITCHES = (2, 4, 8, 16)  # expected away from each graph
DURATION = 400.0
LINE = [[1, 2], [2, 3], [3, 4], [4, 5]]


def _switching(rate: float, ratio: float = 1.0) -> dict[str, Any]:
    return {"switching": {"generator": [[-rate, rate], [ratio * rate, -ratio * rate]]}}


def _slow(graphs: Mapping[str, Any], dt: float, ratio: float, switches: int) -> dict[str, Any]:
    """Two graphs; the second is left ``ratio`` times as fast as the first, both ``switches`` times on average."""
    rate = switches / DURATION * (1.0 + ratio) / ratio
    document = {"name": "slow", "graphs": graphs, "noise": {"process": 1.0}}
    return document | _switching(rate, ratio) | {"run": {"dt": dt, "duration": DURATION, "replicas": 16}}


RING = {"line": {"edges": LINE}, "ring": {"edges": [*LINE, [5, 1]]}}
PAIRS = {"line": {"path": [1, 2, 3, 4]}, "pairs": {"edges": [[1, 2], [3, 4]]}}
SLOW: dict[str, Callable[[int], dict[str, Any]]] = {
    "line/ring": partial(_slow, RING, 0.2, 1.0),
    "line/pairs": partial(_slow, PAIRS, 0.1, 1.0),
    "line/pairs, one graph four times as long": partial(_slow, PAIRS, 0.1, 4.0),
}


def _heavy(a: list[Any], b: list[Any], rate: float, loss: float, dt: float) -> dict[str, Any]:
    document = {"name": "heavy", "graphs": {"a": {"arcs": a}, "b": {"arcs": b}}}
    return (
        document
        | _switching(rate)
        | {"noise": {"process": 1.0, "loss": loss}, "run": {"dt": dt, "duration": 2000 * dt}}
    )


HEAVY = {
    "switching": _heavy([[1, 2, 0.3], [1, 3, 3], [3, 2, 0.3]], [[2, 3, 3], [3, 1, 3]], 0.05, 0.0, 0.6),
    "switching and losses": _heavy(
        [[1, 3, 3], [3, 1, 3], [3, 2, 0.3]], [[1, 3, 3], [2, 1, 3], [3, 1, 3], [3, 2, 3]], 0.2, 0.3, 0.323
    ),
}


@cache
def law(kind: str, switches: int | None) -> Prediction:
    """What runs of a kind are compared with."""
    return predict(Experiment.parse(HEAVY[kind] if switches is None else SLOW[kind](switches)))


def examine(kind: str, switches: int | None, seed: int) -> tuple[float, float, float, bool]:
    """One run: measured over predicted error, z over all paths, z given the path, false alarm."""
    prediction = law(kind, switches)
    trajectory = simulate(prediction.experiment.with_run(seed=seed))
    evidence = Evidence.of(Observation.of(trajectory, prediction), 0.01)
    error = estimates(evidence.means, prediction.system)[0]  # also where the verdict leaves its interval out
    comparison = evaluate(trajectory, prediction, evidence, 0.01)
    assert error.measured is not None
    assert error.predicted is not None
    assert error.z is not None
    assert comparison.given is not None
    given = comparison.given.system_error.z
    assert given is not None
    return error.measured / error.predicted, error.z, given, comparison.verdict == "disagrees"


def main() -> None:
    """Print a table in Markdown, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="of each law")
    options = parser.parse_args()
    print("| law | | runs | median of measured / predicted | all paths | given path | false alarms |")
    print("|---|---|---:|---:|---:|---:|---:|", flush=True)
    slow = [(kind, switches) for switches in SWITCHES for kind in SLOW]
    with ProcessPoolExecutor(count_cores()) as pool:
        for kind, switches in [*slow, *((kind, None) for kind in HEAVY)]:
            task = partial(examine, kind, switches)
            seeds = range(7000, 7000 + options.runs) if switches else range(300, 300 + 2 * options.runs)
            found = np.array(list(pool.map(task, seeds)), dtype=float)
            ratio, z, given, alarms = found.T
            radius = law(kind, switches).fourth_moment.radius
            what = f"{switches} switches" if switches else f"fourth moments x {radius:.3g} per step"
            shares = [*((np.abs(each) < 1.96).mean() for each in (z, given)), alarms.mean()]
            shown = " | ".join(f"{100 * share:.1f} %" for share in shares)
            print(f"| {kind} | {what} | {len(seeds)} | {np.median(ratio):.2f} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
