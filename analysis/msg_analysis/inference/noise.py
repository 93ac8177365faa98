# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the size of the noise: in all steps, by graph, over time, and of single residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, Self

import numpy as np

from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.inference.candidates import Cause, Selected, numbers_text
from msg_analysis.inference.dependence import LagSums, SingleEvents, lag_evidence
from msg_analysis.inference.e_values import (
    EndedWindows,
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
    Largest,
    Law,
    Place,
    Question,
    RunningSums,
    Search,
    SummedDiagnostic,
    agent_words,
)
from msg_analysis.inference.statistics import (
    chi2_quantile,
    log_chi2_below,
    log_chi2_tail,
    log_normal_tail,
    normal_score,
)


class Noise(Question):
    """Whether the covariance of the residuals is that of the noise."""

    name = "residuals: covariance"
    meaning = "the noise of some agents is larger, smaller, or correlated otherwise than in the file"
    main = True
    p_value = attrgetter("residuals.p_covariance")
    parameters = "noise"

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each agent whose noise is known to be independent over time."""
        agents = np.flatnonzero(self.law.noisy)
        return variance_evidence(sums.samples[:, agents], sums.squares[:, agents])

    def about(self, row: int) -> str:
        """An agent."""
        return f"noise of agent {np.flatnonzero(self.law.noisy)[row] + 1}"

    @classmethod
    def cause_of(cls, one: Selected, search: Search) -> Cause:
        """A variance that explains the squares of the residuals."""
        agent, graph = one.what if one.part == "agent in graph" else (None, None)
        agent = one.what if one.part == "agent" else agent
        graph = one.what if one.part == "graph" else graph
        name = None if graph is None else search.names[graph]
        whose = "the noise variance of all agents" if agent is None else f"agent {agent + 1}'s noise variance"
        where = "" if name is None else f" in graph {name}"
        factor, interval = one.factor
        words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
        number = None if agent is None else agent + 1
        return Cause("noise", words, number, None, name, factor, interval, 1.0, math.exp(one.log_p))


class NoiseByGraph(SummedDiagnostic):
    """Squares of standardised residuals, chi-square, by graph and agent, and of all agents together."""

    name = "residuals: noise by graph"
    meaning = "the size of the noise is wrong under some graph"
    kind = "noise"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        shape = law.step.modes, law.step.agents
        self.sums = [np.zeros(shape, np.int64), np.zeros(shape)]  # samples, squares

    def between(self, block: Block) -> list[AnyArray]:
        """Every agent by the graph that it used."""
        size, analyses = (block.white**2).sum(axis=2), block.analyses
        shape = analyses.count, *self.sums[0].shape
        samples, squares = np.zeros(shape, np.int64), np.zeros(shape)
        for graph in np.unique(block.reception.graphs).tolist():
            there = block.reception.graphs == graph
            samples[:, graph] = analyses.counts(there) * block.white.shape[2]
            squares[:, graph] = analyses.sums(size * there)
        return [samples, squares]

    def finding(self) -> Finding | None:
        """The graph and the agent, or all agents, whose variance is furthest from that of the law."""
        samples, squares = (self._cells(each) for each in self.sums)
        cells = [
            (min(log_chi2_tail(s, n), log_chi2_below(s, n)), row)
            for row, (n, s) in enumerate(zip(samples.tolist(), squares.tolist(), strict=True))
            if n
        ]
        if not cells or self.law.step.modes < 2:
            return None
        log_p, row = min(cells)
        graph, agent = self._place(row)
        ratio = float(squares[row] / samples[row])
        log_p = min(0.0, log_p + math.log(2.0 * len(cells)))
        return _variance_finding(log_p, ratio, samples[row], agent, graph=graph)

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., cells, K), from sums (..., n, m)."""
        if self.law.step.modes < 2:
            return np.empty((*sums[0].shape[:-2], 0, 1))
        return variance_evidence(*(self._cells(each) for each in sums))

    def about(self, row: int) -> str:
        """Noise of an agent, or of all, in a graph."""
        graph, agent = self._place(row)
        return f"noise of {agent_words(agent)} in graph {self.law.graphs[graph]}"

    def _cells(self, sums: AnyArray) -> FloatArray:
        """(..., cells): sums (..., n, m) of every cell, graph by graph the agents, then all of them."""
        each = self.columns(sums[..., self.agents].astype(float))
        return each.reshape(*each.shape[:-2], -1)

    def _place(self, cell: int) -> tuple[int, int | None]:
        """Graph and agent of a cell."""
        graph, column = divmod(cell, len(self.agents) + self.together)
        return graph, self.agent(column)

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A variance in one graph, or in some steps."""
        when = found.place.words if found.place else f"in graph {names[found.graph or 0]}"
        whose = agent_words(found.agent)
        return f"the noise variance of {whose} is {found.numbers} times what the file says {when}"


def _variance_finding(log_p: float, ratio: float, numbers: float, agent: int | None, **place: Any) -> Finding:
    """A sum of squares over its expectation, of so many numbers, which are normal: the interval is exact."""
    error, squares = ratio * math.sqrt(2.0 / numbers), ratio * numbers
    ends = squares / float(chi2_quantile(0.025, numbers)), squares / float(chi2_quantile(0.975, numbers))
    return Finding(log_p, agent, estimate=ratio, standard_error=error, expected=1.0, ends=ends, **place)


SHARE = 0.1  # of the logarithm of the p-value
LEVELS = 63  # lengths of windows, of any run


class NoiseOverTime(Diagnostic):
    """Squares of standardised residuals in windows of 1, 2, 4, ... steps, and their correlation with earlier ones."""

    name = "residuals: noise over time"
    meaning = "the size of the noise is wrong in a part of the run, or changes with time"
    kind = "noise"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._numbers = self.columns(np.full(len(self.agents), law.replicas))  # in a window of one step
        self._columns = columns = len(self._numbers)
        self._windows = Windows(law.planned, columns)
        self._evidence = WindowEvidence(self._windows, columns)
        self._lags = LagSums(columns, 1)
        self._sizes = self._numbers << np.arange(self._windows.levels)[:, None]  # (levels, columns) numbers in a window
        # Rounding makes a small sum of squares smaller than it is, or 0.
        self._rounding = law.rounding[self.agents]
        if self.together:
            self._rounding = np.append(self._rounding, self._rounding.max())
        self._known = variance_constant(self._sizes)  # (K, levels, columns)
        self._counts = np.zeros(LEVELS, np.int64)  # windows of runs that were merged
        self._runs = 1
        # Largest sum, and largest of minus the sums, of each length and column, the first step, and the run.
        shape = (2, LEVELS, columns)
        self._extreme = np.full(shape, -np.inf)
        self._first, self._run = np.zeros(shape, np.int64), np.ones(shape, np.int64)

    def add(self, block: Block) -> FloatArray:
        """The windows that end in the block."""
        analyses = block.analyses
        if not self._columns:
            return np.empty((analyses.count, 0, 1))
        squares = self.columns((block.white[:, self.agents] ** 2).sum(axis=2))
        # Of a variance that depends on itself (McLeod and Li 1983), on normal scores, which are exactly N(0, 1).
        lags = lag_evidence(*self._lags.add(normal_score(squares, self._numbers)[:, :, None], analyses))
        ended = self._windows.add(squares)
        self._keep(ended)
        levels = ended.level
        numbers, constant = self._sizes[levels], self._known[:, levels]
        mixed = log_mean(variance_evidence(numbers, ended.sums, constant), axis=-1)
        windows = self._evidence.add(ended, mixed, analyses)
        return np.concatenate([windows, _mean_over_lags(lags)], axis=1)[:, :, None]

    def _keep(self, ended: EndedWindows) -> None:
        """Keep the most extreme windows, of this run."""
        ends = ended.begins + ended.counts
        for side, sums in enumerate((ended.sums, -ended.sums)):
            found = np.maximum.reduceat(sums, ended.begins, axis=0)  # (L, columns)
            for row, column in np.argwhere(_more(found, self._extreme[side, ended.levels])).tolist():
                at = ended.begins[row] + int(sums[ended.begins[row] : ends[row], column].argmax())
                place = side, int(ended.levels[row]), column
                self._extreme[place], self._first[place], self._run[place] = sums[at, column], ended.first[at], 1

    def merge(self, other: Self) -> None:
        """The more extreme windows."""
        more = _more(other._extreme, self._extreme)
        np.copyto(self._extreme, other._extreme, where=more)
        np.copyto(self._first, other._first, where=more)
        np.copyto(self._run, other._run + self._runs, where=more)
        self._counts += other._seen()
        self._runs += other._runs
        self._evidence.merge(other._evidence)
        self._lags.merge(other._lags)

    def _seen(self) -> IntArray:
        """(LEVELS,): windows that have ended, in all runs."""
        seen = self._windows.seen()
        return np.asarray(self._counts + np.pad(seen, (0, LEVELS - len(seen))))

    def finding(self) -> Finding | None:
        """The window or the lag, and the agent or all agents, whose noise is the least likely."""
        window, lag = self._window(), self._lags.clearest()
        found = [window] if window else []
        if lag:
            found.append(replace(lag, agent=self.agent(lag.agent or 0)))
        if not found:
            return None
        best = min(found, key=lambda one: one.log_p)
        # A window says where, even if a lag is clearer, but not one that says next to nothing.
        named = window if window and window.log_p <= SHARE * best.log_p else best
        return replace(named, log_p=min(0.0, best.log_p + math.log(len(found))))

    def _window(self) -> Finding | None:
        counts = self._seen()
        lengths = np.flatnonzero(counts).tolist()
        if not lengths or not self._columns:
            return None
        candidates = []
        for level in lengths:
            # Every length has the same share of the level, and within it every window and agent (weighted Bonferroni).
            share = math.log(2.0 * len(lengths) * float(counts[level]) * self._columns)
            for column, numbers in enumerate((self._numbers << level).tolist()):
                largest, smallest = self._extreme[:, level, column].tolist()
                least = (math.sqrt(-smallest) + float(self._rounding[column]) * math.sqrt(numbers)) ** 2
                tails = log_chi2_tail(largest, numbers), log_chi2_below(least, numbers)
                candidates += [(tail + share, level, column, side) for side, tail in enumerate(tails)]
        log_p, level, column, side = min(candidates)
        first, numbers = int(self._first[side, level, column]) + 1, int(self._numbers[column] << level)
        ratio = abs(float(self._extreme[side, level, column])) / numbers
        place = Place(first, first + (1 << level) - 1, int(self._run[side, level, column]))
        return _variance_finding(log_p, ratio, numbers, self.agent(column), place=place)

    def logarithms(self) -> FloatArray:
        """(2 (agents + 1), 1): windows, then lags, of each agent and of all together."""
        lags = lag_evidence(self._lags.score, self._lags.information)
        return np.concatenate([self._evidence.logarithms(), _mean_over_lags(lags)])[:, None]

    def about(self, row: int) -> str:
        """Noise of an agent, or of all, over time, and next to its own."""
        lags, column = divmod(row, self._columns)
        who = agent_words(self.agent(column))
        return f"size of the noise of {who} and of its own earlier noise" if lags else f"noise of {who} over time"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A variance in some steps, or one that depends on its own past."""
        if found.span is None:
            return NoiseByGraph.words(found, names)
        return (
            f"the size of the noise of {agent_words(found.agent)} has correlation {found.numbers} with its own "
            f"{found.span[0]} steps before, not 0: its variance changes in time"
        )


def _more(new: FloatArray, old: FloatArray) -> BoolArray:
    """Where it is larger, or not a number."""
    return np.asarray((new > old) | np.isnan(new))


def _mean_over_lags(evidence: FloatArray) -> FloatArray:
    """(..., columns): of evidence (..., columns, lags, K)."""
    return log_mean(evidence.reshape(*evidence.shape[:-2], math.prod(evidence.shape[-2:])), axis=-1)


LARGE = 4.0  # standard deviations; smaller residuals have the evidence 0


class LargestResidual(SingleEvents):
    """Every residual by itself, N(0, 1) over its standard deviation; the test is that of the largest."""

    name = "residuals: largest"
    meaning = "a single step is much larger than the noise"
    subject = "largest residual"
    kind = "outlier"

    def __init__(self, law: Law) -> None:
        super().__init__(law, law.replicas * int(law.noisy.sum()), Largest(of=(0, 0.0)))  # agent, signed residual
        self._samples = 0

    def add(self, block: Block) -> FloatArray:
        """Add the residuals of a block."""
        white, analyses = block.white[:, self.agents], block.analyses
        if not white.size:
            return np.empty((analyses.count, 0, 1))
        self._samples += white.size
        sizes = np.abs(white)
        large = sizes > LARGE
        logarithms = variance_evidence(np.ones(int(large.sum())), sizes[large] ** 2)[:, 0]
        seen, when = analyses.lengths * white[0].size, analyses.after(np.nonzero(large)[0])
        step, column, replica = np.unravel_index(int(np.argmax(sizes)), white.shape)
        at, number = (step, column, replica), block.first + int(step) + 1
        self.largest.take(float(sizes[at]), (self.agents[column], float(white[at])), Place(number, number))
        return self.seen.add(seen, logarithms, when)[:, None, None]

    def merge(self, other: Self) -> None:
        """The larger one."""
        super().merge(other)
        self._samples += other._samples

    def finding(self) -> Finding | None:
        """The largest."""
        if not self._samples:
            return None
        log_p = math.log(2.0 * self._samples) + float(log_normal_tail(self.largest.value))
        agent, residual = self.largest.of
        return Finding(min(0.0, log_p), int(agent), place=self.largest.place, estimate=residual, expected=0.0)

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """An agent in a step."""
        del names
        assert found.place is not None
        value = found.estimate or 0.0
        return f"{agent_words(found.agent)}'s noise is {value:.3g} standard deviations {found.place.words}"
