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

"""Swapped graphs: for a stretch of the run, the states follow another graph than the logged one."""

from __future__ import annotations

from typing import Self

import numpy as np

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.evidence.mixture_evidence import log_mean
from msg_analysis.inference.evidence.windows import WindowEvidence, Windows
from msg_analysis.types import FloatArray, IntArray

MOST_GRAPHS = 20  # of a law for which this is tested


class SwappedGraphs(Departure):
    """Likelihood ratios of two graphs whose names are swapped, in windows of 1, 2, 4, ... steps, for every pair.

    The product over the steps of a window is evidence against the law, and so is the mean over all windows of a run and
    over the pairs; its inverse is the p of the test (Markov). Only in lockstep where all agents hear the states
    themselves and have noise, independent of each other.
    """

    test = "innovations: swapped graphs"

    def __init__(self, law: Law) -> None:
        self._step = step = law.step
        tested = law.plain and law.apart and law.noisy.all() and step.modes <= MOST_GRAPHS
        self._pairs: IntArray = np.column_stack(np.triu_indices(step.modes if tested else 0, 1))  # (P, 2)
        self._deviation = np.sqrt(np.einsum("gik,gik->gi", step.noise_gain, step.noise_gain))  # (n, m)
        self._windows = Windows(law.planned, len(self._pairs))
        self._evidence = WindowEvidence(self._windows, len(self._pairs))
        self._best, self._pair, self._place, self._runs = -np.inf, 0, Place(0, 0), 1

    def add(self, block: Block) -> FloatArray:
        """The windows that end in the block."""
        if not len(self._pairs):
            return np.empty((block.looks.count, 0, 1))
        logged, modes = _log_density(block.white, block.scale), block.reception.modes
        density = np.empty((len(logged), self._step.modes))
        for graph, deviation in enumerate(self._deviation):
            mean = self._step.weights[graph] @ block.reception.states + self._step.offsets[graph][:, None]
            density[:, graph] = _log_density((block.after - mean) / deviation[:, None], deviation)
        first, second = self._pairs.T
        swapped = np.where(modes[:, None] == first, density[:, second], logged[:, None])
        swapped = np.where(modes[:, None] == second, density[:, first], swapped)
        ended = self._windows.add(swapped - logged[:, None])
        level = ended.level
        evidence = self._evidence.add(ended, ended.sums, block.looks)
        values = ended.sums - np.log(self._windows.planned[level])[:, None]
        at, pair = np.unravel_index(int(np.argmax(values)), values.shape)
        if values[at, pair] > self._best:
            start = int(ended.first[at]) + 1
            self._best, self._pair = float(values[at, pair]), int(pair)
            self._place = Place(start, start + (1 << int(level[at])) - 1)
        return evidence[:, :, None]

    def merge(self, other: Self) -> None:
        """No window goes over from one run to another."""
        self._evidence.merge(other._evidence)
        if other._best > self._best:
            self._best, self._pair, self._place = other._best, other._pair, other._place.later(self._runs)
        self._runs += other._runs

    def finding(self) -> Finding | None:
        """The window and the pair with the most evidence."""
        if not len(self._pairs) or not self._windows.steps:
            return None
        graph, other = self._pairs[self._pair].tolist()
        log_p = -float(log_mean(self._evidence.logarithms()))
        return Finding(self.test, min(0.0, log_p), graph=graph, other=other, place=self._place)

    def evidence(self) -> FloatArray:
        """(pairs, 1)."""
        return self._evidence.logarithms()[:, None]

    def questions(self) -> list[Question]:
        """Two graphs."""
        return [("names of the graphs {} and {} swapped", pair) for pair in map(tuple, self._pairs.tolist())]


def _log_density(white: FloatArray, deviation: FloatArray) -> FloatArray:
    """(b,) log density of all innovations of a step but for a constant; standardised ones (b, m, R)."""
    return np.asarray(-0.5 * (white**2).sum(axis=(1, 2)) - white.shape[2] * np.log(deviation).sum(axis=-1))
