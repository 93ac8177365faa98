"""Time means against plain loops: values by summing the future, conditional covariances by fourth moments."""

import dataclasses
import math

import numpy as np
import pytest

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.time_means import expected_mean, time_means
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate


def experiment(start="stationary", **run):
    return Experiment.parse(
        {
            "name": "tiny",
            "problem": "tracking",
            "time": "continuous",
            "graphs": {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0]]}},
            "agents": 3,
            "switching": {"generator": [[-2.0, 2.0], [1.0, -1.0]]},
            "noise": {"process": [[1.0, 0.3, 0.0], [0.0, 0.5, 0.2], [0.0, 0.0, 2.0]]},
            "leaders": {"agents": [1, 3], "gain": 1.5, "reference": 2.0},
            "run": {"dt": 0.1, "duration": 3.0, "replicas": 2, "seed": 3, "start": start} | run,
        }
    )


@pytest.fixture(scope="module")
def observation():
    trajectory = simulate(experiment())
    return Observation.of(trajectory, predict(trajectory.record.experiment))


def future(step, form):
    """(Y_g, kappa_g up to a constant): the summed expected future of y^T H y less its steady mean."""
    y, kappa = np.stack([form] * 2), np.zeros(2)
    for _ in range(4000):
        ahead = np.einsum("gj,jab->gab", step.transition, y)
        kappa = step.transition @ kappa + np.einsum("gab,gab->g", ahead, step.noise)
        kappa -= kappa[0]
        y = form + step.weights.transpose(0, 2, 1) @ ahead @ step.weights
    return y, kappa


def fourth_moments(mean, cov):
    """E[x_a x_b x_c x_d] of N(mean, cov) as a (d, d, d, d) array (Isserlis)."""
    second = cov + np.outer(mean, mean)
    e = np.einsum
    return (
        e("ab,cd->abcd", second, second)
        + e("ac,bd->abcd", second, second)
        + e("ad,bc->abcd", second, second)
        - 2 * e("a,b,c,d->abcd", mean, mean, mean, mean)
    )


def test_measured_is_the_mean_over_the_first_n_states(observation):
    means = time_means(observation)
    y = observation.states[:-1] - 2.0
    direct = (y**2).mean(axis=(0, 2))
    np.testing.assert_allclose(means.nodes @ means.measured, direct, rtol=1e-12)
    np.testing.assert_allclose(means.system_series, (y**2).mean(axis=2).sum(axis=1), rtol=1e-12)
    prediction = observation.prediction.emulated
    np.testing.assert_allclose(means.nodes @ means.predicted, prediction.node_errors, rtol=1e-10)


def test_standard_errors_by_fourth_moments(observation):
    """Cov(D_k | now) of all node errors, written out for every step, next graph and replica."""
    step = observation.prediction.step
    values = [future(step, np.diag(row)) for row in np.eye(3)]
    total, system = np.zeros((3, 3)), np.zeros(observation.steps)
    for k, g in enumerate(observation.modes):
        moved = [step.weights[g] @ (x - 2.0) for x in observation.states[k].T]
        covariance, means = np.zeros((3, 3)), np.zeros((2, 3))
        for j in range(2):
            for m in moved:
                fourth = fourth_moments(m, step.noise[g])
                second = step.noise[g] + np.outer(m, m)
                first = [np.sum(values[a][0][j] * second) for a in range(3)]
                means[j] += np.array([first[a] + values[a][1][j] for a in range(3)]) / 2
                for a in range(3):
                    for b in range(3):
                        product = np.einsum("ij,kl,ijkl", values[a][0][j], values[b][0][j], fourth)
                        covariance[a, b] += step.transition[g, j] * (product - first[a] * first[b]) / 4
        mean = step.transition[g] @ means
        for j in range(2):
            covariance += step.transition[g, j] * np.outer(means[j] - mean, means[j] - mean)
        total += covariance
        system[k] = covariance.sum()
    means = time_means(observation)
    measured = means.nodes @ means.covariance @ means.nodes.T
    np.testing.assert_allclose(measured, total / observation.steps**2, rtol=1e-8)
    np.testing.assert_allclose(means.system_variances, system, rtol=1e-8)


@pytest.mark.parametrize(
    ("switches", "first", "others", "enough"),
    [
        (0.5, 1.0, 1.0, False),  # hardly a switch is expected
        (20.0, 1.0, 1.0, True),
        (20.0, 100.0, 1.0, False),  # the first part has 84 % of the variance
        (math.inf, 100.0, 1.0, True),  # the path is given
    ],
)
def test_intervals_need_many_sojourns(observation, switches, first, others, enough):
    means = dataclasses.replace(
        time_means(observation), system_variances=np.repeat([first] + [others] * 19, 5), switches=switches
    )
    assert means.long_enough is enough


def test_expected_switches(observation):
    """Of the rarer kind of N steps, with the stationary law of two graphs: both kinds are equally frequent."""
    transition = observation.prediction.step.transition
    there, back = transition[0, 1], transition[1, 0]
    assert time_means(observation).switches == pytest.approx(observation.steps * there * back / (there + back))


def test_blocks_change_nothing(observation, monkeypatch):
    whole = time_means(observation)
    monkeypatch.setattr("msg_analysis.inference.observation.BLOCK_NUMBERS", 50)
    split = time_means(observation)
    for field in dataclasses.fields(whole):
        np.testing.assert_allclose(getattr(split, field.name), getattr(whole, field.name), rtol=1e-11)


@pytest.mark.parametrize("start", ["zero", [5.0, -1.0, 2.0]])
def test_known_starts_are_predicted_by_the_transient(start):
    """Oracle: the recursion of theory, started at x(0) and the logged g(0), one step after the other."""
    trajectory = simulate(experiment(start))
    seen = Observation.of(trajectory, predict(trajectory.record.experiment))
    step = seen.prediction.step
    y = trajectory.record.start[:, 0] - 2.0
    law = np.eye(2)[seen.modes[0]]
    moments, total = law[:, None, None] * np.outer(y, y), np.zeros((3, 3))
    for _ in range(seen.steps):
        total += moments.sum(axis=0)
        w = step.weights
        inside = w @ moments @ w.transpose(0, 2, 1) + law[:, None, None] * step.noise
        moments, law = np.einsum("ji,jab->iab", step.transition, inside), law @ step.transition
    np.testing.assert_allclose(expected_mean(seen), total / seen.steps, rtol=1e-10)
