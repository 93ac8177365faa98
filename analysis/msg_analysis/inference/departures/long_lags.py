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
from typing import Self

import numpy as np
import scipy.fft

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Question
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.inference.statistics.mixture_evidence import coefficient_evidence
from msg_analysis.types import FloatArray

LAGS = 100
MIN_SAMPLES = 100  # fewest products for the normal law of their sum


class LongLags(Departure):
    """Regression of every innovation on that of the same agent 1 to 100 steps before; expected coefficient 0.

    Given the past, the sum of the products is a martingale whose variance is the sum of the squares of the earlier
    ones. The test takes the clearest lag: of an agent, or of all together where they are independent, with half of the
    level each and the number of coefficients as a factor (Bonferroni).
    """

    test = "innovations: lags to 100"

    def __init__(self, law: Law) -> None:
        self._agents, self._together = np.flatnonzero(law.noisy), bool(law.apart and law.noisy.sum() > 1)
        self._tail = np.empty((0, len(self._agents), law.replicas))
        shape = (LAGS, len(self._agents))
        self.score, self.information, self.products = np.zeros(shape), np.zeros(shape), np.zeros(LAGS, np.int64)

    def add(self, block: Block) -> None:
        """Add the products with the earlier innovations."""
        white = block.white[:, self._agents]
        joined = np.concatenate([self._tail, white])
        old, end = len(self._tail), len(joined)
        lags = np.arange(1, min(LAGS, end - 1) + 1)
        # Products of all lags at once, by Fourier transforms so long that no two of them overlap.
        length = scipy.fft.next_fast_len(len(white) + LAGS, real=True)
        late = np.zeros((*white.shape[1:], length))
        late[:, :, old:end] = np.moveaxis(white, 0, 2)
        every = scipy.fft.rfft(np.moveaxis(joined, 0, 2), length)
        spectrum = np.einsum("mrf,mrf->mf", scipy.fft.rfft(late), every.conj())
        self.score[: len(lags)] += scipy.fft.irfft(spectrum, length)[:, lags].T
        begin = np.maximum(old, lags)
        sums = np.vstack([np.zeros(len(self._agents)), (joined**2).sum(axis=2).cumsum(axis=0)])
        self.information[: len(lags)] += sums[end - lags] - sums[begin - lags]
        self.products[: len(lags)] += (end - begin) * white.shape[2]
        self._tail = joined[-LAGS:].copy()

    def merge(self, other: Self) -> None:
        """No lag goes over from one run to another."""
        self.score += other.score
        self.information += other.information
        self.products += other.products

    def finding(self) -> Finding | None:
        """The clearest lag."""
        lags = np.flatnonzero(self.products >= MIN_SAMPLES)
        if not len(lags) or not len(self._agents):
            return None
        groups = [(self.score[lags], self.information[lags])]
        if self._together:
            score, information = groups[0]
            groups.append((score.sum(axis=1, keepdims=True), information.sum(axis=1, keepdims=True)))
        candidates = []
        for group, (score, information) in enumerate(groups):
            z = score / np.sqrt(np.maximum(information, np.finfo(float).tiny))
            row, column = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
            log_p = math.log(2.0 * z.size * len(groups)) + float(log_normal_tail(abs(z[row, column])))
            coefficient = float(score[row, column] / information[row, column])
            error = 1.0 / math.sqrt(information[row, column])
            agent = int(self._agents[column]) if group == 0 else None
            candidates.append((log_p, agent, int(lags[row]) + 1, coefficient, error))
        log_p, agent, lag, coefficient, error = min(candidates, key=lambda candidate: candidate[0])
        return Finding(
            self.test,
            min(0.0, log_p),
            agent=agent,
            span=(lag, lag),
            estimate=coefficient,
            standard_error=error,
            expected=0.0,
        )

    def evidence(self) -> FloatArray:
        """(100 (agents + 1), K): lags of each agent, and of all together."""
        score, information = self.score.T, self.information.T
        if self._together:
            score, information = (np.vstack([each, each.sum(axis=0)]) for each in (score, information))
        return coefficient_evidence(score.ravel(), information.ravel())

    def questions(self) -> list[Question]:
        """A lag of an agent, or of all."""
        whose = [f"agent {agent + 1}" for agent in self._agents.tolist()] + ["all agents"] * self._together
        return [(f"noise of {who} and {lag} steps before", ()) for who in whose for lag in range(1, LAGS + 1)]
