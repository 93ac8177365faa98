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
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.inference.statistics.mixture_evidence import coefficient_evidence
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

    def add(self, numbers: FloatArray) -> None:
        """Add the products of numbers (b, columns, samples) with themselves and the earlier ones."""
        joined = np.concatenate([self._tail, numbers])
        old, end = len(self._tail), len(joined)
        lags = np.arange(1, min(LAGS, end - 1) + 1)
        # Products of all lags at once, by Fourier transforms so long that no two of them overlap.
        length = scipy.fft.next_fast_len(len(numbers) + LAGS, real=True)
        late = np.zeros((*numbers.shape[1:], length))
        late[:, :, old:end] = np.moveaxis(numbers, 0, 2)
        every = scipy.fft.rfft(np.moveaxis(joined, 0, 2), length)
        spectrum = np.einsum("mrf,mrf->mf", scipy.fft.rfft(late), every.conj())
        self.score[: len(lags)] += scipy.fft.irfft(spectrum, length)[:, lags].T
        begin = np.maximum(old, lags)
        sums = np.vstack([np.zeros(joined.shape[1]), (joined**2).sum(axis=2).cumsum(axis=0)])
        self.information[: len(lags)] += sums[end - lags] - sums[begin - lags]
        self.products[: len(lags)] += (end - begin) * numbers.shape[2]
        self._tail = joined[-LAGS:].copy()

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

    def evidence(self) -> FloatArray:
        """(columns, 100, K) logarithms."""
        return coefficient_evidence(self.score.T, self.information.T)


class LongLags(Departure):
    """Regression of every innovation on that of the same agent 1 to 100 steps before.

    The test takes the clearest lag: of an agent, or of all together where they are independent, with half of the
    level each.
    """

    test = "innovations: lags to 100"

    def __init__(self, law: Law) -> None:
        self._agents, self._together = np.flatnonzero(law.noisy), bool(law.apart and law.noisy.sum() > 1)
        self.sums = LagSums(len(self._agents), law.replicas)

    def add(self, block: Block) -> None:
        """Add the innovations of a block."""
        self.sums.add(block.white[:, self._agents])

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
        found = self.sums.evidence()
        if self._together:
            found = np.concatenate([found, self.sums.pooled().evidence()])
        return found.reshape(-1, found.shape[-1])

    def questions(self) -> list[Question]:
        """A lag of an agent, or of all."""
        whose = [f"agent {agent + 1}" for agent in self._agents.tolist()] + ["all agents"] * self._together
        return [(f"noise of {who} and {lag} steps before", ()) for who in whose for lag in range(1, LAGS + 1)]
