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

"""The largest innovation of all: a single value that the noise can hardly have made."""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.evidence.event_evidence import EventEvidence
from msg_analysis.inference.evidence.mixture_evidence import variance_evidence
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.types import FloatArray

LARGE = 4.0  # standard deviations; smaller innovations have the evidence 0


class LargestInnovation(Departure):
    """Every innovation by itself, N(0, 1) after division by its standard deviation.

    The test is that of the largest, with their number as a factor (Bonferroni). The evidence is the mean over all
    innovations of a run of that of each one against a larger variance; those to come count 1. Half of the whole always
    counts 1.
    """

    test = "innovations: largest"

    def __init__(self, law: Law) -> None:
        self._agents = np.flatnonzero(law.noisy)
        self._evidence = EventEvidence(law.planned * law.replicas * len(self._agents))
        self._samples = 0
        self._largest, self._agent, self._place, self._runs = 0.0, 0, Place(0, 0), 1

    def add(self, block: Block) -> FloatArray:
        """Look at the innovations of a block."""
        white, looks = block.white[:, self._agents], block.looks
        if not white.size:
            return np.empty((looks.count, 0, 1))
        self._samples += white.size
        sizes = np.abs(white)
        large = sizes > LARGE
        logarithms = variance_evidence(np.ones(int(large.sum())), sizes[large] ** 2)[:, 0]
        seen, when = looks.lengths * white[0].size, looks.after(np.nonzero(large)[0])
        at = int(np.argmax(sizes))
        if not sizes.flat[at] <= abs(self._largest):  # also a NaN
            step, place, _ = np.unravel_index(at, white.shape)
            self._largest, self._agent = float(white.flat[at]), int(self._agents[place])
            self._place = Place(block.first + int(step) + 1, block.first + int(step) + 1)
        return self._evidence.add(seen, logarithms, when)[:, None, None]

    def merge(self, other: Self) -> None:
        """The larger one."""
        self._evidence.merge(other._evidence)
        self._samples += other._samples
        if abs(other._largest) > abs(self._largest):
            self._largest, self._agent, self._place = other._largest, other._agent, other._place.later(self._runs)
        self._runs += other._runs

    def finding(self) -> Finding | None:
        """The largest."""
        if not self._samples:
            return None
        log_p = math.log(2.0 * self._samples) + float(log_normal_tail(abs(self._largest)))
        return Finding(
            self.test, min(0.0, log_p), agent=self._agent, place=self._place, estimate=self._largest, expected=0.0
        )

    def evidence(self) -> FloatArray:
        """(1, 1)."""
        return np.array([[self._evidence.logarithm()]]) if self._evidence.planned else np.empty((0, 1))

    def questions(self) -> list[Question]:
        """One, about all agents."""
        return [("largest innovation", ())]
