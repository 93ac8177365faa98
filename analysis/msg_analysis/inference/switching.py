# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Tests of the Markov chain: transitions, holding times, names of graphs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from scipy.special import xlogy

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.inference.diagnostics import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.e_values import (
    Looks,
    WindowEvidence,
    Windows,
    log_mean,
    proportion_constant,
    proportion_evidence,
)
from msg_analysis.inference.statistics import chi2_tail, gamma_tail, log_chi2_tail

PATHS = 9999
MAX_JUMPS = 10_000_000  # simulated jumps; longer runs use fewer paths, but at least 199
MIN_EXPECTED_TRANSITIONS = 25.0  # smallest expected count of every possible transition for the chi-square law
SEED = 20_240_229


@dataclass(frozen=True, slots=True, eq=False)
class SwitchingTest:
    """Test of the N - 1 transitions."""

    counts: IntArray  # (n, n) observed
    expected: FloatArray  # (n, n) visits of the row times P
    p: float | None  # None where there is nothing to test; 0 if a transition happened that P forbids


@dataclass(frozen=True, slots=True, eq=False)
class Transitions:
    """Transition counts of the runs of one experiment."""

    counts: IntArray  # (n, n) of all runs
    paths: tuple[tuple[int, int], ...]  # first graph and number of transitions of each run

    @classmethod
    def of(cls, modes: IntArray, graphs: int) -> Transitions:
        """Counts of one run with the graphs ``modes`` (N,), from 0; ``graphs`` is their number n."""
        counts = np.zeros((graphs, graphs), dtype=np.int64)
        np.add.at(counts, (modes[:-1], modes[1:]), 1)
        return cls(counts, ((int(modes[0]), len(modes) - 1),) if len(modes) else ())

    def merged(self, other: Transitions) -> Transitions:
        """With those of other runs."""
        return Transitions(self.counts + other.counts, self.paths + other.paths)

    def test(self, transition: FloatArray) -> SwitchingTest:
        """See ``switching_test``; ``transition`` is P (n, n)."""
        counts = self.counts
        visits = counts.sum(axis=1)
        expected = visits[:, None] * transition
        possible = (transition > 0.0) & (visits[:, None] > 0)
        dof = int(possible.sum() - (visits > 0).sum())
        if counts[transition == 0.0].any():
            return SwitchingTest(counts, expected, 0.0)
        if dof == 0:
            return SwitchingTest(counts, expected, None)
        # Decided by the expectation of the chain, not by the data: a choice made from the data would be a bias.
        usual = counts.sum() * stationary_law(transition)[:, None] * transition
        if usual[transition > 0.0].min() >= MIN_EXPECTED_TRANSITIONS:
            chi2 = float(likelihood_ratio(counts, transition))
            return SwitchingTest(counts, expected, float(chi2_tail(chi2, dof)))
        return SwitchingTest(counts, expected, self._simulated_p(transition))

    def _simulated_p(self, transition: FloatArray) -> float:
        counts = self.counts
        jumps = max(1.0, float(counts.sum(axis=1) @ (1.0 - np.diag(transition))))
        number = int(np.clip(MAX_JUMPS / jumps, 199, PATHS))
        drawn = _drawn(transition.tobytes(), self.paths, number)
        observed = float(likelihood_ratio(counts, transition))
        # Ties (with few jumps there are few possible values) count as at least as extreme.
        above = int((drawn >= observed * (1 - 1e-12)).sum())
        if above or drawn.std() == 0.0:
            return (above + 1) / (number + 1)
        shape = (drawn.mean() / drawn.std()) ** 2
        return float(min(1 / (number + 1), gamma_tail(observed, shape, drawn.mean() / shape)))


def switching_test(modes: IntArray, transition: FloatArray) -> SwitchingTest:
    """Test a path of the graph against its chain, by the likelihood-ratio statistic G.

    Its law is chi-square when every possible transition is expected often enough; else it is simulated: paths of the
    same length from the same first graph (fixed seed), with a gamma fit where none of them is as extreme. With two
    graphs and 6 expected switches each way, 2.3 % of Pearson's p-values would be below 0.01 and 0.7 % below 0.001; of
    these, 0.9 % and 0.15 % (20 000 paths).

    Parameters
    ----------
    modes
        (N,) from 0
    transition
        (n, n) P
    """
    return Transitions.of(modes, len(transition)).test(transition)


def likelihood_ratio(counts: IntArray, transition: FloatArray) -> FloatArray:
    """G = 2 sum c log(c / e) of counts c, e being the visits of a row times P.

    Parameters
    ----------
    counts
        (..., n, n) of transitions
    transition
        (n, n) P

    Returns
    -------
    FloatArray
        (..., ) one G for each matrix of counts
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = counts * np.log(counts / (counts.sum(axis=-1, keepdims=True) * transition))
    return np.asarray(2.0 * np.where(counts > 0, terms, 0.0).sum(axis=(-2, -1)))


@lru_cache(maxsize=8)  # the runs of a sweep with one experiment and several seeds draw the same paths
def _drawn(law: bytes, paths: tuple[tuple[int, int], ...], number: int) -> FloatArray:
    """(number,) statistics of simulated paths, each from its first graph with so many transitions; n x n ``law``."""
    transition = np.frombuffer(law).reshape(math.isqrt(len(law) // 8), -1)
    random = np.random.default_rng(SEED)
    total = np.zeros((number, *transition.shape), dtype=np.int64)
    for first, transitions in paths:
        total += simulate_counts(transition, first, transitions, number, random)
    return likelihood_ratio(total, transition)


def simulate_counts(
    transition: FloatArray, first: int, transitions: int, paths: int, random: np.random.Generator
) -> IntArray:
    """(paths, n, n): transition counts of independent paths from the graph ``first``, drawn sojourn by sojourn."""
    n = len(transition)
    leaving = 1.0 - np.diag(transition)
    jumps = transition - np.diag(np.diag(transition))
    total = jumps.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(np.divide(jumps, total, out=np.zeros_like(jumps), where=total > 0.0), axis=1)
    counts = np.zeros((paths, n, n), dtype=np.int64)
    mode, left, path = np.full(paths, first), np.full(paths, transitions), np.arange(paths)
    while path.size:
        stay = leaving[mode] <= 0.0
        held = np.where(stay, left, random.geometric(np.where(stay, 1.0, leaving[mode])) - 1)
        ends = held >= left
        counts[path, mode, mode] += np.where(ends, left, held)
        mode, left, path, held = (a[~ends] for a in (mode, left, path, held))
        # Guard against a cumulative law that ends just below 1.
        after = np.minimum((random.random(path.size)[:, None] >= cumulative[mode]).sum(axis=1), n - 1)
        counts[path, mode, after] += 1
        mode, left = after, left - held - 1
        mode, left, path = (a[left > 0] for a in (mode, left, path))
    return counts


PARTS = 8  # of the ages of a sojourn, each with the same share of the ends of sojourns, as nearly as steps allow
JOINED = (1, 2, 4)  # parts that are one in the evidence: many parts cost evidence, few hide a departure
MIN_EXPECTED = 15.0  # fewest steps with, and fewest without, a switch in a part, for the chi-square law


class Sojourns(Departure):
    """Switches counted by graph and by the age of the sojourn, in parts.

    Given the past, a step ends its sojourn with the probability 1 - P_gg. So every part is a binomial question of its
    own, and the product of their evidence is evidence. The test is the likelihood ratio of one probability for each
    part against a common one, whatever that is (rates have their own test): chi-square with parts - 1 degrees of
    freedom for each graph. Parts with few expected switches are joined.
    """

    test = "sojourns"

    def __init__(self, law: Law) -> None:
        self._transition = law.step.transition
        self._leaving = 1.0 - np.diag(self._transition)
        n = law.step.modes
        self._edges = [_edges(float(p)) for p in self._leaving]  # ages at which the parts 1, 2, ... begin
        self.steps, self.left = np.zeros((n, PARTS), np.int64), np.zeros((n, PARTS), np.int64)
        self._known = proportion_constant(self._leaving[self._tested, None])  # (G, 1, K)
        self._age = 0  # of the sojourn at the step that comes next

    def add(self, block: Block) -> FloatArray:
        """Count the steps of a block."""
        return self.count(block.graphs, block.looks)

    def count(self, graphs: IntArray, looks: Looks) -> FloatArray:
        """Count the steps to the second, third, ... of these graphs; the first one was the last of those before."""
        shape = looks.count, *self.steps.shape
        steps, left = self._parts(graphs, looks) if len(graphs) > 1 else np.zeros((2, *shape), np.int64)
        steps, left = self.steps + steps.cumsum(axis=0), self.left + left.cumsum(axis=0)
        self.steps, self.left = steps[-1], left[-1]
        return self._evidence(steps, left)

    def _parts(self, graphs: IntArray, looks: Looks) -> IntArray:
        """(2, T, n, PARTS): steps, and those that left their graph, between the looks."""
        now, left = graphs[:-1], graphs[1:] != graphs[:-1]
        index = np.arange(len(now))
        begin = np.maximum.accumulate(np.where(np.append(True, left[:-1]), index, 0))
        age = index - begin + np.where(begin == 0, self._age, 0)
        self._age = 0 if left[-1] else int(age[-1]) + 1
        shape = looks.count, *self.steps.shape
        place = (looks.after(index) * shape[1] + now) * PARTS
        for graph in np.unique(now).tolist():
            at = now == graph
            place[at] += np.searchsorted(self._edges[graph], age[at], side="right")
        counts = [np.bincount(which, minlength=math.prod(shape)).reshape(shape) for which in (place, place[left])]
        return np.array(counts)

    def merge(self, other: Self) -> None:
        """No sojourn goes on from one run to another."""
        self.steps += other.steps
        self.left += other.left

    def finding(self) -> Finding | None:
        """The graph and the part whose switches are furthest from the share that is usual in the graph."""
        total = float(self.steps.sum())
        visits = total * stationary_law(self._transition)
        statistic, dof, clearest, found = 0.0, 0, -1.0, Finding(self.test, 0.0)
        for graph, p in enumerate(self._leaving.tolist()):
            groups = _joined(visits[graph], p, self._edges[graph])
            steps = np.add.reduceat(self.steps[graph], groups).astype(float)
            left = np.add.reduceat(self.left[graph], groups).astype(float)
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
                    self.test,
                    0.0,
                    graph=graph,
                    span=(begins[part] + 1, begins[part + 1] if part + 1 < len(begins) else None),
                    estimate=share,
                    standard_error=math.sqrt(share * (1.0 - share) / max(steps[part], 1.0)),
                    expected=p,
                )
        return replace(found, log_p=log_chi2_tail(statistic, dof)) if dof else None

    def evidence(self) -> FloatArray:
        """(G + 1, K): of each graph that is left, and of all."""
        return self._evidence(self.steps, self.left)

    def _evidence(self, steps: IntArray, left: IntArray) -> FloatArray:
        """(..., G + 1, K), from counts (..., n, PARTS)."""
        rows = self._tested
        if not len(rows):
            return np.empty((*steps.shape[:-2], 0, 1))
        steps, left = _in_parts(steps[..., rows, :]), _in_parts(left[..., rows, :])  # (..., G, 8 + 4 + 2)
        each = proportion_evidence(left, steps, self._leaving[rows, None], self._known)
        ends = np.cumsum([PARTS // joined for joined in JOINED])
        parts = np.concatenate([group.sum(axis=-2) for group in np.split(each, ends[:-1], axis=-2)], axis=-1)
        return np.concatenate([parts, parts.sum(axis=-2, keepdims=True)], axis=-2)

    def questions(self) -> list[Question]:
        """Sojourns in a graph, and all."""
        return [*(("sojourns in {}", (graph,)) for graph in self._tested.tolist()), ("sojourns", ())]

    @property
    def _tested(self) -> IntArray:
        return np.flatnonzero((self._leaving > 0.0) & (self._leaving < 1.0))


def _in_parts(counts: IntArray) -> IntArray:
    """(..., 8 + 4 + 2): counts (..., 8) of the parts, and of each ``JOINED`` number of them."""
    return np.concatenate([counts.reshape(*counts.shape[:-1], -1, each).sum(axis=-1) for each in JOINED], axis=-1)


def _edges(leaving: float) -> IntArray:
    """(PARTS - 1,) ages at which 1/8, 2/8, ... of the sojourns have ended."""
    if not 0.0 < leaving < 1.0:
        return np.full(PARTS - 1, np.iinfo(np.int64).max)
    shares = np.arange(1, PARTS) / PARTS
    return np.ceil(np.log1p(-shares) / math.log1p(-leaving)).astype(np.int64)


def _joined(visits: float, leaving: float, edges: IntArray) -> IntArray:
    """First part of every group of parts in which enough switches are expected of so many steps in the graph."""
    if not 0.0 < leaving < 1.0:
        return np.zeros(1, np.int64)
    survive = (1.0 - leaving) ** np.append(0.0, edges.astype(float))
    ends = visits * leaving * -np.diff(np.append(survive, 0.0))  # expected ends of sojourns
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
