"""Tests of covariances of normal vectors."""

from __future__ import annotations

import numpy as np
from scipy import stats

from msg_analysis.types import FloatArray


def covariance_statistic(scatter: FloatArray, samples: int) -> tuple[float, float]:
    """Statistic and degrees of freedom of a chi-square test that independent vectors are N(0, I).

    Likelihood ratio with Bartlett's correction: Anderson, An Introduction to Multivariate Statistical Analysis, section
    10.8. With too few samples for a determinant: the exact chi-square of the total size.

    Parameters
    ----------
    scatter
        (r, r) sum of e e^T
    samples
        number of vectors

    Returns
    -------
    tuple[float, float]
        (inf, degrees of freedom) where the vectors do not span their space
    """
    rank = len(scatter)
    if samples < 10 * rank:
        # A chi-square of its own many degrees of freedom, brought to one so that sums of statistics stay one.
        p = stats.chi2.sf(np.trace(scatter), samples * rank)
        return float(stats.chi2.isf(min(2 * min(p, 1 - p), 1.0), 1)), 1.0
    dof = rank * (rank + 1) / 2
    covariance = scatter / samples
    sign, logdet = np.linalg.slogdet(covariance)
    if sign <= 0:
        return np.inf, dof
    correction = 1 - (2 * rank**2 + 3 * rank - 1) / (6 * samples * (rank + 1))
    return float(correction * samples * (np.trace(covariance) - logdet - rank)), dof
