"""How often correct runs ever pass the threshold of the evidence at any time, and when faults are found.

    python benchmarks/any_time.py --runs 200

Line/ring with 5 agents, one replica, 20,000 steps, looked at every 100 steps at level 1 %. Faults are run next to the
prediction of the law without the fault.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import Any

import numpy as np

from msg_analysis.common.resources import count_cores
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.evidence_sums import WatchedEvidence
from msg_analysis.inference.observation import Observation
from msg_analysis.theory.prediction import Prediction, predict
from msg_analysis.twin.simulate import simulate

LEVEL, EVERY = 0.01, 100
LINE = [[i, j, 1.0] for a, b in ((1, 2), (2, 3), (3, 4), (4, 5)) for i, j in ((a, b), (b, a))]
RING = [*LINE, [1, 5, 1.0], [5, 1, 1.0]]
AIR = {"loss": 0.3, "link": 0.3, "broadcast": 0.2}

CORRECT: dict[str, dict[str, Any]] = {
    "consensus": {},
    "one leader": {"problem": "tracking", "leaders": {"agents": [1], "gain": 1.0}},
    "noise and losses on the air": {"noise": AIR},
    "the last value heard": {"noise": {"loss": 0.3, "on_loss": "hold"}},
    "real time": {"run": {"pace": "realtime"}},
}


def _weak(factor: float) -> dict[str, Any]:
    """The link from agent 1 to agent 2 has another gain in both graphs."""
    return {
        name: {"arcs": [[i, j, factor if (i, j) == (1, 2) else w] for i, j, w in arcs]}
        for name, arcs in (("line", LINE), ("ring", RING))
    }


FAULTS: dict[str, dict[str, Any]] = {
    "noise variance of agent 3 x 1.05": {"noise": {"process": [1, 1, 1.05**0.5, 1, 1]}},
    "x 1.1": {"noise": {"process": [1, 1, 1.1**0.5, 1, 1]}},
    "gain of one link x 0.8": {"graphs": _weak(0.8)},
    "x 0.5": {"graphs": _weak(0.5)},
    "both rates x 1.4": {"switching": {"generator": [[-0.7, 0.7], [0.7, -0.7]]}},
    "both rates x 0.7": {"switching": {"generator": [[-0.35, 0.35], [0.35, -0.35]]}},
}


def experiment(seed: int, duration: float, **changes: Any) -> Experiment:
    """Line/ring, with some keys replaced."""
    run = {"dt": 0.05, "duration": duration, "replicas": 1, "seed": seed}
    document = {
        "name": "line_ring",
        "problem": "consensus",
        "time": "continuous",
        "graphs": {"line": {"arcs": LINE}, "ring": {"arcs": RING}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
    }
    return Experiment.parse(document | changes | {"run": run | changes.get("run", {})})


@cache
def law(kind: str, duration: float) -> Prediction:
    """The prediction that runs of this kind are held against: that of a fault is without it."""
    return predict(experiment(1, duration, **CORRECT.get(kind, {})))


def first_passage(kind: str, duration: float, seed: int) -> float:
    """Steps after which a run first passes 1 / LEVEL; infinite: never."""
    truth = experiment(seed, duration, **(CORRECT | FAULTS)[kind])
    observation = Observation.of(simulate(truth), law(kind, duration))
    looks = np.arange(EVERY, observation.steps + 1, EVERY)
    logarithms = WatchedEvidence(observation, looks).follow(observation).logarithms
    assert logarithms is not None
    passed = np.flatnonzero(logarithms >= -np.log(LEVEL))
    return float(looks[passed[0]]) if len(passed) else np.inf


def main() -> None:
    """Print a table in Markdown, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--duration", type=float, default=1000.0, help="units of simulated time, 20 steps each")
    parser.add_argument("--only", nargs="*", choices=[*CORRECT, *FAULTS], default=[*CORRECT, *FAULTS])
    options = parser.parse_args()
    print("| truth | runs | ever passed | median | 90 % passed by |\n|---|---:|---:|---:|---:|", flush=True)
    with ProcessPoolExecutor(count_cores()) as pool:
        for kind in options.only:
            task = partial(first_passage, kind, options.duration)
            steps = np.array(list(pool.map(task, range(1000, 1000 + options.runs))))
            share = 100.0 * np.isfinite(steps).mean()
            found = [f"{q:,.0f}" if np.isfinite(q) else "-" for q in np.quantile(steps, [0.5, 0.9], method="higher")]
            print(f"| {kind} | {options.runs} | {share:.1f} % | {found[0]} | {found[1]} |", flush=True)


if __name__ == "__main__":
    main()
