"""P-values on the air and in real time, and what small deviations show: tables of docs/calibration.md.

Beside ``calibration.py``: simulates runs with the offline twin and compares each with its prediction. Prints Markdown;
about ten minutes on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import late_timers
import numpy as np
from scipy import stats
from threadpoolctl import threadpool_limits

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.pool import compare
from msg_analysis.model.run_record import RunRecord
from msg_analysis.twin.simulate import simulate


def line_ring(
    *,
    rate: float = 0.5,
    noise: float = 1.0,
    edge: float = 1.0,
    ring: float = 1.0,
    air: Mapping[str, float] | None = None,
    **run: Any,
) -> Mapping[str, Any]:
    """The demo experiment, with weights of the ring's edge 1-2 and of all its edges, and noise on the air."""
    weights = [ring * edge, ring, ring, ring, ring]
    return {
        "name": "line_ring",
        "graphs": {
            "line": {"path": [1, 2, 3, 4, 5]},
            "ring": {"edges": [[i + 1, (i + 1) % 5 + 1, weight] for i, weight in enumerate(weights)]},
        },
        "switching": {"generator": [[-rate, rate], [rate, -rate]]},
        "noise": {"process": noise, **(air or {})},
        "run": {"dt": 0.05, "duration": 100.0, "replicas": 4} | run,
    }


AIR = {"broadcast": 0.5, "link": 0.5, "loss": 0.2}
LONG: dict[str, Any] = {"duration": 400.0, "replicas": 16}
FALSE = {
    "all noise 1 % larger": line_ring(noise=1.01, **LONG),
    "one of the ring's edges 5 % weaker": line_ring(edge=0.95, **LONG),
    "one of the ring's edges 20 % weaker": line_ring(edge=0.8, **LONG),
    "all of the ring's edges 5 % weaker": line_ring(ring=0.95, **LONG),
    "switching at 0.6 instead of 0.5": line_ring(rate=0.6, **LONG),
    "switching at 0.75 instead of 0.5": line_ring(rate=0.75, **LONG),
}


def comparisons(true: Experiment, claimed: Experiment, runs: int) -> Iterator[Comparison]:
    """Compare runs of one experiment with the prediction of another, or of the same one."""
    for seed in range(runs):
        trajectory = simulate(true.with_run(seed=seed))
        record = trajectory.record
        claim = RunRecord(record.run, claimed.with_run(seed=seed), record.start)
        yield compare(dataclasses.replace(trajectory, record=claim))


def print_evenness(runs: int) -> None:
    """The p-values of runs with noise and loss on the air: even, if the tests are right."""
    print("\n| noise and loss on the air | p below 5 % | p below 50 % | Kolmogorov-Smirnov p of the p-values |")
    print("|---|---:|---:|---:|")
    experiment = Experiment.parse(line_ring(air=AIR))
    values: dict[str, list[float]] = {}
    for comparison in comparisons(experiment, experiment, runs):
        for test in comparison.tests:
            values.setdefault(test.name, []).append(test.p)
    for name, found in values.items():
        p = np.array(found)
        even = stats.kstest(p, "uniform").pvalue
        print(f"| {name} | {100 * (p < 0.05).mean():.1f} % | {100 * (p < 0.5).mean():.1f} % | {even:.2f} |", flush=True)


def print_real_time(runs: int) -> None:
    """Runs in real time, on time and late: p-values, false alarms, and what is found of agents that are wrong."""
    late = {
        "late": late_timers.busy(0.3, 1.5),
        "slow": late_timers.busy(0.3, 0.7),
        "switch": late_timers.busy(0.5, 1.0),
    }
    experiment = Experiment.parse(line_ring(pace="realtime", dt=0.1))
    values: dict[str, dict[str, list[float]]] = {}
    print("\n| real time | false alarms | deadlines missed | sequential law not supported |")
    print("|---|---:|---:|---:|")
    for name, timing in (("nobody late", dict[str, Any]()), ("late", late)):
        alarms, missed, sequential = 0, 0.0, 0
        values[name] = {}
        for seed in range(runs):
            trajectory = late_timers.run(experiment.with_run(seed=seed), timing_seed=seed, **timing)
            comparison = compare(trajectory)
            alarms += comparison.verdict == "disagrees"
            assert comparison.timing is not None
            assert comparison.laws is not None
            missed += comparison.timing.missed_share / runs
            sequential += comparison.laws.sequential.supported is False
            for test in comparison.tests:
                values[name].setdefault(test.name, []).append(test.p)
        numbers = f"{100 * alarms / runs:.1f} % | {100 * missed:.1f} % | {100 * sequential / runs:.1f} %"
        print(f"| {name} | {numbers} |", flush=True)
    print("\n| real time | test | p below 5 % | p below 50 % | Kolmogorov-Smirnov p of the p-values |")
    print("|---|---|---:|---:|---:|")
    for name, tests in values.items():
        for what, found in tests.items():
            p = np.array(found)
            even = stats.kstest(p, "uniform").pvalue
            print(
                f"| {name} | {what} | {100 * (p < 0.05).mean():.1f} % | {100 * (p < 0.5).mean():.1f} % | {even:.2f} |"
            )


def print_power(runs: int) -> None:
    """Runs that do not."""
    print("\n| what is wrong | found | by (share of the runs) |")
    print("|---|---:|---|")
    claimed = Experiment.parse(line_ring(**LONG))
    for name, document in FALSE.items():
        found = 0
        by: Counter[str] = Counter()
        for comparison in comparisons(Experiment.parse(document), claimed, runs):
            rejected = {test.name.partition(" of agent")[0] for test in comparison.tests if test.rejected}
            found += bool(rejected)
            by.update(rejected)
        tests = ", ".join(f"{test} {100 * count / runs:.0f} %" for test, count in by.most_common()) or "-"
        print(f"| {name} | {100 * found / runs:.0f} % | {tests} |", flush=True)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description="P-values, and power against small deviations.")
    parser.add_argument("--runs", type=int, default=400, help="runs in real time; half of that on the air")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        print_evenness(max(1, arguments.runs // 2))
        print_real_time(arguments.runs)
        print_power(max(1, arguments.runs // 8))


if __name__ == "__main__":
    main()
