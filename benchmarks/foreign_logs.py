# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Level, power and coverage of ``compare --law --map`` on logs that scipy made, and its speed.

    .venv/bin/python benchmarks/foreign_logs.py level --logs 200 --samples 2000
    .venv/bin/python benchmarks/foreign_logs.py power --logs 50 --samples 20000
    .venv/bin/python benchmarks/foreign_logs.py speed

The logs are exact: every stretch with one graph is drawn by matrix exponentials (scipy), with the noise of Van Loan.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg

from msg_analysis import Experiment
from msg_analysis.common.resources import one_blas_thread
from msg_analysis.model.log import Log

LINE = [(1, 2), (2, 3), (3, 4), (4, 5)]
RING = [*LINE, (5, 1)]


@dataclass(frozen=True)
class Kind:
    """How a log is made; what is told of it is ``rate``, ``noise`` and ``r`` without the faults."""

    period: float = 0.1
    r: float = 0.1
    rate: float = 0.5
    irregular: bool = False
    gaps: bool = False
    leaders: dict[str, Any] | None = None
    directed: bool = False
    estimate: bool = False
    hidden: bool = False
    gain: float = 1.0  # faults: factor of all weights
    missing: tuple[int, int] | None = None  # edge that is in no graph
    louder: float = 1.0  # factor of the noise variance of agent 2
    faster: float = 1.0  # factor of the rates
    blurred: float = 1.0  # factor of the standard deviation of the measurement noise
    exchanged: bool = False  # agents 1 and 3
    jitter: float = 0.0  # standard deviation of the error of the stamps

    def law(self) -> Experiment:
        """The law that is told."""
        key = "arcs" if self.directed else "edges"
        rates = [[-self.rate, self.rate], [self.rate, -self.rate]]
        document = {
            "name": "lab",
            "graphs": {"line": {key: [list(e) for e in LINE]}, "ring": {key: [list(e) for e in RING]}},
            "switching": {"generator": rates},
            "noise": {"process": [1.0, 0.8, 1.2, 1.0, 0.9]},
        }
        if self.leaders:
            document |= {"problem": "tracking", "leaders": self.leaders}
        return Experiment.parse(document)


KINDS = {
    "T 0.5, r 0": Kind(period=0.5, r=0.0),
    "r 0.1": Kind(),
    "irregular": Kind(irregular=True, r=0.05),
    "gaps": Kind(gaps=True),
    "switches inside T": Kind(period=0.5, rate=5.0),
    "tracking": Kind(leaders={"agents": [3], "gain": 1.0, "reference": 2.0}),
    "directed": Kind(directed=True),
    "r estimated": Kind(estimate=True),
    "hidden": Kind(hidden=True),
}
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "gain x 0.8": ({"gain": 0.8}, "gain"),
    "missing link": ({"missing": (2, 3)}, "gain"),
    "noise x 1.1": ({"louder": 1.1}, "noise"),
    "rate x 1.5": ({"faster": 1.5}, "rate"),
    "r twice": ({"blurred": 2.0}, "measurement_noise"),
    "swapped agents": ({"exchanged": True}, "swapped"),
}


def stretch(z: np.ndarray, q: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """exp(-Z s) and a root of the covariance of the noise, by Van Loan."""
    m = len(z)
    block = np.block([[z, q], [np.zeros((m, m)), -z.T]]) * length
    found = scipy.linalg.expm(block)
    phi = found[m:, m:].T
    covariance = phi @ found[:m, m:]
    return phi, np.linalg.cholesky((covariance + covariance.T) / 2)


def simulate(kind: Kind, samples: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Times, states with measurement noise, and the path: starts and names."""
    edges = [LINE, RING]
    gains = np.zeros(5)
    reference = 0.0
    if kind.leaders:
        gains[np.array(kind.leaders["agents"]) - 1] = kind.leaders["gain"]
        reference = kind.leaders["reference"]
    drift = []
    for listed in edges:
        z = np.diag(gains)
        for a, b in listed:
            if (a, b) == kind.missing:
                continue
            for i, j in [(b, a)] if kind.directed else [(a, b), (b, a)]:
                z[i - 1, i - 1] += kind.gain
                z[i - 1, j - 1] -= kind.gain
        drift.append(z)
    q = np.diag(np.array([1.0, 0.8, 1.2, 1.0, 0.9]) ** 2 * np.array([1.0, kind.louder, 1.0, 1.0, 1.0]))
    lengths = kind.period * (0.2 + rng.exponential(0.8, samples - 1) if kind.irregular else np.ones(samples - 1))
    times = np.concatenate([[0.0], np.cumsum(lengths)])
    expected = times[-1] * kind.rate * kind.faster
    held = rng.exponential(1 / (kind.rate * kind.faster), int(expected + 10 * np.sqrt(expected) + 20))
    starts = np.concatenate([[0.0], np.cumsum(held)])
    starts = starts[starts < times[-1]]
    first = int(rng.integers(2))
    graphs = (np.arange(len(starts)) + first) % 2
    cuts = np.unique(np.concatenate([times, starts]))
    at_sample = np.isin(cuts, times)
    which = graphs[np.searchsorted(starts, cuts[:-1], side="right") - 1]
    known: dict[tuple[int, float], Any] = {}
    x, states = rng.normal(size=5), np.empty((samples, 5))
    states[0], done = x, 1
    for g, length, sampled in zip(which.tolist(), np.diff(cuts).tolist(), at_sample[1:].tolist(), strict=True):
        key = (g, round(length, 12))
        if key not in known:
            known[key] = stretch(drift[g], q, length)
            if len(known) > 5000:
                known.clear()
                known[key] = stretch(drift[g], q, length)
        phi, root = known[key]
        x = phi @ x + root @ rng.normal(size=5)
        if sampled:
            states[done], done = x, done + 1
    states = states + reference + kind.r * kind.blurred * rng.normal(size=states.shape)
    if kind.exchanged:
        states = states[:, [2, 1, 0, 3, 4]]
    if kind.gaps:
        kept = np.ones(samples, bool)
        for begin in rng.integers(1, samples, samples // 100):
            kept[begin : begin + int(rng.integers(1, 20))] = False
        times, states = times[kept], states[kept]
        states[rng.random(states.shape) < 0.05] = np.nan
    if kind.jitter:
        times = np.sort(times + kind.jitter * rng.normal(size=len(times)))
    return times, states, starts, [("line", "ring")[g] for g in graphs]


@dataclass
class Tally:
    """Of the logs of one kind."""

    logs: int = 0
    rejected: int = 0
    tests: Counter[str] = field(default_factory=Counter)
    first: Counter[str] = field(default_factory=Counter)
    words: Counter[str] = field(default_factory=Counter)
    covered: Counter[str] = field(default_factory=Counter)
    told: Counter[str] = field(default_factory=Counter)


def judge(kind: Kind, samples: int, seed: int) -> Any:
    """Of one log: rejected tests, causes, and which intervals cover what they should."""
    with one_blas_thread():
        times, states, starts, names = simulate(kind, samples, np.random.default_rng(seed))
        noise: Any = "estimate" if kind.estimate else kind.r
        graph = "hidden" if kind.hidden else (starts, names)
        log = Log.from_arrays(times, states, law=kind.law(), graph=graph, measurement_noise=noise)
        found = log.compare()
    covered = {
        name: low <= 1.0 <= high for name, one in found.factors.items() if one.interval for low, high in [one.interval]
    }
    if found.system_error and found.system_error.z is not None:
        covered["system error"] = abs(found.system_error.z) < 1.96
    if found.measurement_noise.interval:
        low, high = found.measurement_noise.interval
        covered["estimated r"] = low <= kind.r <= high
    rejected = [test.name for test in found.tests if test.rejected]
    return rejected, [(cause.kind, cause.words) for cause in found.causes], covered


def tally(pool: ProcessPoolExecutor, kind: Kind, args: argparse.Namespace) -> Tally:
    """Of many logs."""
    found = Tally()
    seeds = range(args.seed, args.seed + args.logs)
    args.seed += args.logs
    for rejected, causes, covered in pool.map(partial(judge, kind, args.samples), seeds, chunksize=4):
        found.logs += 1
        found.rejected += bool(rejected)
        found.tests.update(rejected)
        found.first.update([causes[0][0]] if causes else [])
        found.words.update([causes[0][1]] if causes else [])
        found.told.update(covered.keys())
        found.covered.update(name for name, right in covered.items() if right)
    return found


def level(pool: ProcessPoolExecutor, args: argparse.Namespace) -> None:
    """Right logs."""
    total = Tally()
    for name, kind in KINDS.items():
        if args.kinds and name not in args.kinds:
            continue
        kind = replace(kind, jitter=args.jitter * kind.period)
        found = tally(pool, kind, args)
        shares = ", ".join(f"{key} {found.covered[key] / count:.3f}" for key, count in sorted(found.told.items()))
        print(
            f"{name:18} rejected {found.rejected} of {found.logs} {dict(found.tests)}; coverage: {shares}", flush=True
        )
        for one in ("told", "covered"):
            getattr(total, one).update(getattr(found, one))
        total.logs, total.rejected = total.logs + found.logs, total.rejected + found.rejected
    shares = ", ".join(f"{key} {total.covered[key] / count:.4f}" for key, count in sorted(total.told.items()))
    print(f"all: rejected {total.rejected} of {total.logs} = {total.rejected / total.logs:.4f}; coverage: {shares}")


def power(pool: ProcessPoolExecutor, args: argparse.Namespace) -> None:
    """Wrong logs."""
    for name, (changes, cause) in FAULTS.items():
        found = tally(pool, replace(Kind(hidden=args.hidden), **changes), args)
        print(
            f"{name:15} found {found.rejected} of {found.logs}; first cause {cause}: {found.first[cause]}", flush=True
        )
        for words, count in found.words.most_common(2):
            print(f"    {count} {words}")


def speed(_pool: ProcessPoolExecutor, args: argparse.Namespace) -> None:
    """20 agents, 100,000 samples."""
    m, samples, rng = 20, args.samples, np.random.default_rng(1)
    agents = list(range(1, m + 1))
    law = Experiment.parse(
        {
            "name": "large",
            "graphs": {"line": {"path": agents}, "ring": {"cycle": agents}},
            "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        }
    )
    times = 0.1 * np.arange(samples)
    starts = np.concatenate([[0.0], np.cumsum(rng.exponential(2.0, samples // 10))])
    starts = starts[starts < times[-1]]
    names = [("line", "ring")[k % 2] for k in range(len(starts))]
    states = np.cumsum(0.05 * rng.normal(size=(samples, m)), axis=0)
    began, cpu = time.monotonic(), time.process_time()
    Log.from_arrays(times, states, law=law, graph=(starts, names), measurement_noise=0.1).compare()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{time.monotonic() - began:.1f} s, CPU {time.process_time() - cpu:.1f} s, {memory:.2f} GB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["level", "power", "speed"])
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jitter", type=float, default=0.0, help="of the stamps, in periods")
    parser.add_argument("--kinds", nargs="+", metavar="KIND", help="of level: only these")
    parser.add_argument("--hidden", action="store_true", help="of power: without the graphs")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as workers:
        {"level": level, "power": power, "speed": speed}[options.what](workers, options)
