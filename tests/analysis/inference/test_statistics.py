"""Statistics beside scipy, numpy and sums by hand: tails, quantiles, intervals, Holm, ranking, selection."""

import numpy as np
import pytest
import scipy.linalg
from scipy import stats

from msg_analysis.common.arrays import AnyArray
from msg_analysis.inference import statistics as ours
from msg_analysis.inference.estimates import rank_estimates
from msg_analysis.inference.statistics import batch_interval, direction_p, holm, pseudo_inverse, quadratic_form
from msg_analysis.inference.timing import extent, quantiles


@pytest.mark.parametrize(("count", "total"), [(0, 9), (9, 9), (1, 4), (250, 1000)])
def test_interval_of_a_probability(count: int, total: int) -> None:
    exact = stats.binomtest(count, total).proportion_ci(0.95, "exact")
    assert ours.binomial_interval(count, total) == pytest.approx((exact.low, exact.high), rel=1e-9)


def test_interval_of_batch_means() -> None:
    series = np.random.default_rng(1).standard_normal(1007)
    means = [series[7 + 50 * b : 57 + 50 * b].mean() for b in range(20)]
    expected = stats.t.interval(0.95, 19, loc=np.mean(means), scale=stats.sem(means))
    assert batch_interval(series) == pytest.approx(expected)
    assert batch_interval(np.zeros(39)) is None


def test_holm() -> None:
    """By hand: 0.01 x 4, 0.02 x 3, 0.03 x 2, 0.04 x 1, each at least the one before; never above 1."""
    np.testing.assert_allclose(holm(np.array([0.04, 0.01, 0.03, 0.02])), [0.06, 0.04, 0.06, 0.06])
    np.testing.assert_allclose(holm(np.array([0.0, 0.5, 0.9, 0.3])), [0.0, 1.0, 1.0, 0.9])
    assert (holm(np.array([])).tolist(), holm(np.array([0.2])).tolist()) == ([], [0.2])


RANDOM = np.random.default_rng(1)
ROOT = RANDOM.standard_normal((3, 3))
COVARIANCE, V = ROOT @ ROOT.T, RANDOM.standard_normal(3)
# Entries in other units, one that depends on the others, and one that is always 0.
MIX = np.vstack([np.eye(3), [[1.0, 1.0, 0.0]], np.zeros((1, 3))]) * np.array([1, 1e6, 1e-3, 5, 1])[:, None]
MIXED = MIX @ COVARIANCE @ MIX.T


def test_quadratic_form_ignores_dependent_and_dead_entries() -> None:
    chi2, dof = quadratic_form(MIX @ V, MIXED)
    assert dof == 3
    assert chi2 == pytest.approx(V @ scipy.linalg.solve(COVARIANCE, V), rel=1e-8)
    assert (MIX @ V) @ pseudo_inverse(MIXED) @ (MIX @ V) == pytest.approx(chi2, rel=1e-8)


def test_p_value_of_a_direction() -> None:
    """None without variance."""
    direction = np.array([1.0, -2e-6, 3e3, 0.1, 7.0])
    seen = MIX.T @ direction
    deviation = np.sqrt(seen @ COVARIANCE @ seen)
    assert direction_p(direction, MIX @ V, MIXED) == pytest.approx(2 * stats.norm.sf(abs(seen @ V) / deviation))
    for without in ([5.0, 5e-6, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]):  # dependent, and dead
        assert direction_p(np.array(without), MIX @ V, MIXED) is None
    rounding = np.diag([40.0, 1e-29, 1e-30])
    assert direction_p(np.array([0.0, 1.0, 1.0]), np.array([1.0, 1e-12, 0.0]), rounding) is None


CHANCE = np.random.default_rng(3)
NUMBERS = {
    "normal": CHANCE.normal(size=5_000),
    "integers": CHANCE.integers(0, 3, 5_000),
    "one far away": np.append(CHANCE.exponential(1e-6, 4_999), 1e9),
    "two values": np.repeat([0.25, 0.75], [4_000, 1_000]),
    "all alike": np.full(5_000, -7.5),
    "three": np.array([3.0, 1.0, 2.0]),
    "one": np.array([4]),
    "few large integers": CHANCE.integers(2**52, 2**52 + 40, 5_000),
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("at_once", [1, 100, 10_000])
def test_quantiles_in_pieces(name: str, at_once: int) -> None:
    numbers, shares = NUMBERS[name], (0.0, 0.01, 0.5, 0.95, 0.99, 1.0)

    def pieces() -> list[AnyArray]:
        return np.array_split(numbers, 7)  # some are empty

    assert extent(pieces) == (numbers.size, numbers.min(), numbers.max())
    assert quantiles(pieces, shares, at_once=at_once, bins=16) == np.quantile(numbers, shares).tolist()


def test_no_numbers() -> None:
    assert extent(lambda: [np.empty(0)]) == (0, np.inf, -np.inf)
    assert quantiles(lambda: [np.empty(0)], (0.5, 1.0)) == []


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


def test_equal_predictions_and_nothing_to_put_in_order() -> None:
    found = rank_estimates(np.array([1.0, 2.0]), np.eye(2) * 1e-4, np.array([1.5, 1.5 * (1 + 1e-13)]), 0.01)
    assert found.predicted_ranking == (1, 2)
    assert [d.predicted for d in found.contradictions] == [None]
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
