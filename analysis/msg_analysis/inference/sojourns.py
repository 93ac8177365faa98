# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The question about holding times that are not exponential: whether they have the law of the file.

Phases are not seen. Given the graphs so far, they have a law, which a filter follows step by step, and so has the next
graph: what comes, less its probability, is a martingale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from msg_analysis.common.arrays import AnyArray, FloatArray
from msg_analysis.experiment.markov_chain import SojournSchedule
from msg_analysis.inference.graphs import MIN_EXPECTED
from msg_analysis.inference.question import Block, Finding, Law, SummedDiagnostic
from msg_analysis.inference.statistics import log_chi2_tail

PARTS = 4  # of the ages of a holding time, in mean holding times: up to 1/2, 1 and 2, and beyond
ENDS = (0.5, 1.0, 2.0)


class Sojourns(SummedDiagnostic):
    """Steps after which a graph was left, by its age, and after which another one came, next to their probabilities."""

    name = "sojourns"
    meaning = "the graphs are not held, or followed by each other, as the file says"
    kind = "sojourn"
    about_chain = True

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        path = law.step.switching
        self._path = path if isinstance(path, SojournSchedule) else None
        n = law.step.modes if self._path else 0
        # What came less what was expected, and the variance: in each part of the age, and of each next graph.
        self.sums = list(np.zeros((2, n, PARTS + n)))
        if self._path is None:
            return
        phases, graph_of = self._path.law.phases, self._path.law.graph_of
        self._step = phases.transition(law.step.dt)
        self._of_graph = (graph_of[:, None] == np.arange(n)).astype(float)  # (S, n)
        means = np.array([held or math.inf for held in self._path.law.chain.holding_times])
        unit = law.step.dt if self._path.law.chain.time == "continuous" else 1.0
        self._edges = means[:, None] / unit * np.array(ENDS)  # (n, PARTS - 1) [steps]
        self._belief: FloatArray | None = None  # (S,) law of the phase of the step that comes next
        self._age = 0

    def between(self, block: Block) -> list[AnyArray]:
        """(T, n, PARTS + n) each."""
        excess, variance = np.zeros((2, block.analyses.count, *self.sums[0].shape))
        if self._path is None or len(block.graphs) < 2:
            return [excess, variance]
        after = block.analyses.after(np.arange(len(block.graphs) - 1)).tolist()
        graphs = block.graphs.tolist()
        if self._belief is None:
            self._belief = self._path.initial
        for k, (now, then) in enumerate(pairwise(graphs)):
            seen = self._belief * self._of_graph[:, now]
            total = seen.sum()
            if not total > 0.0:  # excluded by the law: begin anew
                seen, total = self._of_graph[:, now], self._of_graph[:, now].sum()
            self._belief = (seen / total) @ self._step
            chance = self._belief @ self._of_graph
            part = int(np.searchsorted(self._edges[now], self._age + 1, side="left"))
            left = 1.0 - chance[now]
            excess[after[k], now, part] += (then != now) - left
            variance[after[k], now, part] += left * (1.0 - left)
            came = -chance
            came[then] += 1.0
            others = np.arange(len(chance)) != now
            excess[after[k], now, PARTS:][others] += came[others]
            variance[after[k], now, PARTS:][others] += (chance * (1.0 - chance))[others]
            self._age = 0 if then != now else self._age + 1
        return [excess, variance]

    def finding(self) -> Finding | None:
        """The graph whose holding times, or next graphs, are furthest from what the file says."""
        if self._path is None:
            return None
        excess, variance = self.sums
        often = variance >= MIN_EXPECTED
        if not often.any():
            return None
        z = np.where(often, excess / np.sqrt(np.where(often, variance, 1.0)), 0.0)
        graph, cell = np.unravel_index(int(np.abs(z).argmax()), z.shape)
        log_p = math.log(often.sum()) + log_chi2_tail(float(z[graph, cell] ** 2), 1)
        return Finding(
            min(0.0, log_p),
            graph=int(graph),
            other=int(cell) - PARTS if cell >= PARTS else None,
            span=(int(cell), None) if cell < PARTS else None,
            estimate=float(excess[graph, cell]),
            standard_error=float(np.sqrt(variance[graph, cell])),
            expected=0.0,
        )

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """No evidence at any time: only a test at the end."""
        return np.empty((*sums[0].shape[:-2], 0, 1))

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """How many more or fewer changes there were."""
        assert found.graph is not None
        more = f"{abs(found.estimate or 0.0):.3g} times {'more' if (found.estimate or 0.0) > 0.0 else 'less'} often"
        if found.other is not None:
            return f"graph {names[found.other]} came after {names[found.graph]} {more} than the file says"
        ages = ("0", *(f"{end:g}" for end in ENDS))
        part = found.span[0] if found.span else 0
        until = f"{ages[part]} to {ages[part + 1]}" if part + 1 < len(ages) else f"more than {ages[part]}"
        return f"graph {names[found.graph]} was left {more} than the file says, at an age of {until} mean holding times"
