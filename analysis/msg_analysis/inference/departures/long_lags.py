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

"""Lags up to 100 steps: the noise of an agent does not depend on its own earlier noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.fft

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Question
from msg_analysis.inference.evidence.looks import Looks
from msg_analysis.inference.evidence.mixture_evidence import coefficient_evidence
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.types import FloatArray

LAGS = 100
MIN_SAMPLES = 100  # fewest products for the normal law of their sum


@dataclass(frozen=True, slots=True)
class Lag:
    """The clearest dependence on earlier numbers."""

    log_p: float  # of all lags and columns together
    column: int
    steps: int
    coefficient: float
    standard_error: float


class LagSums:
    """Regression of N(0, 1) numbers on those of the same column 1 to 100 steps before; expected coefficient 0.

    Given the past, the sum of the products is a martingale whose variance is the sum of the squares of the earlier
    numbers.
    """

    def __init__(self, columns: int, samples: int) -> None:
        self._tail = np.empty((0, columns, samples))
        shape = (LAGS, columns)
        self.score, self.information, self.products = np.zeros(shape), np.zeros(shape), np.zeros(LAGS, np.int64)

    def add(self, numbers: FloatArray, looks: Looks) -> tuple[FloatArray, FloatArray]:
        """Add the products of numbers (b, columns, samples) with the earlier ones.

        (T, 100, columns) each: ``score`` and ``information`` after each look.
        """
        joined = np.concatenate([self._tail, numbers])
        old, lags = len(self._tail), np.arange(1, LAGS + 1)
        # (T, lags): between the looks, the numbers that have one so many steps before them, in ``joined``.
        ends = np.repeat(old + looks.ends[:, None], LAGS, axis=1)
        begins = np.minimum(np.maximum(old + looks.begins[:, None], lags), ends)
        sums = np.vstack([np.zeros(joined.shape[1]), (joined**2).sum(axis=2).cumsum(axis=0)])
        information = sums[np.maximum(ends - lags, 0)] - sums[np.maximum(begins - lags, 0)]
        information = self.information + information.cumsum(axis=0)
        score = self.score + _products(joined, old, looks).cumsum(axis=0)
        self.score, self.information = score[-1], information[-1]
        self.products += (ends - begins).sum(axis=0) * numbers.shape[2]
        self._tail = joined[-LAGS:].copy()
        return score, information

    def merge(self, other: Self) -> None:
        """No lag goes over from one run to another."""
        self.score += other.score
        self.information += other.information
        self.products += other.products

    def pooled(self) -> LagSums:
        """Of all columns together, where these are independent of each other."""
        whole = LagSums(1, 0)
        whole.score, whole.information = (each.sum(axis=1, keepdims=True) for each in (self.score, self.information))
        whole.products = self.products
        return whole

    def clearest(self) -> Lag | None:
        """Of all lags and columns (Bonferroni); None where there are too few numbers."""
        lags = np.flatnonzero(self.products >= MIN_SAMPLES)
        # Of numbers that all are 0 there is no information, and nothing to see.
        score, information = self.score[lags], np.maximum(self.information[lags], np.finfo(float).tiny)
        if not score.size:
            return None
        z = score / np.sqrt(information)
        row, column = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
        log_p = math.log(2.0 * z.size) + float(log_normal_tail(abs(z[row, column])))
        coefficient = float(score[row, column] / information[row, column])
        return Lag(
            log_p, int(column), int(lags[row]) + 1, coefficient, 1.0 / math.sqrt(float(information[row, column]))
        )


def _products(joined: FloatArray, old: int, looks: Looks) -> FloatArray:
    """(T, LAGS, columns): sums of numbers between the looks times those 1 to 100 steps before.

    ``joined`` (old + b, columns, samples): the numbers, after ``old`` earlier ones.
    """
    found, columns = np.empty((looks.count, LAGS, joined.shape[1])), joined.transpose(1, 2, 0)
    # By Fourier transforms so long that no two products overlap; stretches of about the same length together.
    classes = np.frexp(looks.lengths + LAGS)[1]
    for each in np.unique(classes):
        rows = np.flatnonzero(classes == each)
        length = scipy.fft.next_fast_len(int(looks.lengths[rows].max()) + LAGS, real=True)
        every = np.zeros((len(rows), *joined.shape[1:], length))
        for part, begin, end in zip(every, old + looks.begins[rows], old + looks.ends[rows], strict=True):
            before = min(begin, LAGS)
            part[:, :, LAGS - before : LAGS + end - begin] = columns[:, :, begin - before : end]
        late = every.copy()
        late[..., :LAGS] = 0.0
        spectrum = np.einsum("tcsf,tcsf->tcf", scipy.fft.rfft(late), scipy.fft.rfft(every).conj())
        found[rows] = scipy.fft.irfft(spectrum, length)[..., 1 : LAGS + 1].transpose(0, 2, 1)
    return found


def lag_evidence(score: FloatArray, information: FloatArray) -> FloatArray:
    """(..., columns, LAGS, K) logarithms, from sums (..., LAGS, columns)."""
    return coefficient_evidence(score.swapaxes(-1, -2), information.swapaxes(-1, -2))


class LongLags(Departure):
    """Regression of every innovation on that of the same agent 1 to 100 steps before.

    The test takes the clearest lag: of an agent, or of all together where they are independent, with half of the
    level each.
    """

    test = "innovations: lags to 100"

    def __init__(self, law: Law) -> None:
        self._agents, self._together = np.flatnonzero(law.noisy), bool(law.apart and law.noisy.sum() > 1)
        self.sums = LagSums(len(self._agents), law.replicas)

    def add(self, block: Block) -> FloatArray:
        """Add the innovations of a block."""
        return self._evidence(*self.sums.add(block.white[:, self._agents], block.looks))

    def merge(self, other: Self) -> None:
        """Add the sums of other runs."""
        self.sums.merge(other.sums)

    def finding(self) -> Finding | None:
        """The clearest lag."""
        each, whole = self.sums.clearest(), self.sums.pooled().clearest() if self._together else None
        if each is None:
            return None
        best = min((lag for lag in (each, whole) if lag), key=lambda lag: lag.log_p)
        return Finding(
            self.test,
            min(0.0, best.log_p + math.log(1.0 + self._together)),
            agent=None if best is whole else int(self._agents[best.column]),
            span=(best.steps, best.steps),
            estimate=best.coefficient,
            standard_error=best.standard_error,
            expected=0.0,
        )

    def evidence(self) -> FloatArray:
        """(100 (agents + 1), K): lags of each agent, and of all together."""
        return self._evidence(self.sums.score, self.sums.information)

    def _evidence(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """(..., 100 (agents + 1), K), from sums (..., LAGS, agents)."""
        if self._together:
            both = score, information
            score, information = (np.append(each, each.sum(axis=-1, keepdims=True), axis=-1) for each in both)
        found = lag_evidence(score, information)
        return found.reshape(*found.shape[:-3], -1, found.shape[-1])

    def questions(self) -> list[Question]:
        """A lag of an agent, or of all."""
        whose = [f"agent {agent + 1}" for agent in self._agents.tolist()] + ["all agents"] * self._together
        return [(f"noise of {who} and {lag} steps before", ()) for who in whose for lag in range(1, LAGS + 1)]
