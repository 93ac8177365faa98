# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the graphs: transitions, holding times, and the graph before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np
from scipy.special import xlogy

from msg_analysis.common.arrays import AnyArray, FloatArray, IntArray
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule, stationary_law
from msg_analysis.inference.candidates import Cause, Rate, find_rates, numbers_text
from msg_analysis.inference.counts import likelihood_ratio
from msg_analysis.inference.e_values import proportion_evidence, row_evidence
from msg_analysis.inference.question import Block, Finding, Law, Question, RunningSums, Search, SummedDiagnostic
from msg_analysis.inference.statistics import binomial_interval, log_chi2_tail
from msg_analysis.model.step_model import Wiring


class Switching(Question):
    """Whether the graphs follow the Markov chain."""

    name = "switching"
    meaning = "the graphs do not switch with the rates or probabilities of the file"
    main = True
    about_chain = True
    p_value = attrgetter("p_switching")

    def number_of_tests(self) -> int:
        """None with one graph, or with a schedule."""
        return int(len(self._left) > 0)

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
        return np.flatnonzero(_leaving(self.law.step))

    @classmethod
    def classes(cls, search: Search) -> int:
        """Jumps, graphs that are left, all."""
        del search
        return 3

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Jumps that the law excludes; else rates, or in discrete time probabilities, that explain the transitions."""
        if search.transitions is None:
            return []
        names, counts, experiment = search.names, search.transitions.counts, search.experiment
        transition = experiment.chain.transition(experiment.step_length)
        if search.renamed:  # the log's names may be wrong, or those of the steps: the chain says which
            meant = np.zeros_like(counts)
            meant[np.ix_(search.renamed, search.renamed)] = counts
            counts = min((counts, meant), key=lambda each: _unlikely(each, transition))
        excluded = (counts > 0) & (transition == 0.0)
        found = []
        for g, h in np.argwhere(excluded).tolist():
            number, pair = float(counts[g, h]), [names[g], names[h]]
            words = f"the graph jumped {counts[g, h]} times from {pair[0]} to {pair[1]}, which the law excludes"
            found.append(Cause("switching", words, graph=pair, estimate=number, expected=0.0, p=0.0))
        if found:
            return found
        rates = find_rates(counts, experiment.chain, experiment.step_length, search.families, search.level)
        return [_rate_cause(rate, experiment.chain, names) for rate in rates]


def _unlikely(counts: IntArray, transition: FloatArray) -> float:
    return math.inf if counts[transition == 0.0].any() else float(likelihood_ratio(counts, transition))


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
    p = math.exp(rate.log_p)
    return Cause("switching", words, None, None, where, estimate, interval, expected, p, log_p=rate.log_p)


def _leaving(step: Wiring) -> FloatArray:
    """(n,) probability that a step is the last one in its graph; 0 where there is a schedule."""
    return np.zeros(step.modes) if isinstance(step.switching, Schedule) else 1.0 - np.diag(step.transition)


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
        self._leaving = _leaving(law.step)
        self._left = np.flatnonzero((self._leaving > 0.0) & (self._leaving < 1.0))  # graphs that are asked about
        self._edges = [_edges(float(p)) for p in self._leaving]  # ages at which the parts 1, 2, ... begin
        self.sums = list(np.zeros((2, law.step.modes, PARTS), np.int64))  # steps, and those that left their graph
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
        if not len(self._left):
            return None
        visits = float(all_steps.sum()) * stationary_law(self.law.step.transition)
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
                    ends=binomial_interval(int(left[part]), int(steps[part])),
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
        each = proportion_evidence(left, steps, self._leaving[self._left, None])
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


class SecondOrder(SummedDiagnostic):
    """Steps counted by graph, the graph that came before it, whether they are the first in it, and the next graph.

    Likelihood ratio of the probabilities of the next graph after each graph against common ones, whatever these are.
    """

    name = "graph before"
    meaning = "the next graph depends on the graph that came before: the chain is not Markov"
    kind = "second order"
    about_chain = True

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        n = law.step.modes
        # With two graphs, the one before is known; what is left is the question of the holding times.
        self._asked = 2 < n <= MOST_GRAPHS and bool(_leaving(law.step).any())
        self._transition = law.step.transition if self._asked else np.empty((0, 0))
        self.sums = [np.zeros((n, 2, n, n) if self._asked else (0,), np.int64)]  # before, first or later, graph, next
        self._last = self._before = -1  # graph of the step before the next block, and the graph before that one

    def between(self, block: Block) -> list[AnyArray]:
        """Counts (T, n, 2, n, n)."""
        graphs, analyses = block.graphs, block.analyses
        now, shape = graphs[:-1], (analyses.count, *self.sums[0].shape)
        if not self._asked or not len(now):
            return [np.zeros(shape, np.int64)]
        prior = np.append(self._last, now[:-1])
        entered = (now != prior) & (prior >= 0)
        begin = np.maximum.accumulate(np.where(entered, np.arange(len(now)), -1))
        before = np.where(begin >= 0, prior[begin], self._before)
        self._last, self._before = int(now[-1]), int(before[-1])
        known = before >= 0
        rows = analyses.after(np.arange(len(now))), before, (~entered).astype(np.int64), now, graphs[1:]
        place = np.ravel_multi_index([each[known] for each in rows], shape)
        return [np.bincount(place, minlength=math.prod(shape)).reshape(shape)]

    def finding(self) -> Finding | None:
        """The graph, the one before it and the one after it whose share is furthest from the usual one."""
        if not self._asked:
            return None
        counts, n = self.sums[0], len(self._transition)
        # Steps that the law gives, of all that were made: what is pooled must not depend on what was seen.
        entries = counts.sum() * stationary_law(self._transition)[:, None] * self._transition
        np.fill_diagonal(entries, 0.0)
        statistic, dof, clearest, found = 0.0, 0, -1.0, Finding(0.0)
        for graph in range(n):
            stay = min(self._transition[graph, graph], 1.0 - 1e-12)
            expected = np.stack([entries[:, graph], entries[:, graph] * stay / (1.0 - stay)], axis=1)
            table, labels, targets = _pooled(counts[:, :, graph], expected, self._transition[graph])
            total, columns = table.sum(axis=1, keepdims=True), table.sum(axis=0)
            if min(table.shape) < 2 or not (total > 0).all() or not (columns > 0).all():
                continue
            share = columns / columns.sum()
            statistic += 2.0 * float(xlogy(table, table / (total * share)).sum())
            dof += (len(table) - 1) * (len(columns) - 1)
            z = np.abs(table - total * share) / np.sqrt(total * share * (1.0 - share))
            z[[row for row, label in enumerate(labels) if label is None]] = 0.0
            row, column = np.unravel_index(int(np.argmax(z)), z.shape)
            if z[row, column] > clearest and labels[row] is not None:
                clearest, part, whole = float(z[row, column]), int(table[row, column]), int(total[row, 0])
                before, first = labels[row] or (0, False)
                found = Finding(
                    0.0,
                    before=before,
                    graph=graph,
                    other=targets[column],
                    span=(1, 1) if first else None,
                    estimate=part / whole,
                    expected=float(share[column]),
                    ends=binomial_interval(part, whole),
                )
        return replace(found, log_p=log_chi2_tail(statistic, dof)) if dof else None

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., n + 1, K): of each graph, and of all."""
        if not self._asked:
            return np.empty((*sums[0].shape[:-1], 0, 1))
        # Given the past, every step is a question of its own, so the product over what came before is evidence.
        each = row_evidence(sums[0], self._transition).sum(axis=(-4, -3))
        return np.concatenate([each, each.sum(axis=-2, keepdims=True)], axis=-2)

    def about(self, row: int) -> str:
        """A graph, or all."""
        of = f" of {self.law.graphs[row]}" if row < len(self.law.graphs) else ""
        return f"the next graph{of}, by the graph before"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A probability that depends on the graph before."""
        words = "the next graph depends on the graph before"
        if found.graph is None or found.before is None:
            return words
        after, graph = names[found.before], names[found.graph]
        where = (
            f"after {after}, in the first step of graph {graph}," if found.span else f"in graph {graph} after {after}"
        )
        follows = "that another graph follows" if found.other is None else f"that {names[found.other]} follows"
        if found.other == found.graph:
            follows = "that it stays"
        return f"{words}: {where} the probability {follows} is {found.numbers}, not {found.expected:.3g}"


def _pooled(
    counts: IntArray, expected: FloatArray, law: FloatArray
) -> tuple[IntArray, list[tuple[int, bool] | None], list[int | None]]:
    """A table of the counts (before, first or later, next) of one graph, in which no cell is too rare for chi-square.

    With it of each row the graph before and whether these are first steps only, None: several; of each column the next
    graph, None: several. ``expected`` (before, 2): steps; ``law``: probabilities of the next graph.
    """
    most = float(expected.sum(axis=1).max(initial=0.0))
    targets: list[int | None] = [int(h) for h in np.flatnonzero(law * most >= MIN_EXPECTED)]
    rare = [int(h) for h in np.flatnonzero((law > 0.0) & (law * most < MIN_EXPECTED))]
    columns, shares = [counts[:, :, h] for h in targets], [float(law[h]) for h in targets if h is not None]
    if law[rare].sum() * most >= MIN_EXPECTED:
        columns, shares, targets = (
            [*columns, counts[:, :, rare].sum(axis=2)],
            [*shares, float(law[rare].sum())],
            [*targets, None],
        )
    if len(columns) < 2:
        return np.zeros((0, 0), np.int64), [], []
    seen, enough = np.stack(columns, axis=-1), MIN_EXPECTED / min(shares)
    rows: list[IntArray] = []
    labels: list[tuple[int, bool] | None] = []
    others, steps = np.zeros(len(columns), np.int64), 0.0
    for before, (first, later) in enumerate(expected.tolist()):
        if first >= enough and later >= enough:
            rows, labels = [*rows, *seen[before]], [*labels, (before, True), (before, False)]
        elif first + later >= enough:
            rows, labels = [*rows, seen[before].sum(axis=0)], [*labels, (before, False)]
        else:
            others, steps = others + seen[before].sum(axis=0), steps + first + later
    if steps >= enough:
        rows, labels = [*rows, others], [*labels, None]
    return np.array(rows).reshape(len(rows), len(columns)), labels, targets
