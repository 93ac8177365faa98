"""Probabilities and quantiles beside scipy.stats, far into the tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from msg_analysis.inference import statistics as ours

Z = np.array([-40.0, -9.0, -1.5, 0.0, 0.3, 2.0, 7.0, 38.0])
X = np.array([0.0, 1e-3, 0.7, 3.0, 40.0, 900.0])
TAILS = np.array([1e-12, 1e-3, 0.05, 0.5, 0.999])


def test_normal() -> None:
    np.testing.assert_allclose(ours.log_normal_tail(Z), stats.norm.logsf(Z), rtol=1e-12)
    np.testing.assert_allclose(ours.two_sided(Z), 2.0 * stats.norm.sf(np.abs(Z)), rtol=1e-12)


@pytest.mark.parametrize("dof", [1, 2, 7, 300])
def test_chi_square_and_student(dof: int) -> None:
    np.testing.assert_allclose(ours.chi2_tail(X, dof), stats.chi2.sf(X, dof), rtol=1e-10)
    np.testing.assert_allclose(ours.chi2_below(X, dof), stats.chi2.cdf(X, dof), rtol=1e-10)
    np.testing.assert_allclose(ours.chi2_quantile(TAILS, dof), stats.chi2.isf(TAILS, dof), rtol=1e-10)
    np.testing.assert_allclose(ours.student_quantile(TAILS, dof), stats.t.ppf(TAILS, dof), rtol=1e-8, atol=1e-12)


def test_gamma() -> None:
    np.testing.assert_allclose(ours.gamma_tail(X, 2.5, 3.0), stats.gamma.sf(X, 2.5, scale=3.0), rtol=1e-10)


@pytest.mark.parametrize(("count", "total"), [(0, 9), (9, 9), (1, 4), (250, 1000)])
def test_interval_of_a_probability(count: int, total: int) -> None:
    exact = stats.binomtest(count, total).proportion_ci(0.95, "exact")
    assert ours.binomial_interval(count, total) == pytest.approx((exact.low, exact.high), rel=1e-9)
