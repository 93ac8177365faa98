"""Autocovariances of a log given its path: sums by brute force, many states of one path, correct and faulty runs."""

from typing import Any

import numpy as np
import pytest
import scipy.stats

from experiments import Experiment, Observation, line_ring, observed, predict
from msg_analysis.inference.autocovariance import LoggedAutocovariance, logged_autocovariance, why_not_tested
from msg_analysis.inference.given_path import means_given_path

LAGS = np.array([0, 1, 2, 5, 9])
LONG_LAGS = np.array([0, 1, 2, 3, 6, 10, 19, 33, 60])  # those of runs of 600 steps


def steps(noise: dict[str, Any] | None = None, **changes: Any) -> Experiment:
    """Five agents, 1200 steps."""
    run = {"duration": 60, "seed": 1} | changes.pop("run", {})
    return line_ring(5, 0.5, noise=noise or {"process": 1.0}, run=run, **changes)


def found(observation: Observation, lags: np.ndarray | None = None) -> LoggedAutocovariance:
    result = logged_autocovariance(observation, lags)
    assert result is not None
    return result


def test_measured_is_the_mean_product() -> None:
    run = observed(steps())
    errors = run.states - run.states.mean(axis=1, keepdims=True)
    result = found(run, LAGS)
    for lag, measured in zip(LAGS.tolist(), result.measured, strict=True):
        products = (errors[lag:] * errors[: len(errors) - lag]).sum(axis=1)
        assert measured == pytest.approx(products.mean(), rel=1e-10)
    assert result.times == pytest.approx(LAGS * 0.05)


def test_lag_0_is_the_system_error_given_the_path() -> None:
    """Of ``means_given_path``, which counts one step less."""
    run = observed(steps({"process": 1.0, "loss": 0.2, "link": 0.3}, run={"duration": 500}))
    means, result = means_given_path(run), found(run, LAGS)
    assert result.expected[0] == pytest.approx(float(means.trace @ means.predicted), rel=1e-3)
    variance = float(means.trace @ means.covariance @ means.trace)
    assert result.covariance[0, 0] == pytest.approx(variance, rel=5e-3)


@pytest.mark.parametrize(
    "noise",
    [
        {"process": 1.0},
        {"process": 1.0, "loss": 0.3, "link": 0.5},
        {"process": 1.0, "delay": 2},
        {"process": 1.0, "delay": 3, "link": 0.5, "broadcast": 0.3},
    ],
)
def test_many_states_of_one_path(noise: dict[str, Any]) -> None:
    """3000 replicas of one path: mean and covariance of the sums are the stated ones, 4.5 standard errors allowed."""
    run = observed(steps(run={"duration": 4, "replicas": 3000, "start": [1, 0, -2, 0, 3]}, noise=noise))
    result = found(run, LAGS)
    assert np.abs((result.measured - result.expected) / result.standard_errors).max() < 4.5
    first = noise.get("delay", -1) + 1 if "link" in noise else 0  # noisy and late: step d + 1
    states = run.states[first : first + result.steps + 1]
    errors = states - states.mean(axis=1, keepdims=True)
    means = np.array([(errors[lag:] * errors[: len(errors) - lag]).sum(axis=1).mean(axis=0) for lag in LAGS.tolist()])
    start = run.states[max(first - 3, 0) : first + 1].reshape(-1, run.replicas)
    basis = np.vstack([np.ones(run.replicas), start[1:] - start[0]])
    known = (basis[:, None] * basis).reshape(-1, run.replicas).T  # the expectation is quadratic in these states
    fit, _, rank, _ = np.linalg.lstsq(known, means.T)
    scatter = np.cov(means - (known @ fit).T) / (run.replicas - rank)
    assert result.covariance == pytest.approx(scatter, rel=0.15)


@pytest.mark.parametrize(
    "noise",
    [
        {"process": 1.0},
        {"process": 1.0, "loss": 0.2, "broadcast": 0.3},
        {"process": 0.3, "delay": 4, "link": 2.0, "broadcast": 0.3},
    ],
)
def test_p_values_of_correct_runs_are_uniform(noise: dict[str, Any]) -> None:
    """60 runs; Kolmogorov and Smirnov at 0.1 %: so often it fails with another seed."""
    # A replica costs next to nothing, a step much: 150 steps of 16 replicas are as many numbers as 1,200 of 2.
    experiment = steps(noise=noise, run={"duration": 7.5, "replicas": 16})
    prediction = predict(experiment)
    values = [found(observed(experiment.with_run(seed=seed), prediction), LONG_LAGS).p for seed in range(60)]
    assert scipy.stats.kstest(values, "uniform").pvalue > 0.001


def test_faulty_runs() -> None:
    """Gains a third smaller, and noise a fifth larger, than the law says."""
    prediction = predict(steps(run={"duration": 400}))
    slow = {"line": {"edges": [[i, i + 1, 0.67] for i in range(1, 5)]}}
    slow["ring"] = {"edges": [*slow["line"]["edges"], [5, 1, 0.67]]}
    weak = found(observed(steps(run={"duration": 400}, graphs=slow), prediction))
    assert weak.p < 1e-6
    loud = found(observed(steps(run={"duration": 400}, noise={"process": 1.2}), prediction))
    assert loud.p < 1e-6


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, "None"),
        ({"noise": {"delay": 1}}, "None"),
        ({"run": {"duration": 4}}, "too few"),
        ({"run": {"pace": "realtime"}}, "real time"),
        ({"noise": {"delay": 1, "loss": 0.1}}, "come later"),
        ({"noise": {"loss": 0.1, "on_loss": "hold"}}, "keep values"),
    ],
)
def test_what_is_not_tested(changes: dict[str, Any], why: str) -> None:
    assert why in str(why_not_tested(observed(steps(**changes))))


def test_long_runs_are_tested_in_part_and_those_without_noise_not_at_all() -> None:
    assert logged_autocovariance(observed(steps()), LAGS, most_numbers=5 * 4 * 4 * 300).steps == 300
    assert found(observed(steps({"process": 0.0}, run={"start": [1, 2, 3, 4, 5]}))).p is None
