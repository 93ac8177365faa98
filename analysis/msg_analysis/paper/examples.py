# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The three numerical examples of the paper as numbers: certainty over the switching rates.

The paper's pictures of the graphs of examples 2 and 3 are not part of its text: those used here are reconstructions,
and are marked as such wherever they are shown.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
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

LINE_RING = {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}}

THREE_LINES = {
    "line_1": {"path": [2, 3, 4, 5, 1]},
    "line_2": {"path": [1, 2, 3, 4, 5]},
    "line_3": {"path": [5, 1, 2, 3, 4]},
}
"""Each is the ring without one edge. They fit every statement of the paper about example 2, as other graphs would."""

KNIFE_EDGE = {
    "first": {"edges": [[1, 2], [1, 3], [1, 5], [3, 4], [4, 5]]},
    "second": {"edges": [[1, 3], [1, 5], [2, 3], [2, 4], [3, 4], [4, 5]]},
}
"""The only pair of connected graphs for which all three orders of the paper are orders of robustness centrality."""

SMALLEST = {
    "first": {"edges": [[1, 2], [1, 3], [1, 4], [3, 5]]},
    "second": {"edges": [[1, 2], [1, 3], [3, 4], [3, 5], [4, 5]]},
}
"""The pair with the fewest edges for which centrality orders 1-3-4-5-2 and node certainty 3-1-4-5-2."""


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
    networks: dict[str, tuple[Graph, ...]]  # by name of the network
    curves: list[Curve]
    remarks: tuple[str, ...] = ()  # comment lines of the table; they say what is a reconstruction

    @property
    def reconstructed(self) -> bool:
        """Whether its graphs are reconstructions."""
        return any("reconstruct" in line for line in self.remarks)

    def select(self, network: str, quantity: str) -> list[Curve]:
        """The curves of one network and one quantity."""
        return [curve for curve in self.curves if (curve.network, curve.quantity) == (network, quantity)]


Generator = Callable[[float, float, float], FloatArray]
"""(n, n) generator of (epsilon, r12, r21)."""


def two_graphs(epsilon: float, r12: float, r21: float) -> FloatArray:
    """Generator (2, 2) of examples 1 and 3: q12 = epsilon r12, q21 = epsilon r21."""
    return epsilon * np.array([[-r12, r12], [r21, -r21]])


def three_graphs(epsilon: float, r12: float, r21: float) -> FloatArray:
    """Generator (3, 3) of example 2: r32 = r12 and r21 = r23, before scaling; no jumps between graphs 1 and 3."""
    return epsilon * np.array([[-r12, r12, 0.0], [r21, -2.0 * r21, r21], [0.0, r12, -r12]])


@dataclass(frozen=True, slots=True, eq=False)
class _Network:
    """Graphs that are checked once, then used with many chains."""

    name: str
    base: Experiment
    generator: Generator

    @classmethod
    def of(cls, name: str, graphs: dict[str, Any], generator: Generator) -> _Network:
        document = {"name": name, "graphs": graphs, "switching": {"generator": generator(1.0, 1.0, 1.0).tolist()}}
        return cls(name, Experiment.parse(document, source=name), generator)

    def at(self, epsilon: float, r12: float, r21: float) -> Experiment:
        chain = MarkovChain("continuous", self.generator(epsilon, r12, r21))
        return dataclasses.replace(self.base, chain=chain)

    def certainties(self, epsilon: float, r12: float, r21: float) -> FloatArray:
        """(1 + m,) certainty of the system and of every node."""
        system = systems.continuous(self.at(epsilon, r12, r21))
        moments = Moments(system.lifted(MomentSolver(system).steady().sum(axis=0)))
        return 1.0 / np.append(moments.system_error, moments.node_errors)

    def centralities(self, epsilon: float, r12: float, r21: float) -> FloatArray:
        """(m,) robustness centrality of every agent."""
        problem = LeaderProblem(self.at(epsilon, r12, r21), "continuous")
        return np.array([1.0 / problem.system_error(frozenset({agent})) for agent in range(problem.agents)])

    def curves(
        self,
        rates: tuple[FloatArray, FloatArray, FloatArray],
        *,
        quantities: Sequence[str],
    ) -> list[Curve]:
        """All curves of some quantities along a path of (epsilon, r12, r21), each (points,)."""
        points = list(zip(*rates, strict=True))
        found: list[Curve] = []
        if SYSTEM in quantities or NODE in quantities:
            values = np.array([self.certainties(*point) for point in points])
            if SYSTEM in quantities:
                found.append(Curve(self.name, SYSTEM, None, *rates, values[:, 0]))
            if NODE in quantities:
                found += [Curve(self.name, NODE, a, *rates, values[:, a + 1]) for a in range(self.base.agents)]
        if CENTRALITY in quantities:
            values = np.array([self.centralities(*point) for point in points])
            found += [Curve(self.name, CENTRALITY, a, *rates, values[:, a]) for a in range(self.base.agents)]
        return found


def example_1(points: int = 60) -> Example:
    """Consensus on line and ring, epsilon = 0.5: certainty over r12 and over r21, at ``points`` rates and 0.1 and 1."""
    network = _Network.of("line_ring", LINE_RING, two_graphs)
    swept = np.unique(np.append(5.0 * np.linspace(0.04, 1.0, points) ** 2, [0.1, 1.0]))  # dense where curves are steep
    epsilon = np.full_like(swept, 0.5)
    curves: list[Curve] = []
    for other in LEVELS:
        fixed = np.full_like(swept, other)
        quantities = (SYSTEM, NODE) if other == 1.0 else (SYSTEM,)
        curves += network.curves((epsilon, swept, fixed), quantities=quantities)
        curves += network.curves((epsilon, fixed, swept), quantities=quantities)
    return Example(
        1,
        "consensus, line and ring, epsilon = 0.5, F = I",
        {network.name: network.base.graph_list},
        curves,
    )


LEVELS = (0.1, 0.5, 1.0, 2.0, 5.0)
"""Example 1: values of the rate that a curve holds fixed."""

R2J = 0.05
"""Example 2: rate from graph 2 to each of the others, before scaling."""

SCALES = (0.5, 1.0, 5.0, 10.0)
"""Example 2: values of epsilon."""

NODE_SCALES = (0.5, 10.0)
"""Example 2: values of epsilon with drawn node certainties."""


def example_2(points: int = 60) -> Example:
    """Consensus on three lines: certainty over r12 = r32, at ``points`` rates, 0.2, 0.5 and the largest value."""
    network = _Network.of("three_lines", THREE_LINES, three_graphs)
    curves: list[Curve] = []
    for scale in SCALES:
        peak = _argmax(lambda r12, scale=scale: network.certainties(scale, r12, R2J)[0], 1e-3, 1.0)  # type: ignore[misc]
        swept = np.unique(np.append(np.linspace(0.04, 1.0, points) ** 2, [0.2, 0.5, peak]))
        rates = (np.full_like(swept, scale), swept, np.full_like(swept, R2J))
        curves += network.curves(rates, quantities=(SYSTEM, NODE) if scale in NODE_SCALES else (SYSTEM,))
    return Example(
        2,
        "consensus, three lines, r12 = r32, r21 = r23 = 0.05, F = I",
        {network.name: network.base.graph_list},
        curves,
        ("graphs reconstructed: the paper's picture is missing; these fit every statement of its text",),
    )


def example_3(points: int = 60) -> Example:
    """One leader held at the reference, two graphs, q12 = q21 = epsilon: centrality and certainty over epsilon.

    At ``points`` values of epsilon and 0.1, 1 and 10.
    """
    curves: list[Curve] = []
    networks: dict[str, tuple[Graph, ...]] = {}
    for name, graphs in (("knife_edge", KNIFE_EDGE), ("smallest", SMALLEST)):
        network = _Network.of(name, graphs, two_graphs)
        epsilon = np.unique(np.append(np.geomspace(1e-2, 1e2, points), [0.1, 1.0, 10.0]))
        rates = (epsilon, np.ones_like(epsilon), np.ones_like(epsilon))
        curves += network.curves(rates, quantities=(CENTRALITY, NODE))
        networks[name] = network.base.graph_list
    return Example(
        3,
        "tracking with one leader held at the reference, and consensus, q12 = q21 = epsilon, F = I",
        networks,
        curves,
        (
            "graphs reconstructed: no pair of connected graphs fits the paper's text to the letter",
            "knife_edge: reconstructed so that 1-3-4-5-2, 3-1-4-5-2, 1-3-4-5-2 are orders of robustness centrality",
            "smallest: reconstructed so that centrality orders 1-3-4-5-2 and node certainty 3-1-4-5-2",
        ),
    )


EXAMPLES: dict[int, Callable[[], Example]] = {1: example_1, 2: example_2, 3: example_3}

COLUMNS = (
    "network",
    "quantity",
    "agent",
    "epsilon [1/time]",
    "r12",
    "r21",
    "q12 [1/time]",
    "q21 [1/time]",
    "value [1/variance]",
)


def csv_text(example: Example) -> str:
    """The curves as CSV: comment lines, a header with units, a row per point."""
    comments = (f"Example {example.number}: {example.title}", "agent 0 is the system", *example.remarks)
    return commented_csv(comments, COLUMNS, table(example))


def commented_csv(comments: Iterable[str], columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV below comment lines that begin with ``#``."""
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def table(example: Example) -> Iterable[tuple[str | int | float, ...]]:
    """A row per point of every curve, in the order of ``COLUMNS``; agents from 1, 0 for the system."""
    for curve in example.curves:
        agent = 0 if curve.agent is None else curve.agent + 1
        columns = (curve.epsilon, curve.r12, curve.r21, curve.epsilon * curve.r12, curve.epsilon * curve.r21)
        for *rates, value in zip(*columns, curve.value, strict=True):
            yield (curve.network, curve.quantity, agent, *(float(rate) for rate in rates), float(value))


def order(curves: Sequence[Curve], point: int) -> list[int]:
    """Agents, from 0, by decreasing value of their curves (one per agent) at the point with this index."""
    ranked = sorted(curves, key=lambda curve: -curve.value[point])
    return [curve.agent for curve in ranked if curve.agent is not None]


def _argmax(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a function with one maximum has it, between ``low`` and ``high`` > 0; the search is logarithmic."""
    bounds = (np.log(low), np.log(high))
    found = scipy.optimize.minimize_scalar(lambda u: -function(np.exp(u)), bounds=bounds, options={"xatol": 1e-6})
    return float(np.exp(found.x))
