# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Graphs of all kinds: by agents, from files, networkx and matrices; the numbers of their nodes."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.common.text import agent_text
from msg_analysis.experiment.graph_files import (
    ForeignGraph,
    GraphError,
    is_whole,
    node_name,
    require_different,
    weights_of,
)
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.problems import problem, show
from msg_analysis.experiment.spec import GraphSpec
from msg_analysis.experiment.values import Link, WrittenLink

_PLAIN = {str, int, float, bool, type(None)}


def plain(value: Any) -> Any:
    """A document with lists and numbers in place of arrays, matrices of scipy.sparse, numbers of numpy and tuples."""
    if type(value) in _PLAIN:
        return value
    if isinstance(value, list | tuple | range):
        return list(value) if all(type(each) in _PLAIN for each in value) else [plain(each) for each in value]
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, Path):
        return str(value)
    if _is_array(value):
        return np.asarray(value.toarray() if hasattr(value, "toarray") else value).tolist()
    return value


def _is_array(value: object) -> bool:
    return hasattr(value, "toarray") or hasattr(value, "__array__")


def plain_document(mapping: Mapping[Any, Any]) -> tuple[dict[Any, Any], dict[str, Any]]:
    """The document, in which arrays have become graphs with this ``adjacency``; and its graphs of networkx, by name."""
    graphs, found = mapping.get("graphs"), {}
    if isinstance(graphs, Mapping):
        found = {name: graph for name, graph in graphs.items() if _is_networkx(graph)}
        made = {name: {"adjacency": graph} if _is_array(graph) else graph for name, graph in graphs.items()}
        mapping = {**mapping, "graphs": made | {name: {"edges": []} for name in found}}
    return {key: plain(each) for key, each in mapping.items()}, found


def _is_networkx(value: object) -> bool:
    networkx = sys.modules.get("networkx")  # without its import, which takes long
    return networkx is not None and isinstance(value, networkx.Graph)


def from_networkx(key: str, graph: Any) -> ForeignGraph:
    """A graph of networkx; ``key`` is for the GraphError."""
    if graph.is_multigraph():
        wanted, kind = "expected a networkx.Graph or networkx.DiGraph", type(graph).__name__
        raise GraphError(key, f"a {kind}", wanted, "convert it, for example networkx.Graph(graph)")
    if not graph:
        raise GraphError(key, "a graph without nodes", "expected a graph with nodes", "add nodes")
    names = {node: node_name(key, node) for node in graph.nodes}
    require_different(key, names.values())
    found = [(names[a], names[b], given) for a, b, given in graph.edges(data=True)]
    weights, notes = weights_of(key, [(f"{a} - {b}: ", given) for a, b, given in found])
    links = [(a, b, weight) for (a, b, _), weight in zip(found, weights, strict=True)]
    return ForeignGraph(list(names.values()), links, graph.is_directed(), notes)


def from_adjacency(key: str, rows: Sequence[Sequence[float]]) -> GraphSpec:
    """A matrix whose row i has the weights with which agent i listens; edges where it is symmetric, else arcs."""
    if any(len(row) != len(rows) for row in rows):
        shape = f"{len(rows)} rows of {' or '.join(sorted({str(len(row)) for row in rows}))} entries"
        wanted = "expected a square matrix"
        raise GraphError(key, shape, wanted, "give one row and one column for each agent")
    matrix = np.array(rows, dtype=float)
    for i in np.flatnonzero(np.diag(matrix)).tolist():
        wanted = "expected 0 on the diagonal, since no agent listens to itself"
        raise GraphError(f"{key}[{i + 1}][{i + 1}]", float(matrix[i, i]), wanted, "set it to 0")
    directed = not np.array_equal(matrix, matrix.T)
    listeners, sources = np.nonzero(matrix if directed else np.tril(matrix))
    links = [
        (source + 1, listener + 1, float(matrix[listener, source]))
        for listener, source in zip(listeners.tolist(), sources.tolist(), strict=True)
    ]
    return _spec(links, directed=directed)


def _spec(found: Iterable[Link], *, directed: bool) -> GraphSpec:
    links: list[WrittenLink] = list(found)
    return GraphSpec.model_construct(arcs=links) if directed else GraphSpec.model_construct(edges=links)


def numbered(
    graphs: Iterable[ForeignGraph],
    names: Sequence[str] | None,
    specs: Iterable[GraphSpec] = (),
    agents: int | None = None,
) -> tuple[dict[str, int], list[str] | None]:
    """The number of every node of these graphs together, and the names of the agents; None where they have none.

    ``specs`` are the graphs whose agents have numbers already; ``agents``: how many there are, where that is given.
    """
    # Nodes that are all whole numbers are the agents' numbers, from 1, or from 0 if one of them is 0, unless some are
    # left out: those are names, in ascending order, lest an id of nine digits makes as many agents. Others are numbered
    # as they first appear, or by names, which raise a KeyError where a node is not there.
    nodes = list(dict.fromkeys(node for graph in graphs for node in graph.nodes))
    if all(map(is_whole, nodes)) and not set(nodes) <= set(names or []):
        first = min(map(int, nodes), default=1)
        numbers = {node: int(node) + (first == 0) for node in nodes}
        written = {agent for spec in specs for agent in written_agents(spec) if isinstance(agent, int)}
        grid = max((spec.grid[0] * spec.grid[1] for spec in specs if spec.grid), default=0)
        taken = {*numbers.values(), *written}
        if max(taken) <= (agents or len(names or ()) or grid + sum(number > grid for number in taken)):
            return numbers, list(names) if names else None
        nodes = sorted({*nodes, *map(str, written)}, key=int)
    known = list(names) if names is not None else nodes
    places = {name: number for number, name in enumerate(known, start=1)}
    return {node: places[node] for node in nodes}, known


def as_spec(graph: ForeignGraph, numbers: Mapping[str, int]) -> GraphSpec:
    """The graph with numbers of agents instead of nodes."""
    links = [(numbers[source], numbers[target], weight) for source, target, weight in graph.links]
    return _spec(links, directed=graph.directed)


def written_agents(spec: GraphSpec) -> list[int | str]:
    """Numbers and names of agents that stand in a graph, in their order; not those of a grid."""
    labels: Iterable[Any] = spec.path or spec.cycle or ()
    if spec.star:
        labels = [spec.star.center]
    elif spec.edges or spec.arcs:
        labels = (end for link in spec.edges or spec.arcs or [] for end in link[:2])
    return list(labels)


def with_numbers(spec: GraphSpec, numbers: Mapping[int | str, int]) -> GraphSpec:
    """The graph with numbers of agents instead of their names."""

    def number(agent: Any) -> Any:
        return numbers.get(agent, agent)

    changes: dict[str, Any] = {}
    for kind in spec.kinds:
        value = getattr(spec, kind)
        if kind in ("path", "cycle"):
            changes[kind] = list(map(number, value))
        elif kind in ("edges", "arcs"):
            changes[kind] = [(number(i), number(j), weight) for i, j, weight in value]
        elif kind == "star":
            changes[kind] = value.model_copy(update={"center": number(value.center)})
    return spec.model_copy(update=changes)


def largest_label(spec: GraphSpec) -> int:
    """Largest agent number that the graph mentions; 0 where it mentions none."""
    grid = spec.grid[0] * spec.grid[1] if spec.grid else 0
    return max([grid, *(agent for agent in written_agents(spec) if isinstance(agent, int))])


def links(spec: GraphSpec, agents: int) -> list[Link]:
    """(i, j, weight), agents from 1, of every edge (``arcs``: arc i -> j). Not for files: see ``graph_sources``."""
    if spec.edges is not None or spec.arcs is not None:
        return [(int(i), int(j), weight) for i, j, weight in spec.edges or spec.arcs or []]
    pairs: list[tuple[int, int]]
    if spec.path is not None:
        pairs = list(pairwise(spec.path))
    elif spec.cycle is not None:
        pairs = list(pairwise([*spec.cycle, spec.cycle[0]]))
    elif spec.star is not None:
        pairs = [(spec.star.center, j) for j in range(1, agents + 1) if j != spec.star.center]
    elif spec.grid is not None:
        labels = np.arange(1, spec.grid[0] * spec.grid[1] + 1).reshape(spec.grid)
        beside = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1)
        below = np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1)
        pairs = [(int(i), int(j)) for i, j in (*beside, *below)]
    else:
        pairs = list(combinations(range(1, agents + 1), 2))
    weight = 1.0 if spec.weight is None else spec.weight
    return [(i, j, weight) for i, j in pairs]


MOST_TWICE = 3  # repeated links that have a line each


def link_problems(
    key: str, spec: GraphSpec, agents: int, names: Sequence[str] | None = None, remedy: str = "remove the duplicate"
) -> list[str]:
    """Self-loops, duplicate links and agents that do not exist; ``key``, ``names`` and ``remedy`` are for them."""
    kind = spec.kinds[0]
    largest = largest_label(spec)
    if largest > agents:
        return [problem(key, f"agent {largest}", f"expected agents 1 to {agents}", "correct it, or raise `agents`")]
    found, twice = [], []
    seen: set[tuple[int, int]] = set()
    for i, j, _ in links(spec, agents):
        pair = (i, j) if kind == "arcs" or i < j else (j, i)
        if i == j or pair in seen:
            ends = show([i, j] if names is None else [names[i - 1], names[j - 1]])
            if i == j:
                who = agent_text(i, names)
                found.append(problem(key, ends, f"{who} is linked with itself", "remove the self-loop"))
            else:
                twice.append(ends)
        seen.add(pair)
    if len(twice) > MOST_TWICE:
        twice = [f"{twice[0]} and {len(twice) - 1} more"]
    text = "arc" if kind == "arcs" else "edge (edges have no direction)"
    return found + [problem(key, ends, f"expected every {text} once", remedy) for ends in twice]


def build_graph(name: str, spec: GraphSpec, agents: int) -> Graph:
    """The graph with its (m, m) adjacency, from a spec without mistakes."""
    found = links(spec, agents)
    if spec.arcs is None:
        found += [(j, i, weight) for i, j, weight in found]
    return Graph.of_arcs(name, agents, found)
