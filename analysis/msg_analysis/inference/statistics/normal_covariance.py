# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Tests of covariances of normal vectors."""

from __future__ import annotations

import numpy as np

from msg_analysis.inference.statistics.distributions import chi2_quantile, chi2_tail
from msg_analysis.types import FloatArray


def covariance_statistic(scatter: FloatArray, samples: int) -> tuple[float, float]:
    """Statistic and degrees of freedom of a chi-square test that ``samples`` independent vectors are N(0, I).

    Likelihood ratio with Bartlett's correction: Anderson, An Introduction to Multivariate Statistical Analysis, section
    10.8. With fewer than 10 r samples: the exact chi-square test of the total size, two-sided, converted to 1 degree of
    freedom. The statistic is infinite where the vectors do not span their space.

    Parameters
    ----------
    scatter
        (r, r) sum of e e^T
    samples
        number of vectors
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
