# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of the noise: by graph, and over time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Self

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.dependence import LagSums, lag_evidence
from msg_analysis.inference.diagnostics import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.e_values import (
    EndedWindows,
    WindowEvidence,
    Windows,
    log_mean,
    variance_constant,
    variance_evidence,
)
from msg_analysis.inference.statistics import log_chi2_below, log_chi2_tail, normal_score


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


SHARE = 0.1  # of the logarithm of the p-value


class NoiseOverTime(Departure):
    """Squares of standardised innovations in windows of 1, 2, 4, ... steps, by agent and of all where independent.

    The sum over a window is chi-square. The law of the largest and the smallest is bounded by the union over windows:
    every length has the same share of the level, and within it every window and agent (weighted Bonferroni).

    A variance that swings faster than windows can show, or that depends on itself, is found by the correlation of the
    sums of single steps with those 1 to 100 steps before (McLeod and Li 1983), on normal scores, Phi^-1 of their
    chi-square distribution function, which are exactly N(0, 1). Windows and lags have half of the level each.
    """

    test = "innovations: noise over time"

    def __init__(self, law: Law) -> None:
        self._agents, self._together = np.flatnonzero(law.noisy), law.apart and law.noisy.sum() > 1
        columns = len(self._agents) + bool(self._together)
        self._columns = columns
        # Numbers in a window of one step.
        self._numbers = np.full(columns, law.replicas)
        if self._together:
            self._numbers[-1] *= len(self._agents)
        self._windows = Windows(law.planned, columns)
        self._evidence = WindowEvidence(self._windows, columns)
        self._lags = LagSums(columns, 1)
        levels = self._windows.levels
        self._sizes = self._numbers << np.arange(levels)[:, None]  # (levels, columns) numbers in a window
        self._known = variance_constant(self._sizes)  # (levels, columns, K)
        self._counts = np.zeros(levels, np.int64)  # windows of runs that were merged
        self._runs = 1
        # Largest and smallest sum of each length and column, the first step, and the run.
        shape = (2, levels, columns)
        self._extreme = np.stack([np.full((levels, columns), -np.inf), np.full((levels, columns), np.inf)])
        self._first, self._run = np.zeros(shape, np.int64), np.ones(shape, np.int64)

    def add(self, block: Block) -> FloatArray:
        """The windows that end in the block."""
        looks = block.looks
        if not self._columns:
            return np.empty((looks.count, 0, 1))
        squares = (block.white[:, self._agents] ** 2).sum(axis=2)
        if self._together:
            squares = np.column_stack([squares, squares.sum(axis=1)])
        lags = lag_evidence(*self._lags.add(normal_score(squares, self._numbers)[:, :, None], looks))
        ended = self._windows.add(squares)
        self._keep(ended)
        numbers, constant = (np.repeat(each[ended.levels], ended.counts, axis=0) for each in (self._sizes, self._known))
        mixed = log_mean(variance_evidence(numbers, ended.sums, constant), axis=-1)
        windows = self._evidence.add(ended, mixed, looks)
        return np.concatenate([windows, _mean_over_lags(lags)], axis=1)[:, :, None]

    def _keep(self, ended: EndedWindows) -> None:
        """Keep the most extreme windows, of this run."""
        ends = ended.begins + ended.counts
        for side, extreme in enumerate((np.maximum, np.minimum)):
            found = extreme.reduceat(ended.sums, ended.begins, axis=0)  # (L, columns)
            old = self._extreme[side, ended.levels]
            more = (found > old if side == 0 else found < old) | np.isnan(found)
            for row, column in np.argwhere(more).tolist():
                sums = ended.sums[ended.begins[row] : ends[row], column]
                at = int(sums.argmax() if side == 0 else sums.argmin())
                place = side, int(ended.levels[row]), column
                self._extreme[place], self._first[place] = sums[at], ended.first[ended.begins[row] + at]
                self._run[place] = 1

    def _take(self, side: int, level: int, sums: FloatArray, first: IntArray, run: IntArray) -> None:
        """Keep what is more extreme."""
        old = self._extreme[side, level]
        more = sums > old if side == 0 else sums < old
        more |= np.isnan(sums)
        self._extreme[side, level] = np.where(more, sums, old)
        self._first[side, level] = np.where(more, first, self._first[side, level])
        self._run[side, level] = np.where(more, run, self._run[side, level])

    def merge(self, other: Self) -> None:
        """No window goes over from one run to another."""
        levels = max(len(self._counts), len(other._counts))
        for each in (self, other):
            each._extend(levels)
        for side in range(2):
            for level in range(levels):
                place = other._first[side, level], other._run[side, level] + self._runs
                self._take(side, level, other._extreme[side, level], *place)
        self._counts += other._counts + other._seen(levels)
        self._runs += other._runs
        self._evidence.merge(other._evidence)
        self._lags.merge(other._lags)

    def _extend(self, levels: int) -> None:
        """Room for the lengths of longer runs."""
        more = levels - len(self._counts)
        self._counts = np.append(self._counts, np.zeros(more, np.int64))
        row = np.full((1, more, self._columns), np.inf)
        self._extreme = np.concatenate([self._extreme, np.concatenate([-row, row])], axis=1)
        widths = ((0, 0), (0, more), (0, 0))
        self._first, self._run = np.pad(self._first, widths), np.pad(self._run, widths, constant_values=1)

    def _seen(self, levels: int) -> IntArray:
        seen = self._windows.seen()
        return np.append(seen, np.zeros(levels - len(seen), np.int64))

    def finding(self) -> Finding | None:
        """The window or the lag, and the agent or all agents, whose noise is the least likely.

        A window is named, since it says where, even if a lag is clearer, but not where it says next to nothing.
        """
        window, lag = self._window(), self._lag()
        found = [one for one in (window, lag) if one]
        if not found:
            return None
        best = min(found, key=lambda one: one.log_p)
        named = window if window and window.log_p <= SHARE * best.log_p else best
        return replace(named, log_p=min(0.0, best.log_p + math.log(len(found))))

    def _agent(self, column: int) -> int | None:
        return int(self._agents[column]) if column < len(self._agents) else None

    def _lag(self) -> Finding | None:
        lag = self._lags.clearest()
        if lag is None:
            return None
        return Finding(
            self.test,
            lag.log_p,
            agent=self._agent(lag.column),
            span=(lag.steps, lag.steps),
            estimate=lag.coefficient,
            standard_error=lag.standard_error,
            expected=0.0,
        )

    def _window(self) -> Finding | None:
        counts = self._counts + self._seen(len(self._counts))
        lengths = np.flatnonzero(counts).tolist()
        if not lengths or not self._columns:
            return None
        candidates = []
        for level in lengths:
            share = math.log(2.0 * len(lengths) * float(counts[level]) * self._columns)
            for column, numbers in enumerate((self._numbers << level).tolist()):
                largest, smallest = self._extreme[:, level, column].tolist()
                tails = log_chi2_tail(largest, numbers), log_chi2_below(smallest, numbers)
                candidates += [(tail + share, level, column, side) for side, tail in enumerate(tails)]
        log_p, level, column, side = min(candidates)
        first, numbers = int(self._first[side, level, column]) + 1, int(self._numbers[column] << level)
        ratio = float(self._extreme[side, level, column] / numbers)
        return Finding(
            self.test,
            log_p,
            agent=self._agent(column),
            place=Place(first, first + (1 << level) - 1, int(self._run[side, level, column])),
            estimate=ratio,
            standard_error=ratio * math.sqrt(2.0 / numbers),
            expected=1.0,
        )

    def evidence(self) -> FloatArray:
        """(2 (agents + 1), 1): windows, then lags, of each agent and of all together."""
        lags = lag_evidence(self._lags.score, self._lags.information)
        return np.concatenate([self._evidence.logarithms(), _mean_over_lags(lags)])[:, None]

    def questions(self) -> list[Question]:
        """Noise of an agent, or of all, over time, and next to its own."""
        whose = [*(f"agent {agent + 1}" for agent in self._agents.tolist()), "all agents"][: self._columns]
        return [
            *((f"noise of {who} over time", ()) for who in whose),
            *((f"size of the noise of {who} and of its own earlier noise", ()) for who in whose),
        ]


def _mean_over_lags(evidence: FloatArray) -> FloatArray:
    """(..., columns): of evidence (..., columns, lags, K)."""
    return log_mean(evidence.reshape(*evidence.shape[:-2], math.prod(evidence.shape[-2:])), axis=-1)
