# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Weighted directed graphs of agents and their Laplacians."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray


def hops(leads: BoolArray, sources: Collection[int]) -> IntArray:
    """(v,) least number of arcs from any source to each vertex; -1 if unreachable. ``leads[i, j]``: arc from i to j."""
    # Not by networkx: every process of a run needs this, and importing it takes longer than all its other imports.
    level = np.full(len(leads), -1)
    front, distance = np.array(sorted(sources), dtype=int), 0
    while front.size:
        level[front] = distance
        front, distance = np.flatnonzero(leads[front].any(axis=0) & (level < 0)), distance + 1
    return level


def widest_reaching(leads: BoolArray) -> list[int]:
    """The vertices from which the most others are reached, of one component only; ``leads`` (v, v) as in ``hops``."""
    known = np.zeros(len(leads), dtype=bool)
    widest, reached = 0, known.copy()
    for vertex in range(len(leads)):
        if not known[vertex]:  # else a vertex that reaches it was tried, which reaches at least as many
            found = hops(leads, [vertex]) >= 0
            known |= found
            if found.sum() > reached.sum():
                widest, reached = vertex, found
    return np.flatnonzero(reached & (hops(leads.T, [widest]) >= 0)).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """One mode of the switching network; agent t listens to agent s with weight ``a[t, s]`` [1 / unit of time].

    Attributes
    ----------
    name
        name of the graph in the experiment file
    agents
        number of agents m
    targets, sources, weights
        (l,) every arc: who listens, to whom (agents from 0), and the weight; sorted by target, then source
    whole, active
        where agents leave out steps, the graph with the arcs of all of them, and (m,) which of them make this one;
        None elsewhere
    """

    name: str
    agents: int
    targets: IntArray
    sources: IntArray
    weights: FloatArray
    whole: Graph | None = None
    active: BoolArray | None = None

    @classmethod
    def of(cls, name: str, adjacency: FloatArray) -> Graph:
        """The graph with this ``adjacency`` (m, m)."""
        targets, sources = np.nonzero(adjacency)
        return cls(name, len(adjacency), targets, sources, adjacency[targets, sources])

    @classmethod
    def of_arcs(cls, name: str, agents: int, arcs: Iterable[tuple[int, int, float]]) -> Graph:
        """The graph with these ``arcs``, as the property has them."""
        listed = sorted(arcs, key=lambda arc: (arc[1], arc[0]))
        sources, targets = (np.array([arc[end] for arc in listed], dtype=np.int64) - 1 for end in (0, 1))
        return cls(name, agents, targets, sources, np.array([weight for *_, weight in listed], dtype=float))

    @property
    def adjacency(self) -> FloatArray:
        """(m, m) weights ``a``, zero diagonal; symmetric for an undirected graph."""
        matrix = np.zeros((self.agents, self.agents))
        matrix[self.targets, self.sources] = self.weights
        return matrix

    @property
    def laplacian(self) -> FloatArray:
        """(m, m) in-degree Laplacian L = D - A; every row sums to zero (section II of the paper)."""
        adjacency = self.adjacency
        return np.diag(adjacency.sum(axis=1)) - adjacency

    @property
    def degrees(self) -> FloatArray:
        """(m,) in-degrees: sums of the weights with which each agent listens."""
        return np.asarray(np.bincount(self.targets, self.weights, self.agents), dtype=float)

    @property
    def links(self) -> int:
        """Number of edges of an undirected graph, of arcs of a directed one."""
        return len(self.weights) // 2 if self.symmetric else len(self.weights)

    @property
    def parts(self) -> int:
        """Number of parts that no link connects, whatever its direction."""
        from scipy.sparse import csr_array  # here, since every process of a run would wait for it
        from scipy.sparse.csgraph import connected_components

        links = csr_array((self.weights, (self.targets, self.sources)), (self.agents, self.agents))
        return int(connected_components(links, directed=False)[0])

    @property
    def symmetric(self) -> bool:
        """Whether the graph is undirected."""
        across = np.lexsort((self.targets, self.sources))
        ends = np.array_equal(self.sources[across], self.targets), np.array_equal(self.targets[across], self.sources)
        return all(ends) and np.array_equal(self.weights[across], self.weights)

    @property
    def arcs(self) -> list[tuple[int, int, float]]:
        """(source, target, weight) of every arc, agents from 1: target listens to source. Sorted by target, source."""
        ends = (self.sources + 1).tolist(), (self.targets + 1).tolist()
        return list(zip(*ends, self.weights.tolist(), strict=True))

    @property
    def edges(self) -> list[tuple[int, int, float]]:
        """(i, j, weight), i < j, of every pair that listen to each other with equal weight, agents from 1."""
        arcs = set(self.arcs)
        return [(s, t, w) for s, t, w in self.arcs if s < t and (t, s, w) in arcs]


def reach(graphs: Sequence[Graph], sources: list[int] | None) -> tuple[list[int], BoolArray]:
    """Agents, and (m,) who hears from one of them in the union, sparse; without ``sources`` those whom nobody leads."""
    from scipy.sparse import coo_array, csgraph  # here, since every agent's process would wait for it

    targets, heard = (np.concatenate([getattr(graph, ends) for graph in graphs]) for ends in ("targets", "sources"))
    leads = coo_array((np.ones(len(targets)), (heard, targets)), (graphs[0].agents,) * 2).tocsr()
    if sources is None:
        _, part = csgraph.connected_components(leads, connection="strong")
        led = part[targets[part[targets] != part[heard]]]
        sizes = np.bincount(part)
        sizes[led] = 0
        sources = np.flatnonzero(part == sizes.argmax()).tolist()
    reached = np.zeros(graphs[0].agents, dtype=np.bool_)
    for agent in sources:
        if not reached[agent]:
            reached[csgraph.breadth_first_order(leads, agent, return_predecessors=False)] = True
    return sources, reached
