"""Which can be told apart: against z-values and Holm's steps by hand."""

import numpy as np
import pytest
from scipy import stats

from msg_analysis.inference.estimates import rank_estimates


def test_pairs_by_hand():
    measured = np.array([1.0, 2.0, 1.05, 4.0])
    covariance = np.diag([0.01, 0.04, 0.01, 0.04])
    covariance[0, 1] = covariance[1, 0] = 0.015
    found = rank_estimates(measured, covariance, np.array([1.0, 2.0, 1.0, 1.5]), 0.01)
    p = {}
    for i in range(4):
        for j in range(i):
            variance = covariance[i, i] + covariance[j, j] - 2 * covariance[i, j]
            p[j, i] = 2 * stats.norm.sf(abs(measured[i] - measured[j]) / np.sqrt(variance))
    adjusted, worst = {}, 0.0
    for place, pair in enumerate(sorted(p, key=p.get)):
        worst = max(worst, min(1.0, p[pair] * (6 - place)))
        adjusted[pair] = worst
    expected = {tuple(sorted(pair)) for pair, value in adjusted.items() if value < 0.01}
    assert expected == {(0, 1), (0, 3), (1, 2), (1, 3), (2, 3)}
    assert {tuple(sorted((d.better - 1, d.worse - 1))) for d in found.distinctions} == expected
    assert all(measured[d.better - 1] < measured[d.worse - 1] for d in found.distinctions)
    for d in found.distinctions:
        assert d.confidence == pytest.approx(1 - adjusted[tuple(sorted((d.better - 1, d.worse - 1)))])
    assert found.ranking == (1, 3, 2, 4)
    assert found.predicted_ranking == (1, 3, 4, 2)
    assert found.ties == ((1, 3),)
    assert [(d.better, d.worse) for d in found.contradictions] == [(2, 4)]
    assert found.to_json()["distinguished"] == 5


def test_equal_predictions_that_are_told_apart_contradict():
    found = rank_estimates(np.array([1.0, 2.0]), np.eye(2) * 1e-4, np.array([1.5, 1.5 * (1 + 1e-13)]), 0.01)
    assert found.predicted_ranking == (1, 2)
    assert [d.predicted for d in found.contradictions] == [None]


def test_nothing_to_put_in_order():
    assert rank_estimates(np.array([1.0]), np.eye(1), None, 0.01) is None
    assert rank_estimates(np.array([1.0, 2.0]), np.zeros((2, 2)), None, 0.01) is None
    assert rank_estimates(np.zeros(101), np.eye(101), None, 0.01) is None


def test_false_distinctions_stay_below_the_level():
    """2000 draws of 5 equal, correlated errors; at least one pair at level 0.05: binomial at 1e-4."""
    random = np.random.default_rng(1)
    root = random.standard_normal((5, 5))
    draws = 1.0 + 0.01 * random.standard_normal((2000, 5)) @ root.T
    wrong = sum(bool(rank_estimates(draw, 1e-4 * root @ root.T, None, 0.05).distinctions) for draw in draws)
    assert wrong <= stats.binom.isf(1e-4, 2000, 0.05)
