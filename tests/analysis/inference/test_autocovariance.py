"""Autocovariances of a log given its path: sums by brute force, many states of one path, correct and faulty runs."""

from typing import Any

import numpy as np
import pytest
import scipy.stats

from experiments import Experiment, Observation, line_ring, observed, predict
from msg_analysis.inference import autocovariance
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
    run = observed(steps(run={"duration": 10, "replicas": 3000, "start": [1, 0, -2, 0, 3]}, noise=noise))
    result = found(run, LAGS)
    assert np.abs((result.measured - result.expected) / result.standard_errors).max() < 4.5
    states = run.states[: result.steps + 1]
    errors = states - states.mean(axis=1, keepdims=True)
    means = np.array([(errors[lag:] * errors[: len(errors) - lag]).sum(axis=1).mean(axis=0) for lag in LAGS.tolist()])
    scatter = np.cov(means) / run.replicas
    assert result.covariance == pytest.approx(scatter, rel=0.15)


def test_windows_are_products() -> None:
    along = np.random.default_rng(1).normal(size=(17, 3, 3))
    for lag in (0, 1, 2, 5, 16, 17):
        windows = autocovariance._windows(along, lag)
        assert len(windows) == 18 - lag
        for k, window in enumerate(windows):
            expected = np.eye(3)
            for matrix in along[k : k + lag]:
                expected = matrix @ expected
            assert window == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    "noise",
    [{"process": 1.0}, {"process": 1.0, "loss": 0.2, "broadcast": 0.3}, {"process": 1.0, "delay": 2, "link": 0.3}],
)
def test_p_values_of_correct_runs_are_uniform(noise: dict[str, Any]) -> None:
    """60 runs; Kolmogorov and Smirnov at 0.1 %: so often it fails with another seed.

    A replica costs next to nothing, a step much: 300 steps of 8 replicas are as many numbers as 1,200 of 2.
    """
    experiment = steps(noise=noise, run={"duration": 15, "replicas": 8})
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


def test_long_runs_are_tested_in_part() -> None:
    assert logged_autocovariance(observed(steps()), LAGS, most_numbers=5 * 4 * 4 * 300).steps == 300


def test_what_is_not_tested() -> None:
    assert why_not_tested(observed(steps())) is None
    assert "too few" in str(why_not_tested(observed(steps(run={"duration": 4}))))
    assert "real time" in str(why_not_tested(observed(steps(run={"pace": "realtime"}))))
    assert why_not_tested(observed(steps(noise={"process": 1.0, "delay": 1}))) is None
    both, held = {"delay": 1, "loss": 0.1}, {"loss": 0.1, "on_loss": "hold"}
    assert "come later" in str(why_not_tested(observed(steps(noise={"process": 1.0, **both}))))
    assert "keep values" in str(why_not_tested(observed(steps(noise={"process": 1.0, **held}))))


def test_without_noise_there_is_no_p() -> None:
    quiet = {"name": "q", "graphs": {"ring": {"cycle": [1, 2, 3]}}, "noise": {"process": 0.0}}
    run = {"duration": 10, "start": [1, 2, 3]}
    assert found(observed(Experiment.parse(quiet | {"run": run}))).p is None
