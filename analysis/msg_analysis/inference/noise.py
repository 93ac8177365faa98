# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the size of the noise: in all steps, by graph, over time, and of single residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.candidates import Cause, Selected, numbers_text
from msg_analysis.inference.dependence import LagSums, lag_evidence
from msg_analysis.inference.e_values import (
    EndedWindows,
    EventEvidence,
    WindowEvidence,
    Windows,
    log_mean,
    variance_constant,
    variance_evidence,
)
from msg_analysis.inference.question import (
    Block,
    Diagnostic,
    Finding,
    Law,
    Place,
    Question,
    RunningSums,
    Search,
    Statistics,
    Test,
    one_test,
)
from msg_analysis.inference.statistics import log_chi2_below, log_chi2_tail, log_normal_tail, normal_score


class Noise(Question):
    """Whether the covariance of the residuals is that of the noise."""

    name = "residuals: covariance"
    meaning = "the noise of some agents is larger, smaller, or correlated otherwise than in the file"
    main = True

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of the whole covariance."""
        return one_test(cls.name, run.residuals.p_covariance)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each agent whose noise is known to be independent over time."""
        agents = np.flatnonzero(self.law.noisy)
        return variance_evidence(sums.samples[:, agents], sums.squares[:, agents])

    def about(self, row: int) -> str:
        """An agent."""
        return f"noise of agent {np.flatnonzero(self.law.noisy)[row] + 1}"

    @classmethod
    def classes(cls, search: Search) -> int:
        """Agents, graphs, agents in graphs, all."""
        return len(search.any_noise.classes) if search.any_noise else 0

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Variances that explain the squares of the residuals."""
        return [_noise_words(one, search.names) for one in search.select(search.noise)]


def _noise_words(one: Selected, names: Sequence[str]) -> Cause:
    part, what = one.part, one.what
    agent = {"agent": what, "agent in graph": what[0] if part == "agent in graph" else None}.get(part)
    graph = {"graph": what, "agent in graph": what[1] if part == "agent in graph" else None}.get(part)
    name = None if graph is None else names[graph]
    whose = "the noise variance of all agents" if agent is None else f"agent {agent + 1}'s noise variance"
    where = "" if name is None else f" in graph {name}"
    factor, interval = math.exp(one.estimate), (math.exp(one.interval[0]), math.exp(one.interval[1]))
    words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
    number = None if agent is None else agent + 1
    return Cause("noise", words, number, None, name, factor, interval, 1.0, math.exp(one.log_p))


def _noise_cause(found: Finding, names: Sequence[str], p: float) -> Cause:
    """A noise variance in one graph, or in some steps."""
    agent, graph = None if found.agent is None else found.agent + 1, None if found.graph is None else names[found.graph]
    when = found.place.words if found.place else f"in graph {graph}"
    value, interval = found.estimate or 0.0, found.interval
    words = f"the noise variance of {found.whose} is {numbers_text(value, interval)} times what the file says {when}"
    return Cause("noise", words, agent, None, graph, value, interval, found.expected, p, found.steps)


class NoiseByGraph(Diagnostic):
    """Squares of standardised residuals by graph and agent, and of all agents together where these are independent.

    Each sum is chi-square; the test is two-sided, with the number of sums as a factor (Bonferroni).
    """

    name = "residuals: noise by graph"
    meaning = "the size of the noise is wrong under some graph"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        n, m = law.step.modes, law.step.agents
        self._agents, self._together = np.flatnonzero(law.noisy), law.apart and law.noisy.sum() > 1
        self._graphs = n
        self.samples, self.squares = np.zeros((n, m), np.int64), np.zeros((n, m))

    def add(self, block: Block) -> FloatArray:
        """Every agent by the graph that it used."""
        size, analyses = (block.white**2).sum(axis=2), block.analyses
        there = [block.reception.graphs == graph for graph in range(self._graphs)]
        samples = np.stack([analyses.counts(each) for each in there], axis=1) * block.white.shape[2]  # (T, n, m)
        squares = np.stack([analyses.sums(size * each) for each in there], axis=1)
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
            min(0.0, log_p + math.log(2.0 * len(cells))),
            agent=agent,
            graph=graph,
            estimate=ratio,
            standard_error=ratio * math.sqrt(2.0 / samples[row]),
            expected=1.0,
        )

    def logarithms(self) -> FloatArray:
        """(cells, K)."""
        return self._evidence(self.samples, self.squares)

    def _evidence(self, samples: IntArray, squares: FloatArray) -> FloatArray:
        """(..., cells, K), from sums (..., n, m)."""
        if self._graphs < 2:
            return np.empty((*samples.shape[:-2], 0, 1))
        return variance_evidence(self._rows(samples.astype(float)), self._rows(squares))

    def about(self, row: int) -> str:
        """Noise of an agent, or of all, in a graph."""
        graph, agent = self._cell(row)
        return f"noise of {'all agents' if agent is None else f'agent {agent + 1}'} in graph {self.law.graphs[graph]}"

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

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], p: float) -> Cause:
        """A variance in one graph."""
        return _noise_cause(found, names, p)


SHARE = 0.1  # of the logarithm of the p-value


class NoiseOverTime(Diagnostic):
    """Squares of standardised residuals in windows of 1, 2, 4, ... steps, by agent and of all where independent.

    The sum over a window is chi-square. The law of the largest and the smallest is bounded by the union over windows:
    every length has the same share of the level, and within it every window and agent (weighted Bonferroni).

    A variance that swings faster than windows can show, or that depends on itself, is found by the correlation of the
    sums of single steps with those 1 to 100 steps before (McLeod and Li 1983), on normal scores, Phi^-1 of their
    chi-square distribution function, which are exactly N(0, 1). Windows and lags have half of the level each.
    """

    name = "residuals: noise over time"
    meaning = "the size of the noise is wrong in a part of the run, or changes with time"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
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
        analyses = block.analyses
        if not self._columns:
            return np.empty((analyses.count, 0, 1))
        squares = (block.white[:, self._agents] ** 2).sum(axis=2)
        if self._together:
            squares = np.column_stack([squares, squares.sum(axis=1)])
        lags = lag_evidence(*self._lags.add(normal_score(squares, self._numbers)[:, :, None], analyses))
        ended = self._windows.add(squares)
        self._keep(ended)
        numbers, constant = (np.repeat(each[ended.levels], ended.counts, axis=0) for each in (self._sizes, self._known))
        mixed = log_mean(variance_evidence(numbers, ended.sums, constant), axis=-1)
        windows = self._evidence.add(ended, mixed, analyses)
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
            log_p,
            agent=self._agent(column),
            place=Place(first, first + (1 << level) - 1, int(self._run[side, level, column])),
            estimate=ratio,
            standard_error=ratio * math.sqrt(2.0 / numbers),
            expected=1.0,
        )

    def logarithms(self) -> FloatArray:
        """(2 (agents + 1), 1): windows, then lags, of each agent and of all together."""
        lags = lag_evidence(self._lags.score, self._lags.information)
        return np.concatenate([self._evidence.logarithms(), _mean_over_lags(lags)])[:, None]

    def about(self, row: int) -> str:
        """Noise of an agent, or of all, over time, and next to its own."""
        lags, column = divmod(row, self._columns)
        agent = self._agent(column)
        who = "all agents" if agent is None else f"agent {agent + 1}"
        return f"size of the noise of {who} and of its own earlier noise" if lags else f"noise of {who} over time"

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], p: float) -> Cause:
        """A variance in some steps, or one that depends on its own past."""
        if found.span is None:
            return _noise_cause(found, names, p)
        value, interval = found.estimate or 0.0, found.interval
        words = (
            f"the size of the noise of {found.whose} has correlation {numbers_text(value, interval)} with its own "
            f"{found.span[0]} steps before, not 0: its variance changes in time"
        )
        agent = None if found.agent is None else found.agent + 1
        return Cause("noise", words, agent, None, None, value, interval, found.expected, p)


def _mean_over_lags(evidence: FloatArray) -> FloatArray:
    """(..., columns): of evidence (..., columns, lags, K)."""
    return log_mean(evidence.reshape(*evidence.shape[:-2], math.prod(evidence.shape[-2:])), axis=-1)


LARGE = 4.0  # standard deviations; smaller residuals have the evidence 0


class LargestResidual(Diagnostic):
    """Every residual by itself, N(0, 1) after division by its standard deviation.

    The test is that of the largest, with their number as a factor (Bonferroni). The evidence is the mean over all
    residuals of a run of that of each one against a larger variance; those to come count 1. Half of the whole always
    counts 1.
    """

    name = "residuals: largest"
    meaning = "a single step is much larger than the noise"
    subject = "largest residual"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._agents = np.flatnonzero(law.noisy)
        self._evidence = EventEvidence(law.planned * law.replicas * len(self._agents))
        self._samples = 0
        self._largest, self._agent, self._place, self._runs = 0.0, 0, Place(0, 0), 1

    def add(self, block: Block) -> FloatArray:
        """Add the residuals of a block."""
        white, analyses = block.white[:, self._agents], block.analyses
        if not white.size:
            return np.empty((analyses.count, 0, 1))
        self._samples += white.size
        sizes = np.abs(white)
        large = sizes > LARGE
        logarithms = variance_evidence(np.ones(int(large.sum())), sizes[large] ** 2)[:, 0]
        seen, when = analyses.lengths * white[0].size, analyses.after(np.nonzero(large)[0])
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
        return Finding(min(0.0, log_p), agent=self._agent, place=self._place, estimate=self._largest, expected=0.0)

    def logarithms(self) -> FloatArray:
        """(1, 1)."""
        return np.array([[self._evidence.logarithm()]]) if self._evidence.planned else np.empty((0, 1))

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], p: float) -> Cause:
        """An agent in a step."""
        assert found.place is not None
        assert found.agent is not None
        del names
        value = found.estimate or 0.0
        words = f"{found.whose}'s noise is {value:.3g} standard deviations {found.place.words}"
        return Cause("outlier", words, found.agent + 1, None, None, value, None, found.expected, p, found.steps)
