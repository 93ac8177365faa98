# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the graphs: transitions, holding times, and their names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Self

import numpy as np
from scipy.special import xlogy

from msg_analysis.common.arrays import AnyArray, FloatArray, IntArray
from msg_analysis.experiment.markov_chain import MarkovChain, stationary_law
from msg_analysis.inference.candidates import Cause, Rate, find_rates, numbers_text
from msg_analysis.inference.e_values import (
    WindowEvidence,
    Windows,
    log_mean,
    proportion_constant,
    proportion_evidence,
    row_evidence,
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
)
from msg_analysis.inference.statistics import log_chi2_tail


class Switching(Question):
    """Whether the graphs follow the Markov chain."""

    name = "switching"
    meaning = "the graphs do not switch with the rates or probabilities of the file"
    main = True
    p_value = attrgetter("p_switching")

    def number_of_tests(self) -> int:
        """None with one graph."""
        return int(self.law.step.modes > 1)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each graph that is left some time, and one for all: rows are independent of each other."""
        left = self._left
        if not len(left):
            return super().evidence(sums)
        each = row_evidence(sums.counts, self.law.step.transition)[:, left]
        return np.concatenate([each, each.sum(axis=1, keepdims=True)], axis=1)

    def about(self, row: int) -> str:
        """A graph, or all."""
        return f"switching away from {self.law.graphs[self._left[row]]}" if row < len(self._left) else "switching"

    @property
    def _left(self) -> IntArray:
        return np.flatnonzero(np.diag(self.law.step.transition) < 1.0)

    @classmethod
    def classes(cls, search: Search) -> int:
        """Jumps, graphs that are left, all."""
        del search
        return 3

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Jumps that the law excludes; else rates, or in discrete time probabilities, that explain the transitions."""
        names, counts, experiment = search.names, search.transitions.counts, search.experiment
        excluded = (counts > 0) & (experiment.chain.transition(experiment.step_length) == 0.0)
        found = []
        for g, h in np.argwhere(excluded).tolist():
            number, pair = float(counts[g, h]), [names[g], names[h]]
            words = f"the graph jumped {counts[g, h]} times from {pair[0]} to {pair[1]}, which the law excludes"
            found.append(Cause("switching", words, graph=pair, estimate=number, expected=0.0, p=0.0))
        if found:
            return found
        rates = find_rates(counts, experiment.chain, experiment.step_length, search.families, search.level)
        return [_rate_cause(rate, experiment.chain, names) for rate in rates]


def _rate_cause(rate: Rate, chain: MarkovChain, names: Sequence[str]) -> Cause:
    one, several = ("rate", "rates") if chain.time == "continuous" else ("probability", "probabilities")
    (low, high), expected, where = rate.interval, 1.0, None
    if len(rate.jumps) == 1:
        (g, h), where = rate.jumps[0], [names[graph] for graph in rate.jumps[0]]
        expected = float(chain.matrix[g, h])
    elif rate.origin is not None:
        where = [names[rate.origin]]
    estimate, interval = rate.factor * expected, (low * expected, high * expected)
    numbers = numbers_text(estimate, interval)
    if where is None:
        words = f"all {several} of switching are {numbers} times what the file says"
    elif len(where) == 1:
        words = f"the {several} of switching away from {where[0]} are {numbers} times what the file says"
    else:
        words = f"the {one} of switching from {where[0]} to {where[1]} is {numbers}, not {expected:.3g}"
    return Cause("switching", words, None, None, where, estimate, interval, expected, math.exp(rate.log_p))


PARTS = 8  # of the ages of a holding time, with as nearly as steps allow the same share of the ends of holding times
JOINED = (1, 2, 4)  # parts that are one in the evidence: many parts cost evidence, few hide a deviation
MIN_EXPECTED = 15.0  # fewest steps with, and fewest without, a switch in a part, for the chi-square law


class HoldingTimes(SummedDiagnostic):
    """Switches counted by graph and by the age of the holding time, in parts.

    Likelihood ratio of one probability for each part against a common one, whatever that is: rates have their own test.
    """

    name = "holding times"
    meaning = "the time for which a graph stays depends on how long it has stayed: the chain is not Markov"
    kind = "holding times"
    about_chain = True

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._transition = law.step.transition
        self._leaving = 1.0 - np.diag(self._transition)
        self._left = np.flatnonzero((self._leaving > 0.0) & (self._leaving < 1.0))  # graphs that are asked about
        self._edges = [_edges(float(p)) for p in self._leaving]  # ages at which the parts 1, 2, ... begin
        self.sums = list(np.zeros((2, law.step.modes, PARTS), np.int64))  # steps, and those that left their graph
        self._known = proportion_constant(self._leaving[self._left, None])  # (G, 1, K)
        self._age = 0  # of the holding time at the step that comes next

    def between(self, block: Block) -> list[AnyArray]:
        """Steps to the second, third, ... of the graphs of a block, and those that left theirs, (T, n, PARTS) each."""
        graphs, analyses = block.graphs, block.analyses
        now, left = graphs[:-1], graphs[1:] != graphs[:-1]
        shape = analyses.count, len(self._edges), PARTS
        if not len(now):
            return list(np.zeros((2, *shape), np.int64))
        index = np.arange(len(now))
        begin = np.maximum.accumulate(np.where(np.append(True, left[:-1]), index, 0))
        age = index - begin + np.where(begin == 0, self._age, 0)
        self._age = 0 if left[-1] else int(age[-1]) + 1
        place = (analyses.after(index) * shape[1] + now) * PARTS
        for graph in np.unique(now).tolist():
            at = now == graph
            place[at] += np.searchsorted(self._edges[graph], age[at], side="right")
        return [np.bincount(which, minlength=math.prod(shape)).reshape(shape) for which in (place, place[left])]

    def finding(self) -> Finding | None:
        """The graph and the part whose switches are furthest from the share that is usual in the graph."""
        all_steps, all_left = self.sums
        visits = float(all_steps.sum()) * stationary_law(self._transition)
        statistic, dof, clearest, found = 0.0, 0, -1.0, Finding(0.0)
        for graph, p in enumerate(self._leaving.tolist()):
            groups = _joined(visits[graph], p, self._edges[graph])
            steps = np.add.reduceat(all_steps[graph], groups).astype(float)
            left = np.add.reduceat(all_left[graph], groups).astype(float)
            if len(groups) < 2 or not 0 < left.sum() < steps.sum():
                continue
            statistic += 2.0 * (_log_likelihood(left, steps) - _log_likelihood(left.sum(), steps.sum()))
            dof += len(groups) - 1
            common = left.sum() / steps.sum()
            z = np.abs(left - steps * common) / np.sqrt(np.maximum(steps, 1.0) * common * (1.0 - common))
            part = int(np.argmax(z))
            if z[part] > clearest:
                clearest, begins = float(z[part]), np.append(0, self._edges[graph])[groups].tolist()
                share = float(left[part] / max(steps[part], 1.0))
                found = Finding(
                    0.0,
                    graph=graph,
                    span=(begins[part] + 1, begins[part + 1] if part + 1 < len(begins) else None),
                    estimate=share,
                    standard_error=math.sqrt(share * (1.0 - share) / max(steps[part], 1.0)),
                    expected=p,
                )
        return replace(found, log_p=log_chi2_tail(statistic, dof)) if dof else None

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., G + 1, K): of each graph that is left, and of all, from counts (..., n, PARTS)."""
        if not len(self._left):
            return np.empty((*sums[0].shape[:-2], 0, 1))
        # Given the past, every part is a binomial question of its own, so the product of their evidence is evidence.
        steps, left = (
            np.concatenate([each.reshape(*each.shape[:-1], -1, joined).sum(axis=-1) for joined in JOINED], axis=-1)
            for each in (counts[..., self._left, :] for counts in sums)
        )  # (..., G, 8 + 4 + 2)
        each = proportion_evidence(left, steps, self._leaving[self._left, None], self._known)
        ends = np.cumsum([PARTS // joined for joined in JOINED])
        parts = np.concatenate([group.sum(axis=-2) for group in np.split(each, ends[:-1], axis=-2)], axis=-1)
        return np.concatenate([parts, parts.sum(axis=-2, keepdims=True)], axis=-2)

    def about(self, row: int) -> str:
        """Holding times of a graph, or all."""
        return f"holding times of {self.law.graphs[self._left[row]]}" if row < len(self._left) else "holding times"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A probability of leaving a graph that depends on the time for which it has stayed."""
        assert found.span is not None
        assert found.graph is not None
        first, last = found.span
        part = f"from step {first:,} of it on" if last is None else f"in steps {first:,} to {last:,} of it"
        part = f"in step {first:,} of it" if first == last else part
        return (
            f"the probability of leaving graph {names[found.graph]} depends on how long it has lasted: it is "
            f"{found.numbers} {part}, not {found.expected:.3g}"
        )


def _edges(leaving: float) -> IntArray:
    """(PARTS - 1,) ages at which 1/8, 2/8, ... of the holding times have ended."""
    if not 0.0 < leaving < 1.0:
        return np.full(PARTS - 1, np.iinfo(np.int64).max)
    shares = np.arange(1, PARTS) / PARTS
    return np.ceil(np.log1p(-shares) / math.log1p(-leaving)).astype(np.int64)


def _joined(visits: float, leaving: float, edges: IntArray) -> IntArray:
    """First part of every group of parts in which enough switches are expected of so many steps in the graph."""
    if not 0.0 < leaving < 1.0:
        return np.zeros(1, np.int64)
    survive = (1.0 - leaving) ** np.append(0.0, edges.astype(float))
    ends = visits * leaving * -np.diff(np.append(survive, 0.0))  # expected ends of holding times
    rare = ends * min(1.0, (1.0 - leaving) / leaving)
    groups, gathered = [0], 0.0
    for part, expected in enumerate(rare.tolist()):
        if gathered >= MIN_EXPECTED and rare[part:].sum() >= MIN_EXPECTED:
            groups.append(part)
            gathered = 0.0
        gathered += expected
    return np.array(groups)


def _log_likelihood(left: FloatArray, steps: FloatArray) -> float:
    """Of the shares that fit best, summed over the parts."""
    share = left / np.maximum(steps, 1.0)
    return float((xlogy(left, share) + xlogy(steps - left, 1.0 - share)).sum())


MOST_GRAPHS = 20  # of a law for which this is tested


class SwappedGraphs(Diagnostic):
    """Likelihood ratios of two graphs whose names are swapped, in windows of 1, 2, 4, ... steps, for every pair."""

    name = "residuals: swapped graphs"
    meaning = "two graphs have each other's name in the log"
    kind = "graph"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._step = step = law.step
        tested = law.plain and law.apart and law.noisy.all() and step.modes <= MOST_GRAPHS
        self._pairs: IntArray = np.column_stack(np.triu_indices(step.modes if tested else 0, 1))  # (P, 2)
        self._deviation = np.sqrt(np.einsum("gik,gik->gi", step.noise_gain, step.noise_gain))  # (n, m)
        self._windows = Windows(law.planned, len(self._pairs))
        self._evidence = WindowEvidence(self._windows, len(self._pairs))
        self._best = Largest(-np.inf, (0, 0))

    def add(self, block: Block) -> FloatArray:
        """The windows that end in the block."""
        if not len(self._pairs):
            return np.empty((block.analyses.count, 0, 1))
        # The product over the steps of a window is evidence, so is the mean over windows and pairs; 1 / it is the p.
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
        evidence = self._evidence.add(ended, ended.sums, block.analyses)
        values = ended.sums - np.log(self._windows.planned[level])[:, None]
        at, pair = np.unravel_index(int(np.argmax(values)), values.shape)
        start = int(ended.first[at]) + 1
        place = Place(start, start + (1 << int(level[at])) - 1)
        self._best.take(float(values[at, pair]), tuple(self._pairs[pair].tolist()), place)
        return evidence[:, :, None]

    def merge(self, other: Self) -> None:
        """The window with more evidence."""
        self._evidence.merge(other._evidence)
        self._best.merge(other._best)

    def finding(self) -> Finding | None:
        """The window and the pair with the most evidence."""
        if not len(self._pairs) or not self._windows.steps:
            return None
        graph, other = map(int, self._best.of)
        log_p = -float(log_mean(self._evidence.logarithms()))
        return Finding(min(0.0, log_p), graph=graph, other=other, place=self._best.place)

    def logarithms(self) -> FloatArray:
        """(pairs, 1)."""
        return self._evidence.logarithms()[:, None]

    def about(self, row: int) -> str:
        """Two graphs."""
        first, second = (self.law.graphs[graph] for graph in self._pairs[row].tolist())
        return f"names of the graphs {first} and {second} swapped"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """Two names."""
        pair = " and ".join(names[graph] for graph in (found.graph, found.other) if graph is not None)
        words = f"the log has the names of the graphs {pair} swapped"
        return f"{words} {found.place.words}" if found.place else words


def _log_density(white: FloatArray, deviation: FloatArray) -> FloatArray:
    """(b,) log density of all residuals of a step but for a constant; standardised ones (b, m, R)."""
    return np.asarray(-0.5 * (white**2).sum(axis=(1, 2)) - white.shape[2] * np.log(deviation).sum(axis=-1))
