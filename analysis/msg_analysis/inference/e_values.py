# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""E-values: evidence against a hypothesis that holds at any number of interim analyses.

Likelihood ratios mixed over alternatives, in closed form, as logarithms. Each is a martingale of mean 1 while the null
hypothesis holds, so it ever passes 1/level with probability at most ``level`` (Ville's inequality). Sums over
independent runs may be added up before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, betaln, gammaln

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray


class Analyses:
    """Analyses at a block of b steps."""

    def __init__(self, ends: IntArray) -> None:
        self.ends = ends  # (T,) numbers of steps before each analysis, from 1, ascending; the last is b
        self.count = len(ends)  # T
        self.begins: IntArray = np.append(0, ends[:-1])  # (T,) first step between each analysis and the one before it
        self.lengths = ends - self.begins  # (T,) steps between these

    def after(self, steps: IntArray) -> IntArray:
        """The analysis that comes next after each of these steps, from 0."""
        return np.searchsorted(self.ends, steps, side="right")

    def sums(self, values: FloatArray) -> FloatArray:
        """(T, ...): sums of values (b, ...) over the steps between each analysis and the one before it."""
        return np.asarray(np.add.reduceat(values, self.begins, axis=0))

    def counts(self, values: IntArray | BoolArray) -> IntArray:
        """(T, ...): the same of whole numbers, or of how many are true."""
        return np.asarray(np.add.reduceat(np.asarray(values, dtype=np.int64), self.begins, axis=0))


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
    """(..., K) for each of ``VARIANCES``, against variance 1 of n (...) normal samples with sum of squares S (...).

    log of b^a G(a + n/2) exp(S/2) / (G(a) (b + S/2)^(a + n/2)), the mixture of the likelihood ratios of factors theta
    of the variance ~ inverse gamma(a, b), b = a c. ``constant``: of ``variance_constant``, which takes most of the
    time.
    """
    half, s = np.asarray(samples, dtype=float) / 2.0, np.asarray(squares) / 2.0
    known = variance_constant(samples) if constant is None else constant
    strengths, near = (_first(each, max(half.ndim, s.ndim)) for each in (_STRENGTHS, _NEAR))
    # (a + n/2) log(b / (b + s)) instead of two large terms that cancel.
    return np.moveaxis(known - (strengths + half) * np.log1p(s / near) + s, 0, -1)


def variance_constant(samples: FloatArray | IntArray) -> FloatArray:
    """(K, ...): log of G(a + n/2) / (G(a) b^(n/2)), what ``variance_evidence`` has of the numbers n (..., ) alone."""
    half = np.asarray(samples, dtype=float) / 2.0
    strengths, near = (_first(each, half.ndim) for each in (_STRENGTHS, _NEAR))
    return np.asarray(gammaln(strengths + half) - gammaln(strengths) - half * np.log(near))


def _first(alternatives: FloatArray, dimensions: int) -> FloatArray:
    """(K, 1, ...): as the first axis of arrays of so many dimensions, since numpy is slow where the last is short."""
    return alternatives.reshape(-1, *(1,) * dimensions)


def coefficient_evidence(score: FloatArray, information: FloatArray) -> FloatArray:
    """(..., K) for each tau of ``SHARES``, against coefficient 0 of a regressor of normal samples of known variance.

    log of (1 + tau^2 J)^(-1/2) exp(tau^2 U^2 / (2 (1 + tau^2 J))), the mixture over coefficients ~ N(0, tau^2); U (...)
    is the sum of regressor times sample over variance, J (...) that of the squared regressor over variance.
    """
    u, j = np.asarray(score), np.asarray(information)
    tau2 = _first(np.array(SHARES) ** 2, max(u.ndim, j.ndim))
    spread = 1.0 + tau2 * j
    return np.moveaxis(0.5 * (tau2 * u**2 / spread - np.log(spread)), 0, -1)


def row_evidence(counts: FloatArray | IntArray, law: FloatArray) -> FloatArray:
    """(..., n, K) against each row of a transition matrix P (n, n), from ``counts`` (..., n, n) of transitions.

    log of B(alpha P + c) / (B(alpha P) prod_h P_h^c_h), the mixture over rows ~ Dirichlet(alpha P), alpha being
    ``ROW_STRENGTHS`` over the probability of a change; infinite after a transition that P excludes.
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


def proportion_evidence(successes: IntArray, trials: IntArray, probability: FloatArray | float) -> FloatArray:
    """(..., K) for each of ``PROPORTION_STRENGTHS``, against a known probability p (...) of independent successes.

    log of B(a + s, b + t - s) / (B(a, b) p^s (1 - p)^(t - s)) for s of t (...), the mixture over probabilities ~
    beta(a, b) of mean p.
    """
    p = np.asarray(probability, dtype=float)[..., None]
    hit, miss = np.asarray(successes)[..., None], (np.asarray(trials) - np.asarray(successes))[..., None]
    a = np.array(PROPORTION_STRENGTHS)
    b = a * (1.0 - p) / p
    return np.asarray(betaln(a + hit, b + miss) - betaln(a, b) - hit * np.log(p) - miss * np.log1p(-p))


SHARE_STRENGTH = 5.0  # successes and failures that the alternatives to a share are worth


def share_evidence(successes: IntArray, failures: IntArray, share: float) -> FloatArray:
    """(...) against a probability of success of at least ``share`` (0 to 1, exclusive), in independent trials.

    log of the mixture of q^s (1 - q)^f / (share^s (1 - share)^f) for s and f (...) over q ~ beta of mean ``share``, cut
    off there: for every probability >= share each factor has a mean of at most 1.
    """
    a, b = SHARE_STRENGTH * share, SHARE_STRENGTH * (1.0 - share)
    with np.errstate(divide="ignore"):
        found = betaln(a + successes, b + failures) + np.log(betainc(a + successes, b + failures, share))
        known = betaln(a, b) + np.log(betainc(a, b, share))
    return np.asarray(found - known - successes * math.log(share) - failures * math.log1p(-share))


def log_mean(logarithms: FloatArray, axis: int = 0) -> FloatArray:
    """Log of the mean of evidence along an axis: evidence again, without a correction for the number of questions."""
    return np.asarray(log_sum(logarithms, axis) - np.log(logarithms.shape[axis]))


def log_means(parts: Sequence[FloatArray]) -> FloatArray:
    """(T, P): logs of the means of P parts (T, ...), each over all but its first axis, none empty."""
    return np.stack([log_mean(part.reshape(len(part), -1), axis=1) for part in parts], axis=1)


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


@dataclass(frozen=True, slots=True, eq=False)
class EndedWindows:
    """Windows that ended in some steps, ordered by their length."""

    levels: IntArray  # (L,) lengths 2^level that there are, ascending
    begins: IntArray  # (L,) row of the first window of each length
    counts: IntArray  # (L,) windows of each length
    first: IntArray  # (w,) first steps, from 0
    sums: FloatArray  # (w, K)

    @property
    def level(self) -> IntArray:
        """(w,) of each window."""
        return np.repeat(self.levels, self.counts)


class Windows:
    """Sums over windows of 2^l steps of a run of ``planned`` steps, which begin at every multiple of 2^(l-1) steps."""

    def __init__(self, planned: int, columns: int) -> None:
        self.levels = max(planned, 1).bit_length()
        steps = np.arange(self.levels)
        # (levels,) windows of each length in the run
        self.planned: IntArray = np.where(steps > 0, (planned >> np.maximum(steps - 1, 0)) - 1, planned).clip(1)
        self.steps = 0  # seen
        self._last = [np.empty((0, columns)) for _ in range(self.levels)]
        self._cells = [0] * self.levels  # of 2^l steps, that were seen

    def add(self, numbers: FloatArray) -> EndedWindows:
        """The windows that end in steps with ``numbers`` (b, K)."""
        first, sums = [self.steps + np.arange(len(numbers))], [numbers]
        self.steps += len(numbers)
        cells = numbers
        for level in range(1, self.levels):
            half = level - 1
            joined = np.concatenate([self._last[half], cells])
            number = self._cells[half] - len(self._last[half]) + np.arange(max(len(joined) - 1, 0))
            self._cells[half] += len(cells)
            self._last[half] = joined[-1:]
            if not len(number):
                break
            first.append(number << half)
            sums.append(joined[:-1] + joined[1:])
            cells = sums[level][number % 2 == 0]
        counts = np.array([len(each) for each in sums])
        levels = np.flatnonzero(counts)
        begins = (np.cumsum(counts) - counts)[levels]
        return EndedWindows(levels, begins, counts[levels], np.concatenate(first), np.concatenate(sums))

    def seen(self) -> IntArray:
        """(levels,) windows that have ended."""
        return np.array([self.steps, *(max(count - 1, 0) for count in self._cells[:-1])])

    def begun(self, steps: IntArray) -> IntArray:
        """(..., levels): windows that have begun, or ended, after so many steps (...)."""
        half = 1 << np.maximum(np.arange(self.levels) - 1, 0)
        return np.asarray(np.minimum(-(-steps[..., None] // half), self.planned))


class WindowEvidence:
    """The mean of evidence over all windows of a run, lengths with equal weight; runs are multiplied."""

    def __init__(self, windows: Windows, columns: int) -> None:
        self._windows = windows
        self._ended, self._others = np.full(columns, -np.inf), np.zeros(columns)

    def add(self, ended: EndedWindows, logarithms: FloatArray, analyses: Analyses) -> FloatArray:
        """Evidence (w, K) of windows that ended in the newest steps, a block with these analyses: (T, K) after each."""
        levels, begun = ended.level, self._windows.steps - int(analyses.ends[-1])
        analysis = analyses.after(ended.first + (1 << levels) - 1 - begun)
        order = np.argsort(analysis, kind="stable")
        shares = np.log(self._windows.planned[levels] * float(self._windows.levels))
        begins = np.searchsorted(analysis[order], np.arange(analyses.count))  # a window of one step ends in every step
        each = log_sums((logarithms - shares[:, None])[order], begins)
        total = np.logaddexp.accumulate(np.vstack([self._ended, each]), axis=0)[1:]
        self._ended = total[-1]
        return self._after(begun + analyses.ends, total)

    def merge(self, other: WindowEvidence) -> None:
        """With that of other runs."""
        self._others = self._others + other.logarithms()

    def logarithms(self) -> FloatArray:
        """(K,) of the evidence so far."""
        return self._after(np.array(self._windows.steps), self._ended)

    def _after(self, steps: IntArray, ended: FloatArray) -> FloatArray:
        """(..., K): after so many steps (...), from the logs (..., K) of the sum over the windows that ended."""
        # A window counts 1 before it begins, 0 while it goes on and its evidence when it has ended: never more than the
        # martingale of which it is the end.
        rest = (1.0 - self._windows.begun(steps) / self._windows.planned).mean(axis=-1)
        with np.errstate(divide="ignore"):
            return np.asarray(self._others + np.logaddexp(ended, np.log(rest)[..., None]))


class EventEvidence:
    """The mean of evidence over the ``planned`` events of a run, those to come with 1; runs are multiplied."""

    def __init__(self, planned: int) -> None:
        self.planned = planned
        self._seen, self._ended, self._others = 0, -np.inf, 0.0

    def add(self, seen: IntArray, logarithms: FloatArray, analyses: IntArray) -> FloatArray:
        """(T,): after each analysis, of ``seen`` (T,) events between, with evidence (e,) before ``analyses`` (e,)."""
        ended = np.full(len(seen), -np.inf)
        np.logaddexp.at(ended, analyses, logarithms - math.log(self.planned))
        ended = np.logaddexp.accumulate(np.append(self._ended, ended))[1:]
        number = self._seen + np.cumsum(seen)
        self._seen, self._ended = int(number[-1]), float(ended[-1])
        return self._after(number, ended)

    def merge(self, other: EventEvidence) -> None:
        """With that of other runs."""
        self._others += float(other.logarithms().sum())

    def logarithms(self) -> FloatArray:
        """(1, 1) of the evidence so far; (0, 1) where there is no event."""
        if not self.planned:
            return np.empty((0, 1))
        return self._after(np.array([[self._seen]]), np.array([[self._ended]]))

    def _after(self, seen: IntArray, ended: FloatArray) -> FloatArray:
        """Of so many events, and the log of the sum over them."""
        rest = np.maximum(0.0, 1.0 - seen / self.planned)
        with np.errstate(divide="ignore"):
            mean = np.logaddexp(ended, np.log(rest))
        # Half of the whole always counts 1: so events whose evidence is 0, as nearly all have, do not wear it out.
        return np.asarray(self._others + np.logaddexp(0.0, mean) - math.log(2.0))
