# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Distributions, intervals and multiplicity: what all tests of a run use.

The rank of a covariance is judged on the correlations: so the results do not depend on the units of the entries, and a
direction in which a vector moves only by rounding, which depends on the processor, counts as one without variance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy import special

from msg_analysis.common.arrays import FloatArray


def log_normal_tail(z: Any) -> Any:
    """Logarithm of P(Z > z) of a standard normal Z."""
    return special.log_ndtr(-z)


def two_sided(z: Any) -> Any:
    """P(abs(Z) > abs(z)) of a standard normal Z."""
    return 2.0 * special.ndtr(-abs(z))


def chi2_tail(x: Any, dof: Any) -> Any:
    """P(X > x) of a chi-square variable with ``dof`` degrees of freedom."""
    return special.chdtrc(dof, x)


def log_chi2_tail(x: float, dof: float) -> float:
    """Logarithm of P(X > x) of a chi-square variable; where that is too small for a number, of a bound just above."""
    tail = float(special.chdtrc(dof, x))
    if tail > 0.0 or not x > dof:
        return math.log(tail) if tail > 0.0 else 0.0
    half = dof / 2.0
    # Integration by parts: a geometric series of the ratio (dof - 2) / x bounds what follows the first term.
    first = (half - 1.0) * math.log(x / 2.0) - x / 2.0 - float(special.gammaln(half))
    return first - math.log1p(-max(dof - 2.0, 0.0) / x)


def log_chi2_below(x: float, dof: float) -> float:
    """Logarithm of P(X <= x) of a chi-square variable; where that is too small for a number, of a bound just above."""
    below = float(special.chdtr(dof, x))
    if below > 0.0 or not 0.0 < x < dof:
        return math.log(below) if below > 0.0 else -math.inf
    half = dof / 2.0
    # The power series of the incomplete gamma function, bounded by a geometric one.
    first = half * math.log(x / 2.0) - x / 2.0 - float(special.gammaln(half + 1.0))
    return first - math.log1p(-x / (dof + 2.0))


def normal_score(x: Any, dof: Any) -> Any:
    """Phi^-1(P(X <= x)) of a chi-square variable X, which is N(0, 1) if x is one; between -8 and 8."""
    tail = np.nan_to_num(special.chdtrc(dof, x), nan=0.0)
    return -special.ndtri(np.clip(tail, 1e-15, 1.0 - 1e-15))


def chi2_below(x: Any, dof: Any) -> Any:
    """P(X <= x) of a chi-square variable with ``dof`` degrees of freedom."""
    return special.chdtr(dof, x)


def chi2_quantile(tail: Any, dof: Any) -> Any:
    """The x with P(X > x) = ``tail`` for a chi-square variable with ``dof`` degrees of freedom."""
    return special.chdtri(dof, tail)


def add_sums(one: Any, other: Any, *names: str) -> None:
    """Add these attributes of another object to those of ``one``."""
    for name in names:
        setattr(one, name, getattr(one, name) + getattr(other, name))


def binomial_interval(count: int, total: int) -> tuple[float, float]:
    """The exact 95 % interval of a probability: ``count`` of ``total`` (Clopper and Pearson, 1934)."""
    low = float(special.betaincinv(count, total - count + 1, 0.025)) if count else 0.0
    return low, float(special.betaincinv(count + 1, total - count, 0.975)) if count < total else 1.0


def holm(p_values: FloatArray) -> FloatArray:
    """(q,) adjusted (Holm 1979): the least one of a true hypothesis is below a level with at most this probability."""
    order = np.argsort(p_values)
    stepped = p_values[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted


ROUNDED_DEVIATION = 1e-12  # relative to the largest standard deviation
ROUNDED_CORRELATION = 1e-10  # eigenvalue of a matrix of correlations


def quadratic_form(vector: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """v^T C^+ v of a vector (q,) with the covariance C (q, q), and the rank of C, its degrees of freedom."""
    inverse, correlations = _scaled(covariance)
    values, vectors = np.linalg.eigh(correlations)
    keep = values > ROUNDED_CORRELATION
    scores = vectors[:, keep].T @ (vector * inverse)
    return float((scores**2 / values[keep]).sum()), int(keep.sum())


def direction_p(direction: FloatArray, vector: FloatArray, covariance: FloatArray) -> float | None:
    """Two-sided p-value of d^T v, d and v (q,), C (q, q); None where its variance is nothing but rounding."""
    inverse, correlations = _scaled(covariance)
    scaled = np.divide(direction, inverse, out=np.zeros_like(direction), where=inverse > 0.0)
    variance = float(scaled @ correlations @ scaled)
    if variance <= ROUNDED_CORRELATION * float(scaled @ scaled):
        return None
    return float(two_sided(float(scaled @ (vector * inverse)) / np.sqrt(variance)))


def pseudo_inverse(covariance: FloatArray) -> FloatArray:
    """C^+ (q, q), computed from the correlations."""
    inverse, correlations = _scaled(covariance)
    scale = np.outer(inverse, inverse)
    return np.asarray(scale * np.linalg.pinv(correlations, rcond=ROUNDED_CORRELATION, hermitian=True))


def _scaled(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse standard deviations (q,) and correlations (q, q); both 0 where an entry moves only by rounding."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    alive = deviation > ROUNDED_DEVIATION * deviation.max(initial=0.0)
    inverse = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=alive)
    return inverse, covariance * np.outer(inverse, inverse)


def covariance_statistic(scatter: FloatArray, samples: int) -> tuple[float, float]:
    """Statistic and degrees of freedom of a chi-square test that ``samples`` independent vectors e are N(0, I).

    From sum e e^T (r, r): likelihood ratio with Bartlett's correction (Anderson, An Introduction to Multivariate
    Statistical Analysis, section 10.8); infinite where the vectors do not span their space. With fewer than 10 r
    samples: the exact chi-square test of the total size, two-sided, converted to 1 degree of freedom.
    """
    rank = len(scatter)
    if samples < 10 * rank:
        # Converted to a chi-square of 1 degree of freedom, so that sums of statistics have a chi-square law.
        p = chi2_tail(np.trace(scatter), samples * rank)
        return float(chi2_quantile(min(2 * min(p, 1 - p), 1.0), 1)), 1.0
    dof = rank * (rank + 1) / 2
    covariance = scatter / samples
    sign, logdet = np.linalg.slogdet(covariance)
    if sign <= 0:
        return np.inf, dof
    correction = 1 - (2 * rank**2 + 3 * rank - 1) / (6 * samples * (rank + 1))
    return float(correction * samples * (np.trace(covariance) - logdet - rank)), dof


BATCHES = 20
MOST_RUNNING = 64  # batches of a series that goes on
LEAST_LENGTH = 16  # values in each of them before they count


def batch_interval(series: FloatArray, level: float = 0.95) -> tuple[float, float] | None:
    """Interval for the mean of a correlated stationary series (N,), from 20 batch means and Student's t.

    A model-free check next to the martingale interval; its coverage is too low when the graphs switch slowly compared
    with a batch. None for a series shorter than two values per batch.
    """
    length = len(series) // BATCHES
    if length < 2:
        return None
    # The remainder is dropped at the beginning, where the start may still have an effect.
    means = series[len(series) - length * BATCHES :].reshape(BATCHES, length).mean(axis=1)
    half = special.stdtrit(BATCHES - 1, 0.5 + level / 2) * means.std(ddof=1) / np.sqrt(BATCHES)
    return float(means.mean() - half), float(means.mean() + half)


class RunningBatches:
    """Batch means of a series that goes on: ``MOST_RUNNING`` / 2 to ``MOST_RUNNING`` batches, whose length doubles."""

    def __init__(self) -> None:
        self.count = 0
        self._length, self._sums = 1, list[float]()
        self._open, self._left = 0.0, 1  # sum of the batch that is not full, and how many it lacks

    def add(self, values: Iterable[float]) -> None:
        """Take the next values."""
        series = np.fromiter(values, dtype=float)
        self.count += len(series)
        while len(series):
            part, series = series[: self._left], series[self._left :]
            self._open += float(part.sum())
            self._left -= len(part)
            if self._left:
                return
            self._sums.append(self._open)
            if len(self._sums) == MOST_RUNNING:
                pairs = np.array(self._sums).reshape(-1, 2)
                self._sums, self._length = pairs.sum(axis=1).tolist(), 2 * self._length
            self._open, self._left = 0.0, self._length

    def variance(self) -> float | None:
        """Variance of the mean of all values, times the square of their number; None: too few values."""
        if self._length < LEAST_LENGTH:
            return None
        means = np.array(self._sums) / self._length
        return float(means.var(ddof=1)) * self._length * self.count


def simultaneous_half_width(variance: FloatArray | float, target: float, level: float = 0.05) -> FloatArray:
    """(...): bound that a sum of martingale differences ever passes with probability about ``level``.

    The normal mixture sqrt((V + r) (log((V + r) / r) + 2 log(1 / level))), V (...) being the sum of the conditional
    variances so far: exact for normal differences, asymptotic for others (Waudby-Smith, Arbour, Sinha, Kennedy and
    Ramdas, Annals of Statistics 52 (2024)). It is nearly as low as it can be at V = ``target``, which is chosen before
    the run.
    """
    wide = 2.0 * math.log(1.0 / level)
    r = max(target, np.finfo(float).tiny) / (wide + math.log(1.0 + wide))
    total = np.asarray(variance, dtype=float) + r
    return np.asarray(np.sqrt(total * ((np.log(total) - np.log(r)) + wide)))


def steps_to_half_width(variance: float, half_width: float, level: float = 0.05) -> float:
    """Steps after which the interval at all times, tuned for that, is so narrow; ``variance`` of a difference."""
    wide = float(simultaneous_half_width(1.0, 1.0, level))
    return (wide / half_width) ** 2 * variance if half_width > 0.0 else math.inf
