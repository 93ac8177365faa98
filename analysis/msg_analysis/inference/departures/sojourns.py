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

"""Sojourns of the graph: a Markov chain leaves a graph with the same probability however long it has been there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Self

import numpy as np
from scipy.special import xlogy

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Question
from msg_analysis.inference.evidence.looks import Looks
from msg_analysis.inference.evidence.mixture_evidence import proportion_constant, proportion_evidence
from msg_analysis.inference.statistics.distributions import log_chi2_tail
from msg_analysis.model.network.markov_chain import stationary_law
from msg_analysis.types import FloatArray, IntArray

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
