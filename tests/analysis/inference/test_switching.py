"""Transition counts against scipy, and simulated paths against their exact means."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from msg_analysis.inference.counts import simulate_counts, switching_test


def path(transition, steps, seed, first=0):
    random = np.random.default_rng(seed)
    modes = [first]
    for _ in range(steps - 1):
        modes.append(int(random.choice(len(transition), p=transition[modes[-1]])))
    return np.array(modes)


P = np.array([[0.9, 0.1], [0.3, 0.7]])
RARE = np.array([[0.97, 0.03, 0.0], [0.02, 0.97, 0.01], [0.05, 0.0, 0.95]])


def test_counts_and_likelihood_ratio():
    modes = path(P, 500, 1)
    result = switching_test(modes, P)
    counts = np.zeros((2, 2))
    for a, b in pairwise(modes):
        counts[a, b] += 1
    np.testing.assert_array_equal(result.counts, counts)
    np.testing.assert_allclose(result.expected, counts.sum(axis=1)[:, None] * P)
    rows = [stats.power_divergence(counts[i], counts[i].sum() * P[i], lambda_="log-likelihood") for i in range(2)]
    assert result.p == pytest.approx(stats.chi2.sf(sum(r.statistic for r in rows), 2))


def test_a_forbidden_transition_is_impossible():
    assert switching_test(np.array([0, 0, 2, 2, 0, 1, 1]), RARE).p == 0.0


def test_one_graph_leaves_nothing_to_test():
    result = switching_test(np.zeros(50, dtype=int), np.ones((1, 1)))
    assert result.p is None
    assert result.counts.tolist() == [[49]]


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


def test_an_absorbed_path_stays():
    counts = simulate_counts(np.array([[0.5, 0.5], [0.0, 1.0]]), 0, 10, 50, np.random.default_rng(3))
    assert (counts.sum(axis=(1, 2)) == 10).all()
    assert (counts[:, 1, 0] == 0).all()


def test_short_paths_give_uniform_p_values():
    """Kolmogorov-Smirnov at 1e-3 over 60 paths; discrete p-values only make it more cautious."""
    p = [switching_test(path(RARE, 300, seed), RARE).p for seed in range(60)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_wrong_rate_is_found_in_short_and_long_paths():
    twice = np.array([[0.94, 0.06, 0.0], [0.04, 0.94, 0.02], [0.1, 0.0, 0.9]])
    assert switching_test(path(twice, 1000, 4), RARE).p < 1e-3
    assert switching_test(path(np.array([[0.8, 0.2], [0.3, 0.7]]), 1000, 5), P).p < 1e-6


def test_no_switch_at_all_is_found():
    assert switching_test(np.zeros(1000, dtype=int), np.array([[0.98, 0.02], [0.02, 0.98]])).p < 1e-4
