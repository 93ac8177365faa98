"""Whether the p-values of correct runs are those of a right test."""

from collections.abc import Sequence

from scipy import stats

from msg_analysis.inference.comparison import Comparison

BY_A_BOUND = {
    "residuals: noise by graph",
    "residuals: noise over time",
    "residuals: constant state",
    "residuals: largest",
    "residuals: lags to 100",
    "residuals: replicas",
    "residuals: stale values",
    "residuals: swapped graphs",
}
"""Tests whose p is a bound (of Bonferroni or Markov), so that small ones may be rarer than of a uniform number."""


def kolmogorov_smirnov(name: str, p: Sequence[float]) -> float:
    """Chance of p-values of a test that are further from uniform; of bounds: of ones that are that much too small."""
    side = "greater" if name in BY_A_BOUND else "two-sided"
    return float(stats.kstest(p, "uniform", alternative=side).pvalue)


def assert_calibrated(results: Sequence[Comparison]) -> None:
    """Of correct runs: p-values are even, intervals cover, verdicts agree."""
    # Kolmogorov-Smirnov at 2e-4 for each of at most 20 tests, coverage and verdicts at 1e-4 by the binomial law: a
    # right program fails with probability below 0.5 %.
    for name in [test.name for test in results[0].tests]:
        p = [test.p for result in results for test in result.tests if test.name == name]
        assert kolmogorov_smirnov(name, p) > 2e-4, name
    assert_covered(results, rate=1e-4)


def assert_covered(results: Sequence[Comparison], rate: float = 1e-3) -> None:
    """At level 0.01, and by intervals of 95 % of the system error; ``rate``: of false alarms, at most, of each."""
    errors = [result.system_error for result in results]
    covered = sum(error.interval[0] <= error.predicted <= error.interval[1] for error in errors)
    assert covered >= stats.binom.ppf(rate, len(results), 0.95)
    assert_few_alarms(results, rate)


def assert_few_alarms(results: Sequence[Comparison], rate: float = 1e-4) -> None:
    """At level 0.01; see above."""
    alarms = sum(result.verdict == "disagrees" for result in results)
    assert alarms <= stats.binom.isf(rate, len(results), 0.01)
