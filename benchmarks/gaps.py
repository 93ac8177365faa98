"""How far on the safe side the standard error of `msg-agents live` is when steps are missing.

Runs of the twin, of line and ring at rate 1, each with the same steps left out: the standard error that `live` gives,
beside the spread of what it measures over the runs. About a minute on one core.
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.online_errors import RunningErrors
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

EXPERIMENT = {
    "name": "line_ring",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "switching": {"generator": [[-1.0, 1.0], [1.0, -1.0]]},
    "run": {"dt": 0.05, "duration": 100.0, "replicas": 1},
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=400)
    runs = parser.parse_args().runs
    experiment = Experiment.parse(EXPERIMENT)
    prediction, steps = predict(experiment), np.arange(experiment.steps)
    chance = np.random.default_rng(1)
    kept = {
        "none": steps,
        "30 % at random": steps[chance.random(len(steps)) >= 0.3],
        "80 % at random": steps[chance.random(len(steps)) >= 0.8],
        "every second stretch of 100 steps": steps[steps // 100 % 2 == 0],
    }
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in kept}
    with threadpool_limits(1):
        for seed in range(runs):
            trajectory = simulate(experiment.with_run(seed=seed))
            for name, chosen in kept.items():
                errors = RunningErrors(trajectory.record, prediction)
                states = trajectory.states
                errors.add(chosen, trajectory.modes[chosen], states[chosen], states[chosen + 1])
                system, _ = errors.estimates()
                assert system.measured is not None
                assert system.standard_error is not None
                found[name].append((system.measured, system.standard_error))
    print("| missing | spread over the runs | standard error, mean | times too large |\n|---|---:|---:|---:|")
    for name, pairs in found.items():
        measured, errors_given = np.array(pairs).T
        spread, given = measured.std(ddof=1), np.sqrt((errors_given**2).mean())
        print(f"| {name} | {spread:.4f} | {given:.4f} | {given / spread:.2f} |")


if __name__ == "__main__":
    main()
