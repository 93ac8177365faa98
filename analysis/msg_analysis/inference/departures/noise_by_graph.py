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

"""Noise by graph: the innovations of every agent have the variance of the law under every graph by itself."""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Question
from msg_analysis.inference.evidence.mixture_evidence import variance_evidence
from msg_analysis.inference.statistics.distributions import log_chi2_below, log_chi2_tail
from msg_analysis.types import FloatArray, IntArray


class NoiseByGraph(Departure):
    """Squares of standardised innovations by graph and agent, and of all agents together where these are independent.

    Each sum is chi-square; the test is two-sided, with the number of sums as a factor (Bonferroni).
    """

    test = "innovations: noise by graph"

    def __init__(self, law: Law) -> None:
        n, m = law.step.modes, law.step.agents
        self._agents, self._together = np.flatnonzero(law.noisy), law.apart and law.noisy.sum() > 1
        self._graphs = n
        self.samples, self.squares = np.zeros((n, m), np.int64), np.zeros((n, m))

    def add(self, block: Block) -> FloatArray:
        """Every agent by the graph that it used."""
        size, looks = (block.white**2).sum(axis=2), block.looks
        there = [block.reception.graphs == graph for graph in range(self._graphs)]
        samples = np.stack([looks.counts(each) for each in there], axis=1) * block.white.shape[2]  # (T, n, m)
        squares = np.stack([looks.sums(size * each) for each in there], axis=1)
        samples, squares = self.samples + samples.cumsum(axis=0), self.squares + squares.cumsum(axis=0)
        self.samples, self.squares = samples[-1], squares[-1]
        return self._evidence(samples, squares)

    def merge(self, other: Self) -> None:
        """Sums of independent numbers."""
        self.samples += other.samples
        self.squares += other.squares

    def finding(self) -> Finding | None:
        """The graph and the agent, or all agents, whose variance is furthest from that of the law."""
        samples, squares = self._rows(self.samples.astype(float)), self._rows(self.squares)
        cells = [
            (min(log_chi2_tail(s, n), log_chi2_below(s, n)), row)
            for row, (n, s) in enumerate(zip(samples.tolist(), squares.tolist(), strict=True))
            if n
        ]
        if not cells or self._graphs < 2:
            return None
        log_p, row = min(cells)
        graph, agent = self._cell(row)
        ratio = float(squares[row] / samples[row])
        return Finding(
            self.test,
            min(0.0, log_p + math.log(2.0 * len(cells))),
            agent=agent,
            graph=graph,
            estimate=ratio,
            standard_error=ratio * math.sqrt(2.0 / samples[row]),
            expected=1.0,
        )

    def evidence(self) -> FloatArray:
        """(cells, K)."""
        return self._evidence(self.samples, self.squares)

    def _evidence(self, samples: IntArray, squares: FloatArray) -> FloatArray:
        """(..., cells, K), from sums (..., n, m)."""
        if self._graphs < 2:
            return np.empty((*samples.shape[:-2], 0, 1))
        return variance_evidence(self._rows(samples.astype(float)), self._rows(squares))

    def questions(self) -> list[Question]:
        """Noise of an agent, or of all, in a graph."""
        cells = [self._cell(row) for row in range(len(self._rows(self.squares)))]
        return [
            (f"noise of {'all agents' if agent is None else f'agent {agent + 1}'} in graph {{}}", (graph,))
            for graph, agent in cells
        ]

    def _rows(self, sums: FloatArray) -> FloatArray:
        """(..., cells): sums (..., n, m) of every cell, graph by graph the agents, then all of them."""
        each = sums[..., self._agents]
        if self._together:
            each = np.concatenate([each, each.sum(axis=-1, keepdims=True)], axis=-1)
        return each.reshape(*each.shape[:-2], -1)

    def _cell(self, row: int) -> tuple[int, int | None]:
        """Graph and agent of a cell."""
        graph, place = divmod(row, len(self._agents) + bool(self._together))
        return graph, int(self._agents[place]) if place < len(self._agents) else None
