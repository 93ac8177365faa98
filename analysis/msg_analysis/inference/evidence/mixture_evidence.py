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

"""Evidence that may be looked at any time: likelihood ratios mixed over alternatives, in closed form, as logarithms.

Each is a martingale of mean 1 while the null hypothesis holds, so it ever passes 1/level with probability at most
``level`` (Ville's inequality). Sums over independent runs may be added up before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import betaln, gammaln

from msg_analysis.types import FloatArray, IntArray

VARIANCES = ((2.0, 1.0), (1000.0, 1.0), (300.0, 1.1), (300.0, 0.9))
"""Alternatives to a variance: strengths a, and factors c that they are near; the larger a, the nearer."""

_STRENGTHS = np.array([strength for strength, _ in VARIANCES])  # a
_NEAR = np.array([strength * factor for strength, factor in VARIANCES])  # b = a c

SHARES = (0.05, 0.3)  # standard deviations tau of the alternatives to a coefficient, 1 in the law
ROW_STRENGTHS = (3.0, 30.0)  # changes of a row that the alternatives are worth
PROPORTION_STRENGTHS = (2.0, 20.0, 200.0)  # successes that the alternatives are worth


def variance_evidence(
    samples: FloatArray | IntArray, squares: FloatArray, constant: FloatArray | None = None
) -> FloatArray:
    """Against variance 1 of independent normal samples: factors theta of the variance ~ inverse gamma(a, b), b = a c.

    log of b^a G(a + n/2) exp(S/2) / (G(a) (b + S/2)^(a + n/2)), the mixture of the likelihood ratios of theta.

    Parameters
    ----------
    samples
        (..., ) numbers n
    squares
        (..., ) sums of squares S
    constant
        (..., K) ``variance_constant(samples)``, where it is known: it takes most of the time

    Returns
    -------
    FloatArray
        (..., K) of each of ``VARIANCES``
    """
    half, s = np.asarray(samples, dtype=float) / 2.0, np.asarray(squares) / 2.0
    known = _variance_constant(samples) if constant is None else _to_front(constant)
    strengths, near = (_first(each, max(half.ndim, s.ndim)) for each in (_STRENGTHS, _NEAR))
    # (a + n/2) log(b / (b + s)) instead of two large terms that cancel.
    return _to_back(known - (strengths + half) * np.log1p(s / near) + s)


def variance_constant(samples: FloatArray | IntArray) -> FloatArray:
    """(..., K): log of G(a + n/2) / (G(a) b^(n/2)), what ``variance_evidence`` has of the numbers n (..., ) alone."""
    return _to_back(_variance_constant(samples))


def _variance_constant(samples: FloatArray | IntArray) -> FloatArray:
    """(K, ...)."""
    half = np.asarray(samples, dtype=float) / 2.0
    strengths, near = (_first(each, half.ndim) for each in (_STRENGTHS, _NEAR))
    return np.asarray(gammaln(strengths + half) - gammaln(strengths) - half * np.log(near))


def _first(alternatives: FloatArray, dimensions: int) -> FloatArray:
    """(K, 1, ...): as the first axis of arrays of so many dimensions, since numpy is slow where the last is short."""
    return alternatives.reshape(-1, *(1,) * dimensions)


def _to_back(found: FloatArray) -> FloatArray:
    """(..., K) of (K, ...); numpy's ``moveaxis`` takes ten times as long."""
    return found.transpose(*range(1, found.ndim), 0)


def _to_front(given: FloatArray) -> FloatArray:
    """(K, ...) of (..., K)."""
    return given.transpose(-1, *range(given.ndim - 1))


def coefficient_evidence(score: FloatArray, information: FloatArray) -> FloatArray:
    """Against the coefficient 0 of a regressor of normal samples of known variance: coefficients ~ N(0, tau^2).

    log of (1 + tau^2 J)^(-1/2) exp(tau^2 U^2 / (2 (1 + tau^2 J))).

    Parameters
    ----------
    score
        (..., ) U, sum of regressor times sample over variance
    information
        (..., ) J, sum of squared regressor over variance

    Returns
    -------
    FloatArray
        (..., K) of each tau in ``SHARES``
    """
    u, j = np.asarray(score), np.asarray(information)
    tau2 = _first(np.array(SHARES) ** 2, max(u.ndim, j.ndim))
    spread = 1.0 + tau2 * j
    return _to_back(0.5 * (tau2 * u**2 / spread - np.log(spread)))


def row_evidence(counts: FloatArray | IntArray, law: FloatArray) -> FloatArray:
    """Against a row of a transition matrix: rows ~ Dirichlet(alpha P), for several alpha.

    log of B(alpha P + c) / (B(alpha P) prod_h P_h^c_h); infinite after a transition that P excludes.

    Parameters
    ----------
    counts
        (..., n, n) transitions
    law
        (n, n) P

    Returns
    -------
    FloatArray
        (..., n, K) of each row; alpha is ``ROW_STRENGTHS`` over the probability of a change
    """
    n = len(law)
    leaving = 1.0 - np.diag(law)
    seen = np.asarray(counts)
    found = np.zeros((*seen.shape[:-1], len(ROW_STRENGTHS)))
    for g in range(n):
        possible, row = law[g] > 0.0, seen[..., g, :]
        if leaving[g] > 0.0:
            p, c = law[g][possible], row[..., None, possible]
            alpha = np.array(ROW_STRENGTHS)[:, None] / leaving[g]
            prior = alpha * p
            each = (gammaln(prior + c) - gammaln(prior) - c * np.log(p)).sum(axis=-1)
            found[..., g, :] = each - (gammaln(alpha[:, 0] + c.sum(axis=-1)) - gammaln(alpha[:, 0]))
        found[row[..., ~possible].any(axis=-1), g] = np.inf
    return found


def proportion_evidence(
    successes: IntArray, trials: IntArray, probability: FloatArray | float, constant: FloatArray | None = None
) -> FloatArray:
    """Against a known probability of independent successes: probabilities ~ beta of that mean.

    Parameters
    ----------
    successes, trials
        (..., ) counts
    probability
        (..., ) between 0 and 1, both excluded
    constant
        (..., K) ``proportion_constant(probability)``, where it is known

    Returns
    -------
    FloatArray
        (..., K) log of the mixture for each of ``PROPORTION_STRENGTHS``
    """
    p = np.asarray(probability, dtype=float)[..., None]
    hit, miss = np.asarray(successes)[..., None], (np.asarray(trials) - np.asarray(successes))[..., None]
    a, b = _beta_law(p)
    known = proportion_constant(probability) if constant is None else constant
    return np.asarray(betaln(a + hit, b + miss) - known - hit * np.log(p) - miss * np.log1p(-p))


def proportion_constant(probability: FloatArray | float) -> FloatArray:
    """(..., K): log B(a, b), what ``proportion_evidence`` has of the probabilities (..., ) alone."""
    return np.asarray(betaln(*_beta_law(np.asarray(probability, dtype=float)[..., None])))


def _beta_law(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Its numbers a (K,) and b (..., K), for probabilities (..., 1)."""
    strength = np.array(PROPORTION_STRENGTHS)
    return strength, strength * (1.0 - p) / p


def log_mean(logarithms: FloatArray, axis: int = 0) -> FloatArray:
    """Log of the mean of evidence along an axis: evidence again, without a correction for the number of questions."""
    return np.asarray(log_sum(logarithms, axis) - np.log(logarithms.shape[axis]))


def log_means(parts: Sequence[FloatArray]) -> FloatArray:
    """(T, P): logs of the means of P parts (T, ...), each over all but its first axis, none empty; all in one go."""
    sizes = np.array([part[0].size for part in parts])
    joined = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    return np.asarray(log_sums(joined.T, np.cumsum(sizes) - sizes).T - np.log(sizes))


def log_sums(logarithms: FloatArray, begins: IntArray) -> FloatArray:
    """(P, ...): log(sum(exp(...))) of stretches of the first axis, none empty, which begin there, ascending from 0."""
    largest = np.maximum.reduceat(logarithms, begins, axis=0)
    finite = np.where(np.isfinite(largest), largest, 0.0)
    sizes = np.append(begins[1:], len(logarithms)) - begins
    with np.errstate(invalid="ignore", divide="ignore", under="ignore", over="ignore"):
        shifted = np.exp(logarithms - np.repeat(finite, sizes, axis=0))
        return np.asarray(finite + np.log(np.add.reduceat(shifted, begins, axis=0)))


def log_sum(logarithms: FloatArray, axis: int) -> FloatArray:
    """log(sum(exp(...))) along an axis; a tenth of the time of scipy's, which also has signs and weights."""
    largest = logarithms.max(axis=axis, keepdims=True)
    finite = np.where(np.isfinite(largest), largest, 0.0)
    with np.errstate(invalid="ignore", divide="ignore", under="ignore"):
        total = np.log(np.exp(logarithms - finite).sum(axis=axis))
    return np.asarray(finite.squeeze(axis) + total)
