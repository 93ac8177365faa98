"""Departures in time or in detail: sums and p-values against loops over the steps, windows and links; faults."""

import dataclasses
import re
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, TypeVar

import departures
import numpy as np
import pytest
from scipy import stats
from tests.support.watched_run import sums_of

from experiments import Observation, chain_path, compare, five, observed, simulate
from msg_analysis.inference.dependence import ConstantState, LongLags, Replicas
from msg_analysis.inference.e_values import Analyses, WindowEvidence, Windows, variance_evidence
from msg_analysis.inference.graph_names import SwappedGraphs
from msg_analysis.inference.graphs import PARTS, HoldingTimes, SecondOrder
from msg_analysis.inference.messages import StaleValues
from msg_analysis.inference.noise import LargestResidual, NoiseByGraph, NoiseOverTime
from msg_analysis.inference.question import Diagnostic

Kind = TypeVar("Kind", bound=Diagnostic)
AIR = {"process": 1.0, "loss": 0.3, "link": 0.2, "broadcast": 0.1}


def seen(seed: int = 1, duration: float = 20.0, **changes: Any) -> Observation:
    return observed(five(seed, duration, **{**changes, "run": {"replicas": 2} | changes.get("run", {})}))


def summed(observation: Observation, kind: type[Kind], size: int = 37) -> Kind:
    """The sums of a run, in blocks of so many steps."""
    return next(each for each in sums_of(observation, size, in_detail=True).diagnostics if isinstance(each, kind))


def whitened(observation: Observation) -> np.ndarray:
    """(N, m, R) of a law without noise on the air, whose noise has the variance dt."""
    step, x = observation.step, observation.states
    steps = zip(observation.modes.tolist(), x[:-1], x[1:], strict=True)
    return np.array([after - step.weights[g] @ now for g, now, after in steps]) / np.sqrt(0.05)


def windows_of(steps: int) -> list[tuple[int, int]]:
    """(level, first step) of every window."""
    found = []
    for level in range(steps.bit_length()):
        half = max(1, 2**level // 2)
        found += [(level, first) for first in range(0, steps - 2**level + 1, half)]
    return found


@pytest.mark.parametrize("steps", [1, 2, 3, 64, 100, 127])
@pytest.mark.parametrize("size", [1, 7, 200])
def test_windows_and_the_mean_of_their_evidence(steps: int, size: int) -> None:
    """After every block: sums by a loop; a window counts 1 before it begins, 0 while it goes on, then its evidence."""
    numbers, every = np.random.default_rng(steps).standard_normal((steps, 2)), windows_of(steps)
    number_of = Counter(level for level, _ in every)
    windows, found = Windows(steps, 2), {}
    evidence, twice = WindowEvidence(windows, 2), WindowEvidence(Windows(steps, 2), 2)
    for begin in range(0, steps, size):
        block = numbers[begin : begin + size]
        ended = windows.add(block)
        found |= dict(zip(zip(ended.level.tolist(), ended.first.tolist(), strict=True), ended.sums, strict=True))
        evidence.add(ended, ended.sums, Analyses(np.array([len(block)])))
        seen = begin + len(block)
        assert sorted(found) == sorted((level, first) for level, first in every if first + 2**level <= seen)
        means = np.zeros(2)
        for level, first in every:
            value = float(first >= seen)
            if (level, first) in found:
                value = np.exp(numbers[first : first + 2**level].sum(axis=0))
            means += value / (number_of[level] * len(number_of))
        assert np.exp(evidence.logarithms()) == pytest.approx(means)
    assert (windows.seen() == windows.planned).all()
    for _ in range(2):
        twice.merge(evidence)  # of a run that has not begun: 1
    assert twice.logarithms() == pytest.approx(2.0 * evidence.logarithms())


THREE = [[0.8, 0.1, 0.1], [0.3, 0.5, 0.2], [0.2, 0.2, 0.6]]
SLOW = [[0.95, 0.05], [0.05, 0.95]]


def holding_times(transition: list[list[float]], path: np.ndarray, size: int = 10**6) -> HoldingTimes:
    """Of a path of graphs, counted in blocks of so many steps."""
    step = SimpleNamespace(transition=np.array(transition), modes=len(transition), switching=None)
    law: Any = SimpleNamespace(step=step, noisy=np.ones(3, dtype=bool), apart=True)
    sums = HoldingTimes(law)
    for first in range(0, len(path), size):
        graphs = path[first : first + size + 1]  # the last one is that of the next step
        block: Any = SimpleNamespace(graphs=graphs, analyses=Analyses(np.array([len(graphs)])))
        sums.add(block)
    return sums


def test_holding_times_by_a_loop_and_their_statistic_by_a_table() -> None:
    path = chain_path(SLOW, 20_000, 4)
    sums = holding_times(SLOW, path, 50)
    steps, left, age = np.zeros((2, PARTS)), np.zeros((2, PARTS)), 0
    for now, following in pairwise(path.tolist()):
        # Part p has the ages by which at least p, and fewer than p + 1, eighths of the holding times have ended.
        part = int(np.floor(PARTS * (1.0 - 0.95**age) + 1e-9))
        steps[now, part] += 1
        left[now, part] += now != following
        age = 0 if now != following else age + 1
    assert (np.array(sums.sums) == [steps, left]).all()
    tables = [np.vstack([those, all_of_them - those]) for all_of_them, those in zip(steps, left, strict=True)]
    total = sum(stats.chi2_contingency(table, lambda_="log-likelihood")[0] for table in tables)
    assert np.exp(sums.finding().log_p) == pytest.approx(stats.chi2.sf(total, 14), rel=1e-6)
    assert holding_times(SLOW, chain_path(SLOW, 300, 1)).finding() is None  # too few


@pytest.mark.parametrize(("transition", "steps"), [(SLOW, 1500), (SLOW, 4000), (THREE, 400)])
def test_holding_times_of_a_chain_have_even_p_values(transition: list[list[float]], steps: int) -> None:
    """Of 200 chains each; Kolmogorov-Smirnov at 1e-3."""
    paths = [chain_path(transition, steps, seed) for seed in range(200)]
    p = [np.exp(holding_times(transition, path).finding().log_p) for path in paths]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_noise_by_graph() -> None:
    observation = seen()
    sums, white = summed(observation, NoiseByGraph), whitened(observation)
    p = []
    for g in range(2):
        squares = (white[observation.modes == g] ** 2).sum(axis=(0, 2))
        number = 2 * int((observation.modes == g).sum())
        assert sums.sums[1][g] == pytest.approx(squares)
        assert (sums.sums[0][g] == number).all()
        for total, samples in [*((s, number) for s in squares), (squares.sum(), 5 * number)]:
            p.append(2.0 * min(stats.chi2.sf(total, samples), stats.chi2.cdf(total, samples)))
    assert np.exp(sums.finding().log_p) == pytest.approx(min(1.0, 12 * min(p)))
    names = [f"noise of agent 1 in graph {sums.law.graphs[0]}", f"noise of all agents in graph {sums.law.graphs[1]}"]
    assert ([sums.about(row) for row in (0, 11)], len(sums.logarithms())) == (names, 12)


def test_noise_over_time_by_windows() -> None:
    """A burst in four steps; the p is the least of a loop over all windows, and the evidence their mean."""
    observation = seen(duration=5.0)
    observation.states[31:35, 2] += 1.0
    sums, white = summed(observation, NoiseOverTime), whitened(observation)
    squares = (white**2).sum(axis=2)
    squares = np.column_stack([squares, squares.sum(axis=1)])
    numbers = np.array([2, 2, 2, 2, 2, 10])
    every = windows_of(100)
    counts = Counter(level for level, _ in every)
    least, evidence = [], np.zeros(6)
    for level, first in every:
        total, samples = squares[first : first + 2**level].sum(axis=0), numbers * 2**level
        tails = np.minimum(stats.chi2.sf(total, samples), stats.chi2.cdf(total, samples))
        least.append((float(tails.min()) * 2 * 7 * counts[level] * 6, level, first, int(tails.argmin())))
        evidence += np.exp(variance_evidence(samples, total)).mean(axis=1) / (7 * counts[level])
    finding = sums.finding()
    p, level, first, agent = min(least)
    assert np.exp(finding.log_p) == pytest.approx(p, rel=1e-6)  # of 100 steps no lag has enough products
    assert (finding.place.first, finding.place.last) == (first + 1, first + 2**level)
    assert finding.agent == agent
    assert np.exp(sums.logarithms()[:6, 0]) == pytest.approx(evidence)


@pytest.mark.parametrize("agent", [2, None])
def test_noise_over_time_by_lags(agent: int | None) -> None:
    """A variance that swings with a period of 10 steps, of one agent or of all; against a loop over the lags."""
    observation = seen(duration=60.0)
    white, size = whitened(observation), 0.3 if agent is None else 0.8
    which = slice(None) if agent is None else slice(agent, agent + 1)
    white[:, which] *= np.sqrt(1.0 + size * np.sin(2.0 * np.pi * np.arange(1200) / 10.0))[:, None, None]
    sums = NoiseOverTime(summed(observation, NoiseOverTime).law)
    for first in range(0, 1200, 37):
        part = white[first : first + 37]
        block: Any = SimpleNamespace(first=first, white=part, analyses=Analyses(np.array([len(part)])))
        sums.add(block)
    squares = (white**2).sum(axis=2)
    squares = np.column_stack([squares, squares.sum(axis=1)])
    scores = stats.norm.ppf(stats.chi2.cdf(squares, [2, 2, 2, 2, 2, 10]))
    p: dict[float, tuple[int, int]] = {}
    evidence = np.zeros((100, 6))
    for lag in range(1, 101):
        score, information = (scores[lag:] * scores[:-lag]).sum(axis=0), (scores[:-lag] ** 2).sum(axis=0)
        for column, z in enumerate(score / np.sqrt(information)):
            p[2 * 600 * 2 * stats.norm.sf(abs(z))] = lag, column
        for tau in (0.05, 0.3):
            spread = 1.0 + tau**2 * information
            evidence[lag - 1] += np.exp(tau**2 * score**2 / (2.0 * spread)) / np.sqrt(spread) / 200.0
    finding = sums.finding()
    lag, column = p[min(p)]
    assert lag % 10 in (0, 5)
    assert np.exp(finding.log_p) == pytest.approx(min(p))
    assert (finding.agent, finding.span, column) == (agent, (lag, lag), 5 if agent is None else agent)
    assert np.exp(sums.logarithms()[6:, 0]) == pytest.approx(evidence.sum(axis=0))
    assert sums.about(8) == "size of the noise of agent 3 and of its own earlier noise"
    assert len(sums.logarithms()) == 12


def test_standing_still() -> None:
    observation = seen()
    for k in (*range(30, 45), 70, 80):
        observation.states[k + 1, 3] = observation.states[k, 3]
    sums = summed(observation, ConstantState)
    finding = sums.finding()
    assert (finding.agent, finding.place.first, finding.place.last) == (3, 31, 45)
    q = [
        np.prod(4.0 * (np.spacing(np.abs(observation.states[k]).max(axis=0)) / np.sqrt(0.05) + 2.0**-52))
        for k in (*range(30, 45), 70, 80)
    ]
    expected = np.log(0.5 * (1.0 + np.sum(1.0 / np.array(q)) / (5 * 400)))
    assert sums.logarithms()[0, 0] == pytest.approx(expected)
    assert finding.log_p == pytest.approx(-expected)
    assert summed(seen(), ConstantState).finding().log_p == 0.0


def test_the_largest_innovation() -> None:
    observation = seen()
    observation.states[120, 1, 1] += 8.0 * np.sqrt(0.05)
    sums, white = summed(observation, LargestResidual), whitened(observation)
    finding = sums.finding()
    at = np.unravel_index(np.argmax(np.abs(white)), white.shape)
    assert (finding.place.first - 1, finding.agent) == at[:2]
    assert np.exp(finding.log_p) == pytest.approx(4000 * 2 * stats.norm.sf(np.abs(white).max()))
    large = white[np.abs(white) > 4.0] ** 2
    mean = np.exp(variance_evidence(np.ones(len(large)), large)[:, 0]).sum() / 4000
    assert np.exp(sums.logarithms()[0, 0]) == pytest.approx(0.5 * (1.0 + mean))


def test_a_network_that_never_moves() -> None:
    """All innovations are 0: lags say nothing, and the verdict says what is wrong."""
    run = simulate(five(duration=20.0, run={"start": "zero"}))
    still = dataclasses.replace(run, states=np.zeros_like(run.states))
    finding = summed(observed(still), LongLags).finding()
    assert (finding.log_p, finding.estimate) == (0.0, 0.0)
    result = compare(still)
    assert result.verdict == "disagrees"
    assert result.causes[0].words == "agent 1 does not move in any of its steps, although it has noise"


def test_long_lags() -> None:
    observation = seen()
    sums, white = summed(observation, LongLags), whitened(observation)
    p = []
    for lag in range(1, 101):
        late, early = white[lag:], white[:-lag]
        score, information = (late * early).sum(axis=(0, 2)), (early**2).sum(axis=(0, 2))
        assert sums.lags.score[lag - 1] == pytest.approx(score, abs=1e-9)
        assert sums.lags.information[lag - 1] == pytest.approx(information)
        p += (1000 * 2 * stats.norm.sf(np.abs(score / np.sqrt(information)))).tolist()
        p.append(200 * 2 * stats.norm.sf(abs(score.sum() / np.sqrt(information.sum()))))
    assert np.exp(sums.finding().log_p) == pytest.approx(min(1.0, *p))


@pytest.mark.parametrize(
    "changes",
    [{}, {"noise": AIR}, {"noise": {"process": 1.0, "delay": 2}}, {"run": {"pace": "realtime"}}],
    ids=["plain", "on the air", "delay", "real time"],
)
def test_stale_values(changes: dict[str, Any]) -> None:
    observation = seen(duration=10.0, **changes)
    sums, step = summed(observation, StaleValues), observation.step
    states, noise = observation.states, observation.prediction.experiment.noise
    heard = states if observation.published is None else observation.published
    score, information = np.zeros((5, 5)), np.zeros((5, 5))
    for k, g in enumerate(observation.modes.tolist()):
        for i in range(5):
            own = int(observation.timers.graphs[k, i]) if observation.timers else g
            used = {}
            for d, j in enumerate(step.neighbours(own, i).tolist()):
                if observation.timers:
                    used[j] = int(observation.timers.used[k, i, d])
                elif observation.lost is None or not observation.lost[k, i, d]:
                    used[j] = max(k - noise.delay, 0)
            parts = {j: step.nominal[own, i, j] * (heard[s, j] - states[k, i]) for j, s in used.items()}
            e = states[k + 1, i] - states[k, i] - np.sum([*parts.values(), np.zeros(2)], axis=0)
            variance = 0.05 + noise.link**2 * sum(step.nominal[own, i, j] ** 2 for j in used)
            for j, s in used.items():
                older = step.nominal[own, i, j] * (heard[max(s - 1, 0), j] - heard[s, j])
                score[i, j] += older @ e / variance
                information[i, j] += older @ older / variance
    assert sums.sums[0] == pytest.approx(score, abs=1e-9)
    assert sums.sums[1] == pytest.approx(information)
    links = information > 0.0
    p = stats.norm.sf(score[links] / np.sqrt(information[links])) * 2 * links.sum()
    common = stats.norm.sf(score.sum() / np.sqrt(information.sum())) * 2
    assert np.exp(sums.finding().log_p) == pytest.approx(min(1.0, common, *p))


@pytest.mark.parametrize("noise", [{"process": 1.0}, AIR, AIR | {"delay": 2}], ids=["plain", "on the air", "delay"])
def test_swapped_graphs(noise: dict[str, Any]) -> None:
    """Densities by a loop; with a delay and link noise, the steps that use x(0) say nothing."""
    observation = seen(duration=5.0, noise=noise)
    sums, step, states = summed(observation, SwappedGraphs), observation.step, observation.states
    heard = states if observation.published is None else observation.published
    delay = noise.get("delay", 0)
    density = np.zeros((2, 100))
    for g, k, i in np.ndindex(2, 100, 5):
        mean, variance = states[k, i].copy(), 0.05
        for d, j in enumerate(step.neighbours(g, i).tolist()):
            lost = (observation.used is not None and observation.used[k, i, d] < 0) or (
                observation.lost is not None and observation.lost[k, i, d]
            )
            if not lost:
                mean += step.nominal[g, i, j] * (heard[max(k - delay, 0), j] - states[k, i])
                variance += (step.link * step.nominal[g, i, j]) ** 2
        density[g, k] += stats.norm.logpdf(states[k + 1, i], mean, np.sqrt(variance)).sum() * (not delay or k > delay)
    every = np.arange(100)
    ratios = density[1 - observation.modes, every] - density[observation.modes, every]
    counts = Counter(level for level, _ in windows_of(100))
    mean = sum(np.exp(ratios[f : f + 2**level].sum()) / (7 * counts[level]) for level, f in windows_of(100))
    assert np.exp(sums.logarithms()[0, 0]) == pytest.approx(mean)
    assert np.exp(sums.logarithms()[1, 0]) == pytest.approx(whole := np.exp(ratios.sum()))
    assert np.exp(sums.finding().log_p) == pytest.approx(min(1.0, 2.0 / (mean + whole)))


def test_graphs_are_not_swapped_in_real_time() -> None:
    sums = summed(seen(run={"pace": "realtime"}), SwappedGraphs)
    assert (sums.finding(), sums.logarithms().size) == (None, 0)


def second_order(path: np.ndarray, size: int = 10**6) -> SecondOrder:
    """Of a path of graphs with the law ``FAST``, counted in blocks of so many steps."""
    step = SimpleNamespace(transition=np.array(FAST), modes=3, agents=1, switching=None)
    sums = SecondOrder(SimpleNamespace(step=step, noisy=np.ones(1, dtype=bool), apart=True, graphs="abc"))  # type: ignore[arg-type]
    for first in range(0, len(path), size):
        graphs = path[first : first + size + 1]
        sums.add(SimpleNamespace(graphs=graphs, analyses=Analyses(np.array([len(graphs)]))))  # type: ignore[arg-type]
    return sums


FAST = [[0.1, 0.6, 0.3], [0.3, 0.2, 0.5], [0.5, 0.3, 0.2]]


def test_second_order_by_a_loop_and_its_statistic_by_tables() -> None:
    path = chain_path(FAST, 30_000, 3)
    sums, tables, before = second_order(path, 50), np.zeros((3, 2, 3, 3)), None
    for k in range(1, len(path) - 1):
        entered = path[k] != path[k - 1]
        before = path[k - 1] if entered else before
        tables[before, int(not entered), path[k], path[k + 1]] += before is not None
    assert (sums.sums[0] == tables).all()
    total = dof = 0.0
    for g in range(3):  # of each graph a table of the next one, by the graph before, first and later steps apart
        rows = tables[[f for f in range(3) if f != g], :, g].reshape(4, 3)
        chi2, _, degrees, _ = stats.chi2_contingency(rows, lambda_="log-likelihood")
        total, dof = total + chi2, dof + degrees
    assert sums.finding().log_p == pytest.approx(stats.chi2.logsf(total, dof))


def test_second_order_of_right_chains() -> None:
    """200 paths; Kolmogorov-Smirnov at 1e-4, and the evidence passes 20 in 5 % at most (binomial at 1e-4)."""
    found = [second_order(chain_path(FAST, 600, seed)) for seed in range(200)]
    assert stats.kstest([np.exp(each.finding().log_p) for each in found], "uniform").pvalue > 1e-4
    passed = sum(np.exp(each.logarithms()).mean() >= 20.0 for each in found)
    assert passed <= stats.binom.isf(1e-4, 200, 0.05)


def test_replicas_by_a_loop() -> None:
    """Each residual on the sum of those of earlier replicas, by agent, and two replicas on each other."""
    observation = seen(duration=5.0, run={"replicas": 4})
    sums, white = summed(observation, Replicas), whitened(observation)
    score, information, pairs = np.zeros(5), np.zeros(5), np.zeros((4, 4))
    for step in white:
        for r in range(4):
            earlier = step[:, :r].sum(axis=1)
            score, information = score + step[:, r] * earlier, information + earlier**2
            pairs[r] += step[:, r] @ step
    assert sums.sums[0] == pytest.approx(score)
    assert sums.sums[1] == pytest.approx(information)
    assert sums.sums[3] == pytest.approx(pairs)
    z = [score / np.sqrt(information), score.sum() / np.sqrt(information.sum())]
    z.append([pairs[r, s] / np.sqrt(pairs[s, s]) for r in range(4) for s in range(r)])
    p = min(2.0 * stats.norm.sf(np.max(np.abs(each))) * np.size(each) * 3 for each in z)
    assert np.exp(sums.finding().log_p) == pytest.approx(min(1.0, p))


def test_intervals_are_possible_values() -> None:
    """Of a variance by the chi-square law, of shares within 0 and 1."""
    observation = seen(duration=0.5)
    found, white = summed(observation, NoiseByGraph).finding(), whitened(observation)
    at = observation.modes == found.graph
    squares = white[at] ** 2 if found.agent is None else white[at][:, found.agent] ** 2
    ends = squares.sum() / stats.chi2.ppf([0.975, 0.025], squares.size)
    assert found.interval == pytest.approx(tuple(ends))
    stale = summed(observation, StaleValues)
    stale.sums[2] = np.array(1000)
    assert 0.0 <= stale.finding().interval[0] <= stale.finding().interval[1] <= 1.0


def test_runs_are_merged() -> None:
    """The evidence of runs is multiplied where windows are looked at, sums are added up; places say in which run."""
    first, second = seen(1, 10.0), seen(2, 20.0)
    second.states[121, 1, 1] += 2.5
    pairs = [
        (summed(first, kind), summed(second, kind))
        for kind in (NoiseOverTime, ConstantState, LargestResidual, SwappedGraphs)
    ]
    for one, other in pairs:
        windows = 6 if isinstance(one, NoiseOverTime) else None  # the others are lags
        expected = (one.logarithms() + other.logarithms())[:windows]
        one.merge(other)
        assert one.logarithms()[:windows] == pytest.approx(expected)
    largest = pairs[2][0].finding()
    assert (largest.place.run, largest.place.first) == (2, 121)
    lags = [summed(each, LongLags) for each in (first, second)]
    products = lags[0].lags.score + lags[1].lags.score
    lags[0].merge(lags[1])
    assert (lags[0].lags.score == products).all()


WORDS = {
    "an agent stands still for 20 steps": r"agent 3 did not move from step ([\d,]+) to ([\d,]+), although it has noise",
    "names of the graphs swapped in 10 blocks of 20 steps": (
        r"the log has the names of the graphs line and ring swapped from step [\d,]+ to [\d,]+"
    ),
    "noise variance modulated by 30 %, period 1,000 steps": (
        r"the noise variance of all agents is .* times what the file says from step [\d,]+ to [\d,]+"
    ),
    "noise variance modulated by 30 %, period 10 steps": (
        r"the size of the noise of all agents has correlation .* with its own \d*[05] steps before, not 0: "
        "its variance changes in time"
    ),
    "noise variance from 0.7 to 1.3 over the run": (
        r"the noise variance of all agents is .* times what the file says from step [\d,]+ to [\d,]+"
    ),
    "noise variance 1.1 in one graph, 0.9 in the other": (
        r"the noise variance of all agents in graph (line|ring) is (1\.1|0\.9|0\.8)\S* \(.*\) times what the file says"
    ),
    "correlation 0.05 of each agent's noise at lag 20": (
        r"the noise of all agents has correlation 0\.0[45]\S* \(.*\) with its own 20 steps before, not 0"
    ),
    "gamma holding periods of shape 10": (
        r"the probability of leaving graph (line|ring) depends on how long it has lasted: it is .*, not 0.0476"
    ),
    "one innovation of 8 standard deviations": r"agent 4's noise is 8 standard deviations in step [\d,]+",
    "stale values in one message of five": (
        r"(1\d|2\d)\S* % \(.*\) of the values that agents use are one step older than the log says"
    ),
}


@pytest.mark.parametrize("fault", WORDS)
def test_a_fault_is_found_and_named(fault: str) -> None:
    """Fixed seed; of 25 runs with other seeds all were found and named (docs/calibration.md)."""
    result = departures.one_run(fault, 16, 101)
    assert result.verdict == "disagrees"
    assert result.any_time.exceeded
    first = result.causes[0]
    assert first.kind == departures.FAULTS[fault][1]
    assert re.fullmatch(WORDS[fault], first.words), first.words
    stretch = first.kind == "noise" and first.graph is None and "steps before" not in first.words
    in_time = stretch or first.kind in ("frozen", "graph", "outlier")
    steps = first.steps
    assert (steps is not None) == in_time
    assert steps is None or all(f"{step:,}" in first.words for step in steps)
