"""Whether the p-values of correct runs are those of a right test."""

from collections.abc import Sequence

from scipy import stats

BY_A_BOUND = {
    "residuals: noise by graph",
    "residuals: noise over time",
    "residuals: constant state",
    "residuals: largest",
    "residuals: lags to 100",
    "residuals: stale values",
    "residuals: swapped graphs",
}
"""Tests whose p is a bound (of Bonferroni or Markov), so that small ones may be rarer than of a uniform number."""


def kolmogorov_smirnov(name: str, p: Sequence[float]) -> float:
    """Chance of p-values of a test that are further from uniform; of bounds: of ones that are that much too small."""
    side = "greater" if name in BY_A_BOUND else "two-sided"
    return float(stats.kstest(p, "uniform", alternative=side).pvalue)
