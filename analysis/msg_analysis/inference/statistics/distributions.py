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

"""Probabilities and quantiles; ``scipy.stats`` has them too, but its import takes longer than a comparison."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import special


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


def noncentral_chi2_tail(x: Any, dof: Any, noncentrality: Any) -> Any:
    """P(X > x) of a noncentral chi-square variable."""
    return 1.0 - special.chndtr(x, dof, noncentrality)


def needed_noncentrality(x: Any, dof: Any, tail: Any) -> Any:
    """The noncentrality parameter with P(X > x) = ``tail``."""
    return special.chndtrinc(x, dof, 1.0 - tail)


def student_quantile(below: Any, dof: Any) -> Any:
    """The t with P(T <= t) = ``below`` for a variable of Student's law with ``dof`` degrees of freedom."""
    return special.stdtrit(dof, below)


def gamma_tail(x: Any, shape: Any, scale: Any) -> Any:
    """P(X > x) of a gamma variable."""
    return special.gammaincc(shape, x / scale)


def binomial_interval(count: int, total: int) -> tuple[float, float]:
    """The exact 95 % interval of a probability: ``count`` of ``total`` (Clopper and Pearson, 1934)."""
    low = float(special.betaincinv(count, total - count + 1, 0.025)) if count else 0.0
    return low, float(special.betaincinv(count + 1, total - count, 0.975)) if count < total else 1.0
