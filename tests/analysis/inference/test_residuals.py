"""Innovation and switching tests against sums written as loops, scipy, and exact means."""

import dataclasses
from itertools import product

import numpy as np
import pytest
from scipy import stats

from experiments import TRACKING, chain_path, claimed, compare, five, observed, pieces, simulate
from msg_analysis.inference.counts import Transitions, simulate_counts
from msg_analysis.inference.regression import terms_of
from msg_analysis.inference.residuals import ResidualSums


def observe(**changes):
    leaders = {"agents": [1], "gain": 1.5, "reference": 2.0}
    return observed(pieces(**{"leaders": leaders} | changes, run={"duration": 6, "replicas": 3, "seed": 5}))


@pytest.fixture(scope="module")
def observation():
    """In blocks of a few steps."""
    return dataclasses.replace(observe(), block_numbers=40)


def all_innovations(observation):
    step = observation.step
    e = np.empty_like(observation.states[1:])
    for k, g in enumerate(observation.modes):
        for r in range(observation.replicas):
            x = observation.states[k, :, r]
            e[k, :, r] = observation.states[k + 1, :, r] - step.weights[g] @ x - step.offsets[g]
    return e


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
    deviation = np.sqrt(np.diag(observation.step.noise[0]))
    values, vectors = np.linalg.eigh(observation.step.noise[0] / np.outer(deviation, deviation))
    w = np.einsum("ai,kir->kar", (vectors / np.sqrt(values)).T / deviation, e)
    w /= np.sqrt((w**2).mean(axis=(0, 2)))[:, None]
    steps, rank, replicas = w.shape
    chi2 = 0.0
    for lag, a, b in product(range(1, 11), range(rank), range(rank)):
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


@pytest.mark.parametrize(("limit", "count"), [(400, 9), (10, 9), (8, 6)])
def test_regressors_stay_few(observation, limit, count):
    """Coarser regressors: 3 constants + 2 x 3 rows, then 3 constants + 3 rows."""
    assert len(terms_of(observation.step, limit)) == count
    assert 0.0 < ResidualSums(observation, most_regressors=limit).tests().p_gain < 1.0


def test_directions_without_noise():
    """Nothing may move in them; where there is hardly any noise, or no direction with noise, there is no alarm."""
    quiet = observe(noise={"process": [1.0, 1.0, 0.0]})
    assert ResidualSums(quiet).tests().p_covariance > 0.001
    quiet.states[30, 2, 1] += 1e-4
    assert ResidualSums(quiet).tests().p_covariance == 0.0
    for tiny in (1e-4, 1e-6, 1e-9):
        assert ResidualSums(observe(noise={"process": [1.0, 1.0, tiny]})).tests().p_covariance > 0.001
    grounded = observe(leaders={"agents": [1], "gain": float("inf"), "reference": 2.0})
    tests = ResidualSums(grounded).tests()
    assert min(tests.p_covariance, tests.p_whiteness, tests.p_gain) > 0.001
    grounded.states[:, 0] += 0.01
    assert ResidualSums(grounded).tests().p_covariance == 0.0
    tests = ResidualSums(observe(noise={"process": 0.0})).tests()
    assert (tests.p_covariance, tests.p_whiteness, tests.p_gain) == (None, None, None)


def test_replicas_with_the_same_noise_are_found():
    copied = observe()
    copied.states[:] = copied.states[:, :, :1]
    assert ResidualSums(copied).tests().p_whiteness < 1e-6


def switching_test(modes, transition):
    return Transitions.of(modes, len(transition)).test(transition)


P = np.array([[0.9, 0.1], [0.3, 0.7]])
RARE = np.array([[0.97, 0.03, 0.0], [0.02, 0.97, 0.01], [0.05, 0.0, 0.95]])


def test_counts_and_likelihood_ratio():
    modes = chain_path(P, 500, 1)
    result = switching_test(modes, P)
    counts = np.zeros((2, 2))
    np.add.at(counts, (modes[:-1], modes[1:]), 1)
    np.testing.assert_array_equal(result.counts, counts)
    np.testing.assert_allclose(result.expected, counts.sum(axis=1)[:, None] * P)
    rows = [stats.power_divergence(counts[i], counts[i].sum() * P[i], lambda_="log-likelihood") for i in range(2)]
    assert result.p == pytest.approx(stats.chi2.sf(sum(r.statistic for r in rows), 2))


def test_what_cannot_be_or_is_not_tested():
    assert switching_test(np.array([0, 0, 2, 2, 0, 1, 1]), RARE).p == 0.0
    result = switching_test(np.zeros(50, dtype=int), np.ones((1, 1)))
    assert (result.p, result.counts.tolist()) == (None, [[49]])
    counts = simulate_counts(np.array([[0.5, 0.5], [0.0, 1.0]]), 0, 10, 50, np.random.default_rng(3))
    assert (counts.sum(axis=(1, 2)) == 10).all()
    assert (counts[:, 1, 0] == 0).all()


def test_simulated_counts_have_the_exact_means():
    """Mean counts of 20000 paths within 4.5 standard errors; false alarms below 1e-4."""
    paths, steps = 20_000, 40
    counts = simulate_counts(RARE, 1, steps, paths, np.random.default_rng(2))
    assert (counts.sum(axis=(1, 2)) == steps).all()
    law, exact = np.array([0.0, 1.0, 0.0]), np.zeros((3, 3))
    for _ in range(steps):
        exact += law[:, None] * RARE
        law = law @ RARE
    error = counts.std(axis=0) / np.sqrt(paths)
    assert (np.abs(counts.mean(axis=0) - exact) <= 4.5 * error).all()


def test_short_paths_give_uniform_p_values():
    """Kolmogorov-Smirnov at 1e-3 over 60 paths; discrete p-values only make it more cautious."""
    p = [switching_test(chain_path(RARE, 300, seed), RARE).p for seed in range(60)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_wrong_rate_is_found_in_short_and_long_paths():
    twice = np.array([[0.94, 0.06, 0.0], [0.04, 0.94, 0.02], [0.1, 0.0, 0.9]])
    assert switching_test(chain_path(twice, 1000, 4), RARE).p < 1e-3
    assert switching_test(chain_path(np.array([[0.8, 0.2], [0.3, 0.7]]), 1000, 5), P).p < 1e-6
    assert switching_test(np.zeros(1000, dtype=int), np.array([[0.98, 0.02], [0.02, 0.98]])).p < 1e-4


@pytest.mark.parametrize("law", [{}, {"link": 0.1, "delay": 1}, {"loss": 0.2}], ids=str)
@pytest.mark.parametrize("gain", [1e-3, 1e-7, 1e-8, 1e-9, 1e-12])
def test_one_agent_has_much_less_noise_than_the_others(gain, law):
    """Tests at 0.01, evidence at 100: seeds are fixed; and 1.5 times its noise is found."""
    process = [gain, 1.0, 1.0, 1.0, 1.0]
    correct = five(duration=20, noise={"process": process, **law})
    result = compare(simulate(correct))
    assert result.verdict == "agrees"
    assert result.any_time.log_evidence < np.log(100.0)
    louder = simulate(five(duration=20, noise={"process": [1.5 * gain, *process[1:]], **law}))
    found = {"disagrees"} if "link" not in law else {"agrees", "disagrees"}  # with noise of links, a run is too short
    assert compare(claimed(louder, correct)).verdict in found


@pytest.mark.parametrize(
    ("at", "gain", "tested"),
    [(5e6, 1e-3, True), (1e9, 1e-3, True), (1e12, 1.0, True), (1e12, 1e-3, False), (1e15, 1.0, False)],
)
@pytest.mark.parametrize("problem", [{}, TRACKING], ids=["consensus", "tracking"])
def test_states_far_from_zero(problem, at, gain, tested):
    """Tests at 0.01; seeds are fixed. What the digits of the states do not show is left out, and the result says so."""
    if problem:
        problem = {**problem, "leaders": {**problem["leaders"], "reference": at}}
    for seed in range(3):
        result = compare(simulate(five(seed, 50, noise={"process": gain}, run={"start": [at] * 5}, **problem)))
        assert result.verdict == "agrees"
        assert any(test.name.startswith("system error") for test in result.tests) == tested
        assert (result.trust.reason == "few_digits") == (not tested)
        assert ("their last digit is worth" in str(result.trust.words)) == (not tested)
