# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What `msg-analysis plan` says, against runs: standard errors of the system error, and lengths of runs.

    python benchmarks/planning.py                   # standard errors, a row for each of 15 experiments
    python benchmarks/planning.py --lengths 0.05    # the length at which the interval for all times reaches 5 %
    python benchmarks/planning.py --power           # faults of line/ring, one replica: the share of runs that disagree

Runs are those of the offline twin, each with its own seed. The standard error of a measured standard deviation is 1 /
sqrt(2 runs), 3.5 % with 400 runs.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import Any

import any_time
import numpy as np

from msg_analysis.common.resources import count_cores
from msg_analysis.common.text import percent
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.fault_power import Fault, fault_powers
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.sample_size import precision_of
from msg_analysis.inference.statistics import simultaneous_half_width
from msg_analysis.inference.time_means import time_means
from msg_analysis.inference.verdict import Evidence, evaluate
from msg_analysis.theory.prediction import Prediction, predict
from msg_analysis.theory.time_mean_variance import mean_variance
from msg_analysis.twin.simulate import simulate

EXPERIMENTS: dict[str, tuple[str, dict[str, Any], float, int]] = {  # example, changes, duration, replicas
    "line_ring": ("line_ring", {}, 400.0, 4),
    "one replica": ("line_ring", {}, 400.0, 1),
    "discrete": ("discrete", {}, 2000.0, 4),
    "fast_switching": ("fast_switching", {}, 400.0, 4),
    "slow_switching": ("slow_switching", {}, 4000.0, 4),
    "leaders held: leader_smallest": ("leader_smallest", {}, 400.0, 4),
    "finite leaders: tracking": ("tracking", {}, 1000.0, 4),
    "three_lines": ("three_lines", {}, 400.0, 4),
    "switching_hurts": ("switching_hurts", {}, 400.0, 4),
    "loss and link noise: lossy_links": ("lossy_links", {}, 400.0, 4),
    "broadcast noise": ("line_ring", {"noise": {"process": 1.0, "broadcast": 0.5}}, 400.0, 4),
    "last value heard": ("line_ring", {"noise": {"process": 1.0, "loss": 0.3, "on_loss": "hold"}}, 400.0, 4),
    "delay": ("line_ring", {"noise": {"process": 1.0, "delay": 2}}, 400.0, 4),
    "real time: line_ring_realtime": ("line_ring_realtime", {}, 400.0, 4),
    "hundred_agents": ("hundred_agents", {}, 400.0, 4),
}


def experiment(kind: str, seed: int, duration: float | None = None) -> Experiment:
    """One of the table, with this seed."""
    example, changes, usual, replicas = EXPERIMENTS[kind]
    document = Experiment.load(example).to_document() | changes
    run = {"duration": duration or usual, "replicas": replicas, "seed": seed}
    return Experiment.parse(document | {"run": document["run"] | run})


@cache
def law(kind: str) -> Prediction:
    """Its prediction."""
    return predict(experiment(kind, 1))


def time_mean(kind: str, seed: int) -> float:
    """The measured system error of a run."""
    states = simulate(experiment(kind, seed)).states[:-1]
    problem, reference = law(kind).experiment.problem, law(kind).step.reference
    centre = states.mean(axis=1, keepdims=True) if problem == "consensus" else reference
    return float(((states - centre) ** 2).sum(axis=1).mean())


def length(kind: str, precision: float, planned: int, seed: int) -> float:
    """Steps of a run after which its interval for all times is no wider than the precision; nan: it is at its end."""
    prediction = law(kind)
    dt = prediction.step.dt
    observation = Observation.of(simulate(experiment(kind, seed, planned * dt)), prediction)
    typical = mean_variance(prediction).of(observation.replicas)
    variances = np.cumsum(time_means(observation).system_variances)
    steps = np.arange(1, len(variances) + 1)
    half_width = simultaneous_half_width(variances, typical * planned) / steps
    reached = np.flatnonzero(half_width > precision * prediction.emulated.system_error)[-1] + 1
    return float(steps[reached]) if reached < len(steps) else float("nan")


FAULTS = {  # as in any_time.py
    "noise variance of agent 3 x 1.05": Fault("noise", 1.05, 2),
    "x 1.1": Fault("noise", 1.1, 2),
    "gain of one link x 0.8": Fault("gain", 0.8, 1, 0),
    "x 0.5": Fault("gain", 0.5, 1, 0),
    "both rates x 1.4": Fault("switching", 1.4),
    "both rates x 0.7": Fault("switching", 0.7),
}


def disagrees(fault: str, duration: float, seed: int) -> tuple[bool, float]:
    """Whether a run with a fault disagrees, and after how many steps its evidence passed; infinite: never."""
    run = simulate(any_time.experiment(seed, duration, **any_time.FAULTS[fault]))
    prediction = any_time.law("consensus", duration)
    evidence = Evidence.of(Observation.of(run, prediction), any_time.LEVEL)
    verdict = evaluate(run, prediction, evidence, any_time.LEVEL)
    assert verdict.any_time
    crossed = verdict.any_time.crossed
    return bool(verdict.verdict == "disagrees"), np.inf if crossed is None else crossed / prediction.step.dt


def print_power(pool: ProcessPoolExecutor, runs: int) -> None:
    """The table of power."""
    print("| fault | steps | power | of the runs | any time | median of the runs |\n|---|---:|---:|---:|---:|---:|")
    for name, fault in FAULTS.items():
        for duration in (400.0, 1000.0):
            prediction = any_time.law("consensus", duration)
            (plan,) = fault_powers(prediction, 1, any_time.LEVEL, [fault])
            found = list(pool.map(partial(disagrees, name, duration), range(runs)))
            steps = prediction.experiment.steps
            median = float(np.median([crossed for _, crossed in found]))
            words = f"{percent(plan.power(steps))} | {percent(float(np.mean([one for one, _ in found])))}"
            words += f" | {plan.evidence_steps():,.0f} | {median:,.0f}" if np.isfinite(median) else " | | "
            print(f"| {name} | {steps:,} | {words} |", flush=True)


def main() -> None:
    """Print a table in Markdown, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--lengths", type=float, metavar="PRECISION")
    parser.add_argument("--power", action="store_true")
    parser.add_argument("--only", nargs="*", choices=list(EXPERIMENTS), default=list(EXPERIMENTS))
    options = parser.parse_args()
    seeds = range(1000, 1000 + options.runs)
    with ProcessPoolExecutor(count_cores()) as pool:
        if options.power:
            print_power(pool, options.runs)
            return
        if options.lengths:
            print("| experiment | planned steps | median of the runs | ratio |\n|---|---:|---:|---:|", flush=True)
        else:
            print("| experiment | steps | predicted | measured | ratio |\n|---|---:|---:|---:|---:|", flush=True)
        for kind in options.only:
            prediction, replicas = law(kind), experiment(kind, 1).run.replicas
            error, variance = prediction.emulated.system_error, mean_variance(prediction).of(replicas)
            if options.lengths:
                if not precision_of(prediction, options.lengths).any_time:
                    continue
                planned = float(simultaneous_half_width(variance, variance) / (options.lengths * error)) ** 2
                task = partial(length, kind, options.lengths, round(1.5 * planned))
                found = float(np.median(list(pool.map(task, seeds))))
                print(f"| {kind} | {planned:,.0f} | {found:,.0f} | {found / planned:.3f} |", flush=True)
                continue
            steps = experiment(kind, 1).steps
            predicted = float(np.sqrt(variance / steps)) / error
            measured = float(np.std(list(pool.map(partial(time_mean, kind), seeds)), ddof=1)) / error
            row = f"{steps:,} | {percent(predicted)} | {percent(measured)} | {measured / predicted:.3f}"
            print(f"| {kind} | {row} |", flush=True)


if __name__ == "__main__":
    main()
