# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The three numerical examples of the paper as numbers: certainty over the switching rates.

The paper's text has no graphs of examples 2 and 3: those used here are reconstructions, and are marked as such.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.optimize

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.leaders import LeaderProblem
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.prediction import Moments

SYSTEM, NODE, CENTRALITY = "system certainty", "node certainty", "robustness centrality"

LEVELS = (0.1, 0.5, 1.0, 2.0, 5.0)  # example 1: values of the rate that a curve holds fixed
R2J = 0.05  # example 2: rate from graph 2 to each of the others, before scaling
SCALES = (0.5, 1.0, 5.0, 10.0)  # example 2: values of epsilon
NODE_SCALES = (0.5, 10.0)  # example 2: values of epsilon with drawn node certainties


def _three_graphs(r12: float, r21: float) -> list[list[float]]:
    """r32 = r12 and r21 = r23; no jumps between graphs 1 and 3."""
    return [[-r12, r12, 0.0], [r21, -2.0 * r21, r21], [0.0, r12, -r12]]


@dataclass(frozen=True, eq=False)
class GraphFamily:
    """Graphs that switch: q_ij = epsilon r_ij."""

    name: str
    graphs: dict[str, Any]  # as in an experiment file
    rates: Callable[[float, float], list[list[float]]] = lambda r12, r21: [[-r12, r12], [r21, -r21]]  # (n, n)

    def generator(self, epsilon: float, r12: float, r21: float) -> FloatArray:
        """(n, n) the scaled generator."""
        return np.asarray(epsilon * np.array(self.rates(r12, r21)))

    @cached_property
    def base(self) -> Experiment:
        """The graphs, checked once, with some chain."""
        document = {"name": self.name, "graphs": self.graphs, "switching": {"generator": self.rates(1.0, 1.0)}}
        return Experiment.parse(document, source=self.name)

    def at(self, *rates: float) -> Experiment:
        """The experiment at (epsilon, r12, r21)."""
        return dataclasses.replace(self.base, switching_law=MarkovChain("continuous", self.generator(*rates)))

    def certainties(self, *rates: float) -> FloatArray:
        """(1 + m,) certainty of the system and of every node."""
        system = systems.continuous(self.at(*rates))
        moments = Moments(system.lifted(MomentSolver(system).steady().sum(axis=0)))
        return 1.0 / np.append(moments.system_error, moments.node_errors)

    def centralities(self, *rates: float) -> FloatArray:
        """(m,) robustness centrality of every agent."""
        problem = LeaderProblem(self.at(*rates), "continuous")
        return np.array([1.0 / problem.system_error(frozenset({agent})) for agent in range(problem.agents)])

    def curves(self, rates: tuple[FloatArray, FloatArray, FloatArray], *quantities: str) -> list[Curve]:
        """All curves of some quantities along a path of (epsilon, r12, r21), each (points,)."""
        points = list(zip(*rates, strict=True))
        found: dict[tuple[str, int | None], FloatArray] = {}
        if {SYSTEM, NODE} & set(quantities):
            values = np.array([self.certainties(*point) for point in points])
            found |= {(SYSTEM, None): values[:, 0]} | {(NODE, a): values[:, a + 1] for a in range(self.base.agents)}
        if CENTRALITY in quantities:
            values = np.array([self.centralities(*point) for point in points])
            found |= {(CENTRALITY, a): values[:, a] for a in range(self.base.agents)}
        return [Curve(self.name, *key, *rates, value) for key, value in found.items() if key[0] in quantities]


def _edges(pairs: str) -> dict[str, Any]:
    return {"edges": [list(map(int, pair)) for pair in pairs.split()]}


# The three lines are the ring without one edge: they fit every statement about example 2, as other graphs would. The
# first pair is the only one of connected graphs for which all three orders of the paper are orders of robustness
# centrality; the second is that with the fewest edges for which centrality orders 1-3-4-5-2 and certainty 3-1-4-5-2.
_LINES = {"line_1": {"path": [2, 3, 4, 5, 1]}, "line_2": {"path": [1, 2, 3, 4, 5]}, "line_3": {"path": [5, 1, 2, 3, 4]}}
_KNIFE_EDGE = {"first": _edges("12 13 15 34 45"), "second": _edges("13 15 23 24 34 45")}
_SMALLEST = {"first": _edges("12 13 14 35"), "second": _edges("12 13 34 35 45")}
NETWORKS = {
    "line_ring": GraphFamily("line_ring", {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}}),
    "three_lines": GraphFamily("three_lines", _LINES, _three_graphs),
    "knife_edge": GraphFamily("knife_edge", _KNIFE_EDGE),
    "smallest": GraphFamily("smallest", _SMALLEST),
}


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One curve: a certainty along a path of rates, with F = I; all arrays are (points,)."""

    network: str  # name of the set of graphs
    quantity: str  # SYSTEM, NODE or CENTRALITY (of this agent as the only leader)
    agent: int | None  # from 0; None: the system
    epsilon: FloatArray  # scale of all rates [1 / unit of time]: q_ij = epsilon r_ij
    r12: FloatArray
    r21: FloatArray
    value: FloatArray  # [1 / variance]

    @property
    def peak(self) -> int:
        """Index of the largest value."""
        return int(self.value.argmax())


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One example of the paper."""

    number: int  # 1, 2 or 3
    title: str
    curves: list[Curve]
    remarks: tuple[str, ...] = ()  # comment lines of the table; they say what is a reconstruction

    @property
    def networks(self) -> dict[str, tuple[Graph, ...]]:
        """Graphs by name of the network."""
        return {name: NETWORKS[name].base.graph_list for name in dict.fromkeys(curve.network for curve in self.curves)}

    def select(self, network: str, quantity: str) -> list[Curve]:
        """The curves of one network and one quantity."""
        return [curve for curve in self.curves if (curve.network, curve.quantity) == (network, quantity)]


def example_1(points: int = 60) -> Example:
    """Consensus on line and ring, epsilon = 0.5: certainty over r12 and over r21, at ``points`` rates and 0.1 and 1."""
    swept = np.unique(np.append(5.0 * np.linspace(0.04, 1.0, points) ** 2, [0.1, 1.0]))  # dense where curves are steep
    epsilon = np.full_like(swept, 0.5)
    curves: list[Curve] = []
    for other in LEVELS:
        fixed = np.full_like(swept, other)
        for rates in ((epsilon, swept, fixed), (epsilon, fixed, swept)):
            curves += NETWORKS["line_ring"].curves(rates, SYSTEM, *([NODE] if other == 1.0 else []))
    return Example(1, "consensus, line and ring, epsilon = 0.5, F = I", curves)


def example_2(points: int = 60) -> Example:
    """Consensus on three lines: certainty over r12 = r32, at ``points`` rates, 0.2, 0.5 and the largest value."""
    network = NETWORKS["three_lines"]
    curves: list[Curve] = []
    for scale in SCALES:
        # One maximum: the search is logarithmic.
        found = scipy.optimize.minimize_scalar(
            lambda u, scale=scale: -network.certainties(scale, np.exp(u), R2J)[0],
            bounds=(np.log(1e-3), 0.0),
            options={"xatol": 1e-6},
        )
        swept = np.unique(np.append(np.linspace(0.04, 1.0, points) ** 2, [0.2, 0.5, float(np.exp(found.x))]))
        rates = (np.full_like(swept, scale), swept, np.full_like(swept, R2J))
        curves += network.curves(rates, SYSTEM, *([NODE] if scale in NODE_SCALES else []))
    remark = "graphs reconstructed: the paper's picture is missing; these fit every statement of its text"
    return Example(2, "consensus, three lines, r12 = r32, r21 = r23 = 0.05, F = I", curves, (remark,))


def example_3(points: int = 60) -> Example:
    """One leader held at the reference, two graphs, q12 = q21 = epsilon: at ``points`` values and 0.1, 1 and 10."""
    epsilon = np.unique(np.append(np.geomspace(1e-2, 1e2, points), [0.1, 1.0, 10.0]))
    rates = (epsilon, np.ones_like(epsilon), np.ones_like(epsilon))
    return Example(
        3,
        "tracking with one leader held at the reference, and consensus, q12 = q21 = epsilon, F = I",
        [curve for name in ("knife_edge", "smallest") for curve in NETWORKS[name].curves(rates, CENTRALITY, NODE)],
        (
            "graphs reconstructed: no pair of connected graphs fits the paper's text to the letter",
            "knife_edge: reconstructed so that 1-3-4-5-2, 3-1-4-5-2, 1-3-4-5-2 are orders of robustness centrality",
            "smallest: reconstructed so that centrality orders 1-3-4-5-2 and node certainty 3-1-4-5-2",
        ),
    )


EXAMPLES: dict[int, Callable[[], Example]] = {1: example_1, 2: example_2, 3: example_3}

RATES = ("network", "quantity", "agent", "epsilon [1/time]", "r12", "r21")
COLUMNS = (*RATES, "q12 [1/time]", "q21 [1/time]", "value [1/variance]")


def csv_text(example: Example) -> str:
    """The curves as CSV: comment lines, a header with units, a row per point; agents from 1, 0 for the system."""
    rows = []
    for curve in example.curves:
        agent = 0 if curve.agent is None else curve.agent + 1
        columns = (curve.epsilon, curve.r12, curve.r21, curve.epsilon * curve.r12, curve.epsilon * curve.r21)
        for numbers in zip(*columns, curve.value, strict=True):
            rows.append((curve.network, curve.quantity, agent, *map(float, numbers)))
    comments = (f"Example {example.number}: {example.title}", "agent 0 is the system", *example.remarks)
    return commented_csv(comments, COLUMNS, rows)


def commented_csv(comments: Iterable[str], columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV below comment lines that begin with ``#``."""
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def order(curves: Sequence[Curve], point: int) -> list[int]:
    """Agents, from 0, by decreasing value of their curves (one per agent) at the point with this index."""
    ranked = sorted(curves, key=lambda curve: -curve.value[point])
    return [curve.agent for curve in ranked if curve.agent is not None]
