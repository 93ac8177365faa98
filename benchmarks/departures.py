"""What is found of faults that sums over a run hide: constant states, noise over time, holding periods, stale values.

Simulates line/ring (``calibration_laws.line_ring``: 400 units, dt = 0.1, 16 replicas) step by step with one thing
wrong, and compares each run with the prediction without it. Runs without a fault say how often "disagrees" is a false
alarm.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
from calibration_laws import TRUE, line_ring

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.comparison import Comparison
from msg_analysis.inference.pool import compare
from msg_analysis.model.step_model import StepModel
from msg_analysis.twin.simulate import simulate

Random = np.random.Generator
STRETCH = 20  # steps


@dataclasses.dataclass(slots=True)
class Ways:
    """What may be wrong in a run; the defaults are right."""

    noise: FloatArray  # (N, m, R) standard normal; what a fault makes of it
    graphs: IntArray  # (N,) that the states follow
    logged: IntArray  # (N,)
    frozen: tuple[int, int, int] | None = None  # agent, first and last + 1 of its steps
    stale: float = 0.0  # share of the messages with the value of the step before


Fault = Callable[[Ways, Random], None]


def _still(ways: Ways, random: Random) -> None:
    first = int(random.integers(len(ways.graphs) - STRETCH))
    ways.frozen = (2, first, first + STRETCH)


def _swapped(blocks: int, ways: Ways, random: Random) -> None:
    """The log has the names of the two graphs swapped in blocks of 20 steps."""
    for block in random.choice(len(ways.graphs) // STRETCH, blocks, replace=False).tolist():
        ways.logged[block * STRETCH : (block + 1) * STRETCH] ^= 1


def _modulated(period: int, ways: Ways, _random: Random) -> None:
    """The variance of all noise is 1 + 0.3 sin(2 pi k / period)."""
    ways.noise *= np.sqrt(1.0 + 0.3 * np.sin(2.0 * np.pi * np.arange(len(ways.noise)) / period))[:, None, None]


def _drifting(ways: Ways, _random: Random) -> None:
    ways.noise *= np.sqrt(np.linspace(0.7, 1.3, len(ways.noise)))[:, None, None]


def _by_graph(ways: Ways, _random: Random) -> None:
    ways.noise *= np.sqrt(np.where(ways.graphs == 0, 1.1, 0.9))[:, None, None]


def _correlated(lag: int, share: float, ways: Ways, random: Random) -> None:
    """Of all agents; the variance stays 1."""
    fresh = random.standard_normal(ways.noise.shape)
    for k in range(len(fresh)):
        before = ways.noise[k - lag] if k >= lag else fresh[k]
        ways.noise[k] = share * before + (1.0 - share**2) ** 0.5 * fresh[k]


def _holding_periods(shape: float, ways: Ways, random: Random) -> None:
    """Gamma holding periods of the same mean as those of the chain, 21 steps, rounded up."""
    leaving = (1.0 - np.exp(-0.1)) / 2.0
    lengths = np.ceil(random.gamma(shape, (1.0 / leaving - 0.5) / shape, len(ways.graphs))).astype(int)
    ways.graphs[:] = np.repeat(np.arange(len(lengths)) % 2, lengths)[: len(ways.graphs)]
    ways.logged[:] = ways.graphs


def _outlier(size: float, ways: Ways, random: Random) -> None:
    ways.noise[int(random.integers(len(ways.noise))), 3, 0] = size


def _stale(share: float, ways: Ways, _random: Random) -> None:
    ways.stale = share


FAULTS: dict[str, tuple[Fault, str]] = {  # and the kind of the cause
    "an agent stands still for 20 steps": (_still, "frozen"),
    "names of the graphs swapped in 1 block of 20 steps": (partial(_swapped, 1), "graph"),
    "names of the graphs swapped in 10 blocks of 20 steps": (partial(_swapped, 10), "graph"),
    "noise variance modulated by 30 %, period 1,000 steps": (partial(_modulated, 1000), "noise"),
    "noise variance modulated by 30 %, period 100 steps": (partial(_modulated, 100), "noise"),
    "noise variance modulated by 30 %, period 10 steps": (partial(_modulated, 10), "noise"),
    "noise variance from 0.7 to 1.3 over the run": (_drifting, "noise"),
    "noise variance 1.1 in one graph, 0.9 in the other": (_by_graph, "noise"),
    "correlation 0.05 of each agent's noise at lag 20": (partial(_correlated, 20, 0.05), "lag"),
    "correlation 0.02 at lag 20": (partial(_correlated, 20, 0.02), "lag"),
    "gamma holding periods of shape 2": (partial(_holding_periods, 2.0), "holding times"),
    "gamma holding periods of shape 10": (partial(_holding_periods, 10.0), "holding times"),
    "gamma holding periods of shape 0.5": (partial(_holding_periods, 0.5), "holding times"),
    "one innovation of 8 standard deviations": (partial(_outlier, 8.0), "outlier"),
    "stale values in one message of five": (partial(_stale, 0.2), "stale"),
    "stale values in one message of ten": (partial(_stale, 0.1), "stale"),
}


def one_run(fault: str | None, replicas: int, seed: int) -> Comparison:
    """Simulate and compare a run."""
    claimed = Experiment.parse(line_ring(replicas=replicas)).with_run(seed=seed)
    right = simulate(claimed)
    if fault is None:
        return compare(right)
    random = np.random.default_rng([seed, 7])
    shape = (len(right.modes), *right.states.shape[1:])
    ways = Ways(random.standard_normal(shape), right.modes.copy(), right.modes.copy())
    FAULTS[fault][0](ways, random)
    step = right.record.model
    assert isinstance(step, StepModel)
    states = _states(step, ways, right.states[0], random)
    return compare(dataclasses.replace(right, states=states, modes=ways.logged))


def _states(step: StepModel, ways: Ways, start: FloatArray, random: Random) -> FloatArray:
    """(N + 1, m, R)."""
    states = np.empty((len(ways.graphs) + 1, *start.shape))
    states[0] = start
    for k, graph in enumerate(ways.graphs.tolist()):
        weights, x = step.weights[graph], states[k]
        states[k + 1] = weights @ x + step.noise_gain[graph] @ ways.noise[k]
        if ways.stale and k:
            # Every message by itself: the same for all replicas, as in the network.
            late = (random.random(weights.shape) < ways.stale) & ~np.eye(len(weights), dtype=bool)
            states[k + 1] += (weights * late) @ (states[k - 1] - x)
        if ways.frozen and ways.frozen[1] <= k < ways.frozen[2]:
            states[k + 1, ways.frozen[0]] = x[ways.frozen[0]]
    return states


@dataclasses.dataclass(frozen=True, slots=True)
class Kept:
    """What is kept of a run."""

    found: bool  # "disagrees"
    evidence: bool  # whether it passes 100
    right: bool  # whether the first cause is the right one
    rejected: list[str]  # tests
    words: str  # the first cause


def summary(fault: str | None, replicas: int, seed: int) -> Kept:
    """Simulate and compare a run."""
    result = one_run(fault, replicas, seed)
    rejected = sorted({test.name.partition(" of agent")[0] for test in result.tests if test.rejected})
    first = result.causes[0] if result.causes else None
    assert result.any_time is not None
    right = bool(first and fault and first.kind == FAULTS[fault][1])
    words = first.words if first else ""
    return Kept(result.verdict == "disagrees", result.any_time.exceeded, right, rejected, words)


CORRECT = {"line/ring, 16 replicas": line_ring(replicas=16)} | {
    name: law for name, law in TRUE.items() if name.startswith(("three", "discrete"))
}


@dataclasses.dataclass(frozen=True, slots=True)
class Correct:
    """What is kept of a run without a fault."""

    disagrees: bool
    evidence: bool
    p: dict[str, float]  # of every test


def correct_run(law: str, seed: int) -> Correct:
    """Simulate and compare a run without a fault."""
    result = compare(simulate(Experiment.parse(CORRECT[law]).with_run(seed=seed)))
    assert result.any_time is not None
    p = {test.name: test.p for test in result.tests if " of agent" not in test.name}
    return Correct(result.verdict == "disagrees", result.any_time.exceeded, p)


def print_faults(pool: ProcessPoolExecutor, faults: list[str], runs: int, replicas: int, words: bool) -> None:
    """Print how often each fault is found."""
    print("| what is wrong | found | evidence passes 100 | right cause first | rejected by |\n|---|---:|---:|---:|---|")
    for fault in faults:
        kept = list(pool.map(partial(summary, fault, replicas), range(1, runs + 1)))
        found, evidence, right = (sum(getattr(one, name) for one in kept) for name in ("found", "evidence", "right"))
        by = Counter(name for one in kept for name in one.rejected)
        shown = ", ".join(f"{name} {count}" for name, count in by.most_common())
        print(f"| {fault} | {found} of {len(kept)} | {evidence} | {right} | {shown or '-'} |", flush=True)
        if words:
            print(json.dumps([one.words for one in kept], indent=1), flush=True)


def print_correct(pool: ProcessPoolExecutor, runs: int) -> None:
    """Print how often runs without a fault disagree, and how often each p-value is small."""
    print("| law | false alarms | evidence passes 100 | p below 5 % (below 1 %), test by test |\n|---|---:|---:|---|")
    for law in CORRECT:
        kept = list(pool.map(partial(correct_run, law), range(10_001, 10_001 + runs), chunksize=10))
        alarms, evidence = sum(one.disagrees for one in kept), sum(one.evidence for one in kept)
        shares = []
        for name in kept[0].p:
            p = np.array([one.p[name] for one in kept if name in one.p])
            shares.append(f"{name} {100 * (p < 0.05).mean():.1f} ({100 * (p < 0.01).mean():.1f})")
        print(f"| {law} | {alarms} of {runs} | {evidence} | {', '.join(shares)} |", flush=True)


def main() -> None:
    """Print tables in Markdown, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=25, help="with each fault; 25 by default")
    parser.add_argument("--replicas", type=int, default=16)
    parser.add_argument("--only", nargs="*", choices=[*FAULTS], default=[*FAULTS])
    parser.add_argument("--words", action="store_true", help="print the first cause of every run, too")
    parser.add_argument("--correct", type=int, help="so many runs of each of three laws without a fault, nothing else")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        if options.correct:
            print_correct(pool, options.correct)
        else:
            print_faults(pool, options.only, options.runs, options.replicas, options.words)


if __name__ == "__main__":
    main()
