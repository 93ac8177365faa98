"""The filter of a hidden path against all paths one by one, and the equations of the moments by scipy."""

import runpy
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from scipy.special import ndtri
from scipy.stats import multivariate_normal, norm

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.hidden_path import HiddenFilter, hidden_system_error
from msg_analysis.inference.innovations import Variance
from msg_analysis.inference.intervals import interval_law
from msg_analysis.model.log import Log

SCRIPT = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks/foreign_logs.py"))
Kind, draw, judge = (SCRIPT[name] for name in ("Kind", "simulate", "judge"))
LAW = {
    "name": "three",
    "graphs": {"path": {"path": [1, 2, 3]}, "pair": {"edges": [[1, 3]]}},
    "switching": {"generator": [[-2.0, 2.0], [3.0, -3.0]]},
    "noise": {"process": [1.0, 0.5, 2.0]},
    "run": {"dt": 0.1},
}
Z = np.array([[[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]], [[1.0, 0, -1], [0, 0, 0], [-1, 0, 1]]])
Q = np.diag([1.0, 0.25, 4.0])
GENERATOR = np.array(LAW["switching"]["generator"])
STATIONARY = np.array([0.6, 0.4])


def law(**changes: Any) -> Experiment:
    return Experiment.parse({**LAW, **changes})


def steps_density(values: np.ndarray, rates: float = 1.0) -> float:
    """Logarithm of the density of the states after the first, summed over all paths of the graphs."""
    change = scipy.linalg.expm(GENERATOR * rates * 0.1)
    total = 0.0
    for path in product((0, 1), repeat=len(values) - 1):
        p = STATIONARY[path[0]]
        for k, g in enumerate(path):
            p *= change[path[k - 1], g] if k else 1.0
            p *= multivariate_normal.pdf(values[k + 1], (np.eye(3) - 0.1 * Z[g]) @ values[k], 0.1 * Q)
        total += p
    return float(np.log(total))


def test_with_exact_states_of_steps_the_density_is_that_of_all_paths() -> None:
    """Nothing is approximated there, and the scores are its slopes."""
    values = 0.5 * np.cumsum(np.random.default_rng(1).normal(size=(8, 3)), axis=0)
    of = HiddenFilter(interval_law(law(), "steps"), 0.1 * np.arange(8), values[:, :, None])
    found = of.run(np.zeros(3))
    constant = 7 * 1.5 * np.log(2 * np.pi)
    assert found.log_likelihood == pytest.approx(steps_density(values) + constant, abs=1e-9)
    slope = (steps_density(values, 1.001) - steps_density(values, 0.999)) / 0.002
    assert found.score[found.variances.index(Variance("switching"))] == pytest.approx(slope, rel=1e-4)


def test_values_become_normal_by_their_distribution_functions() -> None:
    values = np.array([[3.0, -4.0, 5.0], [2.0, -2.5, 4.5]])
    found = HiddenFilter(interval_law(law(), "steps"), np.array([0.0, 0.1]), values[:, :, None]).run(np.zeros(3))
    means, deviations = values[0] - 0.1 * Z @ values[0], np.sqrt(0.1 * np.diag(Q))
    weights = STATIONARY.copy()
    for i in range(3):
        below = weights @ norm.cdf(values[1, i], means[:, i], deviations[i])
        own = STATIONARY @ norm.cdf(values[1, i], means[:, i], deviations[i])
        assert found.white[1, i, 0] == pytest.approx(ndtri(below), abs=1e-9)
        assert found.marginal[1, i, 0] == pytest.approx(ndtri(own), abs=1e-9)
        weights = weights * norm.pdf(values[1, i], means[:, i], deviations[i])
        weights /= weights.sum()


def moments(times: np.ndarray, first: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(T, 2, 3, 3): E[x x^T; graph] by the linear differential equations of the jump system."""
    eye = np.eye(3)
    drift = scipy.linalg.block_diag(*(-(np.kron(z, eye) + np.kron(eye, z)) for z in Z))
    drift += np.kron(GENERATOR.T, np.eye(9))
    noise = np.zeros((18, 2))
    noise[:9, 0], noise[9:, 1] = Q.reshape(-1), Q.reshape(-1)
    whole = np.block([[drift, noise], [np.zeros((2, 18)), GENERATOR.T]])
    start = np.concatenate([*(share * (np.outer(first, first) + covariance).reshape(-1) for share in STATIONARY)])
    start = np.concatenate([start, STATIONARY])
    return np.array([(scipy.linalg.expm(whole * t) @ start)[:18].reshape(2, 3, 3) for t in times])


@pytest.mark.parametrize("between", [0.1, 1.5])
def test_between_samples_the_moments_are_those_of_the_jump_system(between: float) -> None:
    values = np.full((2, 3, 1), np.nan)
    values[0, :, 0] = first = 3.0, -4.0, 5.0
    times = np.array([0.0, between])
    of = HiddenFilter(interval_law(law(), "continuous"), times, values)
    found = of.run(np.full(3, 0.3), variances=False, keep=True)
    wanted = moments(times[1:], np.array(first) - 3.0, 0.09 * np.eye(3))[0]  # less the median
    assert found.moments is not None
    np.testing.assert_allclose(found.moments[1], wanted, atol=0.01 * np.abs(wanted).max())


def test_the_expected_error_is_that_over_all_paths() -> None:
    rng, times = np.random.default_rng(3), 0.2 * np.arange(40)
    values = np.cumsum(rng.normal(size=(40, 3, 1)), axis=0)
    of = HiddenFilter(interval_law(law(), "continuous"), times, values)
    error = hidden_system_error(of, of.run(np.full(3, 0.3), variances=False, keep=True))
    form = np.eye(3) - 1.0 / 3.0
    wanted = np.einsum("tgij,ij->t", moments(times, of.values[0, :, 0], 0.09 * np.eye(3)), form).mean()
    assert error is not None
    assert error.predicted == pytest.approx(wanted, rel=1e-2)


def test_right_logs_agree_and_the_wrong_ones_do_not() -> None:
    """Of 6 right logs none is rejected, with a false-alarm rate of 1 % each; seeds are fixed."""
    assert not any(judge(Kind(hidden=True), 400, seed)[0] for seed in range(6))
    causes = judge(Kind(hidden=True, louder=2.0), 1000, 1)[1]
    assert causes[0][1].startswith("agent 2's noise variance is")
    causes = judge(Kind(hidden=True, period=0.5, r=0.0, faster=4.0), 2000, 2)[1]
    assert causes[0][1].startswith("the hidden graphs seem to switch")


def test_two_coordinates_late_agents_and_steps() -> None:
    times, states, _, _ = draw(Kind(), 300, np.random.default_rng(4))
    other = draw(Kind(), 300, np.random.default_rng(5))[1]
    states[:50, 1], states[100] = np.nan, np.nan
    both = np.stack([states, other], axis=2)
    both[np.isnan(both).any(axis=2)] = np.nan
    log = Log.from_arrays(times, both, law=Kind().law(), graph="hidden", measurement_noise=0.1)
    found = HiddenFilter(interval_law(log.law, "continuous"), times, both).run(np.full(5, 0.1))
    assert np.isnan(found.white[:51, 1]).all()
    assert np.nanmax(np.abs(found.white)) < 5
    assert "hidden graphs" in repr(log)
    assert log.compare().to_json()["hidden"]


def test_of_many_graphs_the_error_alone_is_tested() -> None:
    agents = range(1, 19)
    graphs = {f"g{k}": {"path": [k, *(j for j in agents if j != k)]} for k in agents}
    many = Experiment.parse(
        {"name": "many", "graphs": graphs, "switching": {"generator": np.full((18, 18), 1.0) - 18.0 * np.eye(18)}}
    )
    rng = np.random.default_rng(1)
    states = rng.normal(size=(500, 18)) * 10.0
    found = Log.from_arrays(np.arange(500.0), states, law=many, graph="hidden", measurement_noise=0.1).compare()
    assert [test.name for test in found.tests] == ["system error"]
    assert found.verdict == "disagrees"
    assert "18 hidden graphs" in found.untested[0]
    assert found.system_error is not None
    assert found.system_error.measured == pytest.approx(17 * 100, rel=0.05)
    assert found.system_error.predicted == pytest.approx(many.predict().continuous.system_error)
    with pytest.raises(InputError, match=r"estimate: the path of 18 hidden graphs.*expected standard deviations"):
        Log.from_arrays(np.arange(500.0), states, law=many, graph="hidden", measurement_noise="estimate").compare()
    with pytest.raises(InputError, match="expected states that move"):
        Log.from_arrays(np.arange(500.0), 0 * states, law=many, graph="hidden", measurement_noise=0.1).compare()


def test_a_given_sequence_is_not_hidden() -> None:
    given = law(switching={"schedule": [[0, "path"], [1, "pair"]]})
    log = Log.from_arrays(np.arange(60.0), np.zeros((60, 3)), law=given, graph="hidden", measurement_noise=0.1)
    with pytest.raises(InputError, match="given sequence of graphs is not hidden"):
        log.compare()
