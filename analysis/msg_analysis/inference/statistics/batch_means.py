"""Batch means: the interval that believes no model."""

from __future__ import annotations

import numpy as np
from scipy import stats

from msg_analysis.types import FloatArray

BATCHES = 20


def batch_interval(series: FloatArray, level: float = 0.95) -> tuple[float, float] | None:
    """Interval for the mean of a correlated stationary series from its batch means (Student's t).

    Covers too rarely when the graphs switch slowly compared with a batch; it stands beside the martingale
    interval as a check that uses no model.

    Parameters
    ----------
    series
        (N,)
    level
        nominal coverage

    Returns
    -------
    tuple[float, float] | None
        (low, high), or None for a series shorter than two values a batch
    """
    length = len(series) // BATCHES
    if length < 2:
        return None
    # The remainder is left out at the beginning, where a start may still be felt.
    means = series[len(series) - length * BATCHES :].reshape(BATCHES, length).mean(axis=1)
    half = stats.t.ppf(0.5 + level / 2, BATCHES - 1) * means.std(ddof=1) / np.sqrt(BATCHES)
    return float(means.mean() - half), float(means.mean() + half)
