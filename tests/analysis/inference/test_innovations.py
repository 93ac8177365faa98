"""Innovations of logs against the normal density of the whole log, scipy's exponentials, and the residuals of a run."""

import runpy
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from experiments import compare, line_ring, simulate
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.innovations import Filter, Variance, estimate_noise
from msg_analysis.inference.intervals import ContinuousLaw, StepsLaw, interval_law
from msg_analysis.model.log import Log

SCRIPT = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks/foreign_logs.py"))
KINDS, FAULTS, Kind, draw, judge = (SCRIPT[name] for name in ("KINDS", "FAULTS", "Kind", "simulate", "judge"))
NOISE = [1.0, 0.8, 1.2, 1.0, 0.9]
STARTS, GRAPHS = np.array([-1.0, 3.3, 4.1, 4.15, 9.0, 14.0]), np.array([0, 1, 0, 1, 0, 1])
R = 0.3


def van_loan(z: np.ndarray, q: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    m = len(z)
    found = scipy.linalg.expm(np.block([[z, q], [np.zeros((m, m)), -z.T]]) * length)
    return found[m:, m:].T, found[m:, m:].T @ found[:m, m:]


@pytest.mark.parametrize("directed", [False, True])
def test_the_matrices_of_a_stretch_are_those_of_scipy(directed: bool) -> None:
    law = ContinuousLaw(replace(Kind(), directed=directed).law())
    for graph in (0, 1):
        for length in (1e-3, 0.3, 1.0):  # of longer ones those of Van Loan have fewer digits
            phi, q, parts = law.over(graph, np.array([length, 2 * length]))
            for place, s in enumerate((length, 2 * length)):
                wanted = van_loan(-law.drift(graph), law.noise[graph], s)
                np.testing.assert_allclose(phi[place], wanted[0], atol=1e-12)
                np.testing.assert_allclose(q[place], wanted[1], atol=1e-10)
                np.testing.assert_allclose(parts[place].sum(axis=0), wanted[1], atol=1e-10)


@pytest.fixture(scope="module")
def small() -> tuple[np.ndarray, np.ndarray]:
    """Irregular times, switches inside the intervals, missing values and a sample without any."""
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(0, 20, 40))
    states = np.cumsum(rng.normal(size=(40, 5)), axis=0)
    states[5, 2], states[9], states[20, :3] = np.nan, np.nan, np.nan
    return times, states


def likelihood(small: tuple[np.ndarray, np.ndarray], law: Any, noise: np.ndarray) -> tuple[float, np.ndarray]:
    """Logarithm of the density of all values but the first, given the first, and the whitened values."""
    (times, states), m = small, 5
    count = len(times)
    covariance, mean, x = np.zeros((count * m, count * m)), [states[0]], states[0]
    covariance[:m, :m] = np.diag(noise**2)
    for k in range(count - 1):
        inside = [float(start) for start in STARTS if times[k] < start < times[k + 1]]
        cuts = [float(times[k]), *inside, float(times[k + 1])]
        phi, q = np.eye(m), np.zeros((m, m))
        for begin, end in pairwise(cuts):
            g = GRAPHS[np.flatnonzero(begin >= STARTS)[-1]]
            one, more = van_loan(-law.drift(g), law.noise[g], end - begin)
            phi, q = one @ phi, one @ q @ one.T + more
        old, new = slice(k * m, (k + 1) * m), slice((k + 1) * m, (k + 2) * m)
        x = phi @ x
        mean.append(x)
        covariance[new, : new.start] = phi @ covariance[old, : new.start]
        covariance[: new.start, new] = covariance[new, : new.start].T
        covariance[new, new] = phi @ covariance[old, old] @ phi.T + q
    y = states[1:].reshape(-1)
    there = ~np.isnan(y)
    whole = (covariance[m:, m:] + np.diag(np.tile(noise**2, count - 1)))[np.ix_(there, there)]
    root = np.linalg.cholesky(whole)
    z = scipy.linalg.solve_triangular(root, y[there] - np.array(mean)[1:].reshape(-1)[there], lower=True)
    return -float(np.log(np.diag(root)).sum() + 0.5 * z @ z), z


def test_innovations_and_scores_are_those_of_the_density_of_the_whole_log(small: Any) -> None:
    experiment, noise = Kind().law(), np.full(5, R)
    law = ContinuousLaw(experiment)
    found = Filter(law, small[0], small[1][:, :, None], STARTS, GRAPHS).run(noise, terms=law.terms())
    density, z = likelihood(small, law, noise)
    white = found.white[1:].reshape(-1)
    np.testing.assert_allclose(white[~np.isnan(white)], z, atol=1e-10)
    assert found.log_likelihood == pytest.approx(density, rel=1e-10)
    h = 1e-5
    for place, one in enumerate(found.variances):

        def at(change: float, one: Variance = one) -> float:
            gains, r = np.array(NOISE), noise.copy()
            if one.kind == "process":
                gains[one.agent] *= np.exp(change / 2)
            else:
                r[slice(None) if one.agent is None else one.agent] *= np.exp(change / 2)
            return likelihood(small, ContinuousLaw(experiment.with_noise(process=gains.tolist())), r)[0]

        slope = (at(h) - at(-h)) / (2 * h)
        assert found.score[len(found.terms) + place] == pytest.approx(slope, rel=1e-5), one


def test_scores_of_gains_without_measurement_noise_are_slopes(small: Any) -> None:
    """Of the sum of squares of the innovations, normalised as the law says, by the weight of each link."""
    law = ContinuousLaw(Kind().law())
    times, states = small[0], np.nan_to_num(small[1])
    found = Filter(law, times, states[:, :, None], STARTS, GRAPHS).run(np.zeros(5), terms=law.terms())
    cuts = np.unique(np.concatenate([times, STARTS[times[0] < STARTS]]))
    which = [GRAPHS[np.flatnonzero(cut >= STARTS)[-1]] for cut in cuts[:-1]]

    def half_square(term: Any, change: float) -> float:
        total = 0.0
        for k in range(len(times) - 1):
            x, q = states[k], np.zeros((5, 5))
            for g, begin, end in zip(which, cuts[:-1], cuts[1:], strict=True):
                if not times[k] <= begin < times[k + 1]:
                    continue
                z = -law.drift(g).copy()
                if g == term.graph:
                    z[term.agent, term.agent] += change
                    z[term.agent, term.sender] -= change
                phi, more = van_loan(-law.drift(g), law.noise[g], end - begin)
                x, q = scipy.linalg.expm(-z * (end - begin)) @ x, phi @ q @ phi.T + more
            e = states[k + 1] - x
            total += 0.5 * e @ np.linalg.solve(q, e)
        return total

    for place in (5, 9, len(found.terms) - 1):
        term, h = found.terms[place], 1e-5
        slope = -(half_square(term, h) - half_square(term, -h)) / (2 * h)
        assert found.score[place] == pytest.approx(slope, rel=2e-3), term  # nodes of a quadrature


@pytest.mark.parametrize("tracking", [False, True])
def test_with_the_law_of_the_steps_the_numbers_are_those_of_a_run(tracking: bool) -> None:
    more: dict[str, Any] = {"problem": "tracking", "leaders": {"agents": [2], "reference": 3.0}} if tracking else {}
    run = simulate(line_ring(5, 0.5, run={"dt": 0.05, "duration": 100, "seed": 3}, **more))
    law, wanted = run.experiment, compare(run)
    names = [law.graph_list[mode].name for mode in run.modes]
    log = Log.from_arrays(run.times, run.values, law=law, graph=(run.times[:-1], names), sampled_law="steps")
    found = log.compare()
    p = {test.name: test.p for test in found.tests}
    residuals = wanted.innovations
    assert p["innovations: covariance"] == pytest.approx(residuals.p_covariance, abs=1e-9)
    assert p["innovations: whiteness"] == pytest.approx(residuals.p_whiteness, abs=1e-9)
    assert p["innovations: gains"] == pytest.approx(residuals.p_gain, abs=1e-9)
    assert p["innovations: common gain"] == pytest.approx(residuals.p_common_gain, abs=1e-9)
    largest = next(test.p for test in wanted.tests if test.name == "residuals: largest")
    assert p["innovations: largest"] == pytest.approx(largest, abs=1e-9)
    assert wanted.switching is not None
    assert p["switching"] == pytest.approx(wanted.switching.p, abs=1e-9)
    np.testing.assert_allclose(found.ratios, residuals.ratios, atol=1e-9)
    # The errors of a run are those of x(0), ..., x(N - 1).
    error = Log.from_arrays(
        run.times[:-1], run.values[:-1], law=law, graph=(run.times[:-1], names), sampled_law="steps"
    ).compare()
    assert wanted.given is not None
    given = wanted.given.given
    assert error.system_error is not None
    spread = np.sqrt(given.trace @ given.covariance @ given.trace)
    assert error.system_error.measured == pytest.approx(given.trace @ given.measured, rel=1e-9)
    assert error.system_error.predicted == pytest.approx(given.trace @ given.predicted, rel=1e-9)
    assert error.system_error.standard_error == pytest.approx(spread, rel=1e-9)


@pytest.mark.parametrize(("irregular", "said"), [(False, False), (True, True)])
def test_irregular_stamps_are_said(irregular: bool, said: bool) -> None:
    kind = replace(Kind(), irregular=irregular)
    times, states, starts, names = draw(kind, 200, np.random.default_rng(8))
    log = Log.from_arrays(times, states, law=kind.law(), graph=(starts, names), measurement_noise=kind.r)
    assert any("stamps are taken to be the true times" in each for each in log.compare().approximate) is said


def test_a_late_agent_and_one_coordinate_more() -> None:
    """Two coordinates are two logs; an agent that comes late is known by its first value only."""
    times, states, starts, names = draw(Kind(), 300, np.random.default_rng(4))
    other = draw(Kind(), 300, np.random.default_rng(5))[1]
    law = ContinuousLaw(Kind().law())
    graphs = np.array([("line", "ring").index(name) for name in names])
    noise = np.full(5, 0.1)

    def of(*several: np.ndarray) -> Any:
        return Filter(law, times, np.stack(several, axis=2), starts, graphs).run(noise, terms=law.terms())

    both, one, two = of(states, other), of(states), of(other)
    np.testing.assert_allclose(both.score, one.score + two.score, rtol=1e-8, atol=1e-8)
    assert both.log_likelihood == pytest.approx(one.log_likelihood + two.log_likelihood)
    states[:50, 1] = np.nan
    late = of(states)
    assert np.isnan(late.white[:51, 1]).all()
    assert np.abs(late.white[51:, 1]).max() < 5
    far = of(states + 4e6)
    np.testing.assert_allclose(far.white, late.white, atol=1e-5)


def test_measurement_noise_is_estimated() -> None:
    """At the largest likelihood, as a search on a grid finds it; and 0 where there is none."""
    times, states, starts, names = draw(Kind(r=0.2), 500, np.random.default_rng(6))
    graphs = np.array([("line", "ring").index(name) for name in names])
    law = ContinuousLaw(Kind().law())
    filter_ = Filter(law, times, states[:, :, None], starts, graphs)
    value, error = estimate_noise(filter_, 10_000)
    grid = np.linspace(value - 0.01, value + 0.01, 41)
    best = max(grid, key=lambda r: filter_.run(np.full(5, r), variances=False).log_likelihood)
    assert value == pytest.approx(best, abs=3e-4)
    assert 0.002 < error < 0.02
    exact = draw(Kind(r=0.0, period=0.5), 300, np.random.default_rng(7))
    graphs = np.array([("line", "ring").index(name) for name in exact[3]])
    none, scale = estimate_noise(Filter(law, exact[0], exact[1][:, :, None], exact[2], graphs), 10_000)
    assert none < 2.5 * scale


@pytest.mark.parametrize("name", list(KINDS))
def test_right_logs_agree(name: str) -> None:
    """False-alarm rate at level 1 %: at least 2 of 6 in 0.15 % of the cases."""
    rejected = [judge(KINDS[name], 500, seed)[0] for seed in range(6)]
    assert sum(map(bool, rejected)) <= 1, rejected


@pytest.mark.parametrize("name", list(FAULTS))
def test_faults_are_found_and_named(name: str) -> None:
    changes, cause = FAULTS[name]
    samples = 8000 if name == "noise x 1.1" else 3000
    _, causes, _ = judge(replace(Kind(), **changes), samples, 3)
    assert causes[0][0] == cause, causes


def test_a_leader_that_is_held_must_be_there() -> None:
    kind = Kind(r=0.0, leaders={"agents": [3], "gain": "inf", "reference": 2.0})
    law = kind.law()
    times, states, starts, names = draw(Kind(r=0.0), 200, np.random.default_rng(8))
    states[:, 2] = 2.0
    log = Log.from_arrays(times, states, law=law, graph=(starts, names))
    assert "held leader" not in [test.name for test in log.compare().tests]
    states[100, 2] += 1e-3
    found = Log.from_arrays(times, states, law=law, graph=(starts, names)).compare()
    assert found.verdict == "disagrees"
    assert "agent 3 is held at the reference by the law, but 0.001 away at 10" in found.causes[0].words


def test_a_jump_of_one_value() -> None:
    times, states, starts, names = draw(Kind(), 500, np.random.default_rng(9))
    states[200, 3] += 3.0
    found = Log.from_arrays(times, states, law=Kind().law(), graph=(starts, names), measurement_noise=0.1).compare()
    assert found.verdict == "disagrees"
    assert "innovations: largest" in [test.name for test in found.tests if test.rejected]


def document(**more: Any) -> Experiment:
    return line_ring(5, 0.5, **more)


@pytest.mark.parametrize(
    ("law", "sampled", "message"),
    [
        (document(noise={"loss": 0.1}), "continuous", r"noise\.loss: a log of states does not say"),
        (document(noise={"delay": 1, "link": 0.1}), "steps", r"noise\.link, noise\.delay"),
    ],
)
def test_laws_that_a_log_says_nothing_about_are_refused(law: Experiment, sampled: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        interval_law(law, sampled)


def test_samples_between_the_steps_are_refused() -> None:
    law = StepsLaw(document())
    with pytest.raises(InputError, match=r"the sample at 0\.13 is 2\.6 steps of 0\.05"):
        law.stretches(np.array([0.0, 0.05, 0.13]), np.array([0.0]), np.array([0]))


GOOD: dict[str, Any] = {"times": np.arange(60.0), "states": np.zeros((60, 5)), "graph": "line"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": np.arange(60.0)[::-1]}, "expected at least two finite numbers that ascend"),
        ({"states": np.zeros((60, 4))}, r"expected \(N,\) and \(N, 5\)"),
        ({"states": np.full((60, 5), np.inf)}, r"states: up to inf: expected at most 1e\+15"),
        ({"states": [["a"] * 5] * 60}, "states: expected numbers"),
        ({"graph": None}, "expected which of line, ring was there when"),
        ({"graph": "star"}, "graph: star: expected one of line, ring"),
        ({"graph": ([0.0, 1.0], ["line"])}, "expected one for each graph, ascending"),
        ({"graph": ([99.0], ["line"])}, "are the clocks the same"),
        ({"measurement_noise": -1.0}, r"expected a number from 0 to 1e\+15, 5 of them, or 'estimate'"),
        ({"measurement_noise": "yes"}, "expected a number >= 0 or 'estimate'"),
    ],
)
def test_mistakes_in_arrays(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Log.from_arrays(law=document(), **{**GOOD, **changes})


@pytest.mark.parametrize(
    ("agents", "noise", "message"),
    [
        ((), [1.0, 1.0, 1.0, 1.0, 0.0], "without any noise"),
        ((1,), 1.0, "agent 2: no value in the log"),
    ],
)
def test_logs_that_nothing_can_be_said_of(agents: Sequence[int], noise: Any, message: str) -> None:
    states = np.random.default_rng(1).normal(size=(60, 5))
    states[:, list(agents)] = np.nan
    arcs = {"chain": {"arcs": [[5, 4], [4, 3], [3, 2], [2, 1]]}}  # nothing moves agent 5 but its noise
    law = Experiment.parse({"name": "chain", "graphs": arcs, "noise": {"process": noise}})
    with pytest.raises(InputError, match=message):
        Log.from_arrays(np.arange(60.0), states, law=law).compare()


def test_data_frames() -> None:
    pandas = pytest.importorskip("pandas")
    times, states, starts, names = draw(Kind(), 200, np.random.default_rng(9))
    columns = {"time": times} | {f"x{i + 1}": states[:, i] for i in range(5)}
    columns["graph"] = [names[np.flatnonzero(starts <= t)[-1]] for t in times]
    log = Log.from_dataframe(pandas.DataFrame(columns), law=Kind().law(), measurement_noise=0.1)
    assert np.array_equal(log.states[:, :, 0], states)
    assert len(log.starts) <= len(starts)
    with pytest.raises(InputError, match="expected one of 5, x5, agent_5"):
        Log.from_dataframe(pandas.DataFrame(columns).drop(columns="x5"), law=Kind().law())


@pytest.mark.parametrize("kind", [ContinuousLaw, StepsLaw])
def test_a_law_with_changed_gains_is_that_of_another_file(kind: type[ContinuousLaw] | type[StepsLaw]) -> None:
    """Without edge 2-3: by its terms, and as a file says it."""
    law = kind(document())
    terms = law.terms()
    gone = np.array([-term.weight if {term.agent, term.sender} == {1, 2} else 0.0 for term in terms])
    graphs = {"line": {"edges": [[1, 2], [3, 4], [4, 5]]}, "ring": {"edges": [[1, 2], [3, 4], [4, 5], [5, 1]]}}
    changed, wanted = law.changed(terms, gone), kind(document(graphs=graphs))
    for graph in (0, 1):
        for found, other in zip(changed.over(graph, np.ones(1)), wanted.over(graph, np.ones(1)), strict=True):
            np.testing.assert_allclose(found, other, atol=1e-12)
