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

"""Intervals that hold at all times at once: confidence sequences for the mean of martingale differences."""

from __future__ import annotations

import math

import numpy as np

from msg_analysis.types import FloatArray


def simultaneous_half_width(variance: FloatArray | float, target: float, level: float = 0.05) -> FloatArray:
    """Bound that the sum of martingale differences ever passes with probability about ``level``.

    The normal mixture sqrt((V + r) (log((V + r) / r) + 2 log(1 / level))): exact for normal differences, asymptotic for
    others (Waudby-Smith, Arbour, Sinha, Kennedy and Ramdas, Annals of Statistics 52 (2024), "Time-uniform central limit
    theory and asymptotic confidence sequences").

    Parameters
    ----------
    variance
        (..., ) sum V of the conditional variances so far
    target
        V at which the bound is nearly as low as it can be: chosen before the run
    level
        probability that it is ever passed

    Returns
    -------
    FloatArray
        (..., ) bound on the absolute value of the sum
    """
    wide = 2.0 * math.log(1.0 / level)
    r = max(target, np.finfo(float).tiny) / (wide + math.log(1.0 + wide))
    total = np.asarray(variance, dtype=float) + r
    return np.asarray(np.sqrt(total * ((np.log(total) - np.log(r)) + wide)))


def steps_to_half_width(variance: float, half_width: float, level: float = 0.05) -> float:
    """Steps after which the interval of a time mean that holds at all times at once is so narrow, if tuned for that.

    Parameters
    ----------
    variance
        conditional variance of the martingale difference of a step
    half_width
        of the interval of the time mean
    level
        probability that the interval ever misses

    Returns
    -------
    float
        number of steps; inf for a half-width of 0
    """
    wide = float(simultaneous_half_width(1.0, 1.0, level))
    return (wide / half_width) ** 2 * variance if half_width > 0.0 else math.inf
