"""Innovation tests against sums written as loops."""

import numpy as np
import pytest
from scipy import stats

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import residuals as module
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.regression import regressors
from msg_analysis.inference.residuals import ResidualSums, residuals
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate


def observe(**changes):
    document = {
        "name": "tiny",
        "problem": "tracking",
        "time": "continuous",
        "graphs": {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0]]}},
        "agents": 3,
        "switching": {"generator": [[-2.0, 2.0], [1.0, -1.0]]},
        "noise": {"process": [[1.0, 0.3, 0.0], [0.0, 0.5, 0.2], [0.0, 0.0, 2.0]]},
        "leaders": {"agents": [1], "gain": 1.5, "reference": 2.0},
        "run": {"dt": 0.1, "duration": 6.0, "replicas": 3, "seed": 5},
    }
    trajectory = simulate(Experiment.parse(document | changes))
    return Observation.of(trajectory, predict(trajectory.record.experiment))


@pytest.fixture(scope="module")
def observation():
    return observe()


def all_innovations(observation):
    step = observation.step
    e = np.empty_like(observation.states[1:])
    for k, g in enumerate(observation.modes):
        for r in range(observation.replicas):
            x = observation.states[k, :, r]
            e[k, :, r] = observation.states[k + 1, :, r] - step.weights[g] @ x - step.offsets[g]
    return e


def test_innovations_are_the_noise_that_was_added(observation):
    measured = residuals(observation, 0, observation.steps)
    np.testing.assert_allclose(measured, all_innovations(observation), atol=1e-13)
    np.testing.assert_array_equal(residuals(observation, 7, 11), measured[7:11])


def test_covariance_is_the_corrected_likelihood_ratio(observation):
    e = all_innovations(observation)
    n, p = e.shape[0] * e.shape[2], 3
    noise = observation.step.noise[0]
    sample = sum(np.outer(v, v) for step in e for v in step.T) / n
    ratio = np.linalg.solve(noise, sample)
    statistic = n * (np.trace(ratio) - np.log(np.linalg.det(ratio)) - p)
    corrected = statistic * (1 - (2 * p**2 + 3 * p - 1) / (6 * n * (p + 1)))
    expected = stats.chi2.sf(corrected, 6)
    assert ResidualSums(observation).tests().p_covariance == pytest.approx(expected, rel=1e-9)


def test_whiteness_is_the_portmanteau_sum(observation):
    e = all_innovations(observation)
    values, vectors = np.linalg.eigh(observation.step.noise[0])
    w = np.einsum("ai,kir->kar", (vectors / np.sqrt(values)).T, e)
    w /= np.sqrt((w**2).mean(axis=(0, 2)))[:, None]
    steps, rank, replicas = w.shape
    chi2 = 0.0
    for lag in range(1, 11):
        for a in range(rank):
            for b in range(rank):
                total = sum(w[k, a] @ w[k - lag, b] for k in range(lag, steps))
                chi2 += total**2 / ((steps - lag) * replicas)
    for a in range(rank):
        pairs = sum(w[k, a, r] * w[k, a, s] for k in range(steps) for r in range(replicas) for s in range(r))
        chi2 += pairs**2 / (steps * 3)
    expected = stats.chi2.sf(chi2, 10 * rank**2 + rank)
    assert ResidualSums(observation).tests().p_whiteness == pytest.approx(expected, rel=1e-9)


def test_gain_is_the_score_test_written_out(observation):
    """One regressor for every graph and heard difference, the leader's pull in both graphs, and constants."""
    e, step = all_innovations(observation), observation.step
    regressors = [(i, None, lambda _: 1.0) for i in range(3)]
    regressors += [(0, g, lambda x: x[0] - 2.0) for g in range(2)]
    regressors += [(0, 0, lambda x: x[1] - x[0]), (1, 0, lambda x: x[0] - x[1])]
    regressors += [(1, 1, lambda x: x[2] - x[1]), (2, 1, lambda x: x[1] - x[2])]
    score, covariance = np.zeros(9), np.zeros((9, 9))
    for k, g in enumerate(observation.modes):
        for r in range(observation.replicas):
            x = observation.states[k, :, r]
            phi = [f(x) if mode in (None, g) else 0.0 for _, mode, f in regressors]
            for a, (i, _, _) in enumerate(regressors):
                score[a] += phi[a] * e[k, i, r]
                for b, (j, _, _) in enumerate(regressors):
                    covariance[a, b] += step.noise[g][i, j] * phi[a] * phi[b]
    expected = stats.chi2.sf(score @ np.linalg.solve(covariance, score), 9)
    assert ResidualSums(observation).tests().p_gain == pytest.approx(expected, rel=1e-8)


def test_blocks_change_nothing(observation, monkeypatch):
    whole = ResidualSums(observation).tests()
    monkeypatch.setattr("msg_analysis.inference.observation.BLOCK_NUMBERS", 40)
    split = ResidualSums(observation).tests()
    assert split.p_covariance == pytest.approx(whole.p_covariance, rel=1e-9)
    assert split.p_whiteness == pytest.approx(whole.p_whiteness, rel=1e-9)
    assert split.p_gain == pytest.approx(whole.p_gain, rel=1e-9)


@pytest.mark.parametrize(("limit", "count"), [(400, 9), (10, 9), (8, 6)])
def test_regressors_stay_few(observation, monkeypatch, limit, count):
    """Coarser regressors: 3 constants + 2 x 3 rows, then 3 constants + 3 rows."""
    monkeypatch.setattr(module, "MAX_REGRESSORS", limit)
    rows, inputs, terms = regressors(observation.step, limit)
    assert len(terms) == count
    assert rows.shape == (count,)
    assert inputs.shape == (2, count, 4)
    assert 0.0 < ResidualSums(observation).tests().p_gain < 1.0


def test_a_direction_without_noise_must_stand_still():
    quiet = observe(noise={"process": [1.0, 1.0, 0.0]})
    assert ResidualSums(quiet).tests().p_covariance > 0.001
    quiet.states[30, 2, 1] += 1e-4
    assert ResidualSums(quiet).tests().p_covariance == 0.0


@pytest.mark.parametrize("tiny", [1e-4, 1e-6, 1e-9])
def test_hardly_any_noise_is_no_alarm(tiny):
    assert ResidualSums(observe(noise={"process": [1.0, 1.0, tiny]})).tests().p_covariance > 0.001


def test_grounded_leaders_have_no_noise():
    leaders = {"agents": [1], "gain": float("inf"), "reference": 2.0}
    grounded = observe(leaders=leaders)
    tests = ResidualSums(grounded).tests()
    assert min(tests.p_covariance, tests.p_whiteness, tests.p_gain) > 0.001
    grounded.states[:, 0] += 0.01
    assert ResidualSums(grounded).tests().p_covariance == 0.0


def test_without_noise_there_is_nothing_to_test():
    tests = ResidualSums(observe(noise={"process": 0.0})).tests()
    assert (tests.p_covariance, tests.p_whiteness, tests.p_gain) == (None, None, None)


def test_replicas_with_the_same_noise_are_found():
    copied = observe()
    copied.states[:] = copied.states[:, :, :1]
    assert ResidualSums(copied).tests().p_whiteness < 1e-6
