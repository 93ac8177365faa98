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

"""Graphs from elsewhere (GraphML, CSV, networkx, adjacency matrices), and the numbers of their nodes."""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np

from msg_analysis.common.bounded_input import read_bytes
from msg_analysis.model.experiment.problems import problem, show
from msg_analysis.model.spec.graphs import GraphSpec, Link
from msg_analysis.model.spec.values import NAME_PATTERN, is_number

_COLUMNS = ("source", "target", "weight", "type")
_NODE = f"expected a node's name of the form {NAME_PATTERN.strip('^$')}"


@dataclass(frozen=True, slots=True)
class ForeignGraph:
    """A graph with the nodes of its source, as texts, in their order."""

    nodes: Sequence[str]
    links: Sequence[tuple[str, str, float]]  # of a directed one: source, target, weight
    directed: bool


class GraphError(Exception):
    """One mistake in a graph from elsewhere; the text is a line of ``problems.problem``."""


def read_graphml(key: str, file: Path) -> ForeignGraph:
    """The graph of a GraphML file; ``key`` is for the GraphError."""
    import networkx as nx  # here, since every process of a run would wait for it

    try:
        graph = nx.read_graphml(io.BytesIO(_content(key, file)))
    except (
        ParseError,
        nx.NetworkXError,
        ValueError,
        KeyError,
        StopIteration,
        AttributeError,
        TypeError,
    ) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise GraphError(problem(key, str(file), f"expected a GraphML file ({reason})", "export it again")) from error
    if not graph:
        raise GraphError(problem(key, str(file), "expected a graph with nodes", "export it again"))
    return _of_networkx(key, graph)


def is_networkx(value: object) -> bool:
    """Whether it is a graph of networkx; without its import, which takes long."""
    networkx = sys.modules.get("networkx")
    return networkx is not None and isinstance(value, networkx.Graph)


def from_networkx(key: str, graph: Any) -> ForeignGraph:
    """A graph of networkx; ``key`` is for the GraphError."""
    if graph.is_multigraph():
        wanted, kind = "expected a networkx.Graph or networkx.DiGraph", type(graph).__name__
        raise GraphError(problem(key, f"a {kind}", wanted, "convert it, for example networkx.Graph(graph)"))
    if not graph:
        raise GraphError(problem(key, "a graph without nodes", "expected a graph with nodes", "add nodes"))
    return _of_networkx(key, graph)


def _of_networkx(key: str, graph: Any) -> ForeignGraph:
    nodes = {node: _node(key, node) for node in graph.nodes}
    twice = sorted({name for name in nodes.values() if list(nodes.values()).count(name) > 1}) if _repeat(nodes) else []
    if twice:
        raise GraphError(problem(key, f"node {show(twice[0])} twice", "expected different names", "rename one"))
    links = []
    for source, target, weight in graph.edges(data="weight", default=1.0):
        plain = weight.item() if isinstance(weight, np.generic) else weight
        if not is_number(plain) or plain <= 0:
            place = f"weight {show(plain)} of {source} - {target}"
            raise GraphError(problem(key, place, "expected a weight > 0", "correct it in the file"))
        links.append((nodes[source], nodes[target], float(plain)))
    return ForeignGraph(list(nodes.values()), links, graph.is_directed())


def _repeat(nodes: Mapping[Any, str]) -> bool:
    return len(set(nodes.values())) < len(nodes)


def _node(key: str, node: object) -> str:
    name = str(node).strip()
    if not re.match(NAME_PATTERN, name):
        raise GraphError(problem(key, f"node {show(str(node))}", _NODE, "rename it"))
    return name


def _content(key: str, file: Path) -> bytes:
    try:
        return read_bytes(file)
    except FileNotFoundError as error:
        line = problem(key, str(file), "no such file", "the path is relative to the experiment file")
        raise GraphError(line) from error
    except OSError as error:
        raise GraphError(problem(key, str(file), "cannot be read", str(error.strerror))) from error


def read_csv(key: str, file: Path) -> ForeignGraph:
    """The edge list of a CSV file with a header; ``key`` is for the GraphError.

    A row is an arc to the ``target``, which listens to the ``source``; with ``undirected`` in ``type``, an edge.
    """
    wanted = "expected the columns source,target[,weight][,type], separated by commas"
    try:
        rows = csv.reader(io.StringIO(_content(key, file).decode("utf-8-sig"), newline=""), skipinitialspace=True)
        table = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except (UnicodeDecodeError, csv.Error) as error:
        raise GraphError(
            problem(key, str(file), f"expected a CSV file in UTF-8 ({error})", "export it again")
        ) from error
    table = [(line, row) for line, row in table if any(row)]
    if not table:
        raise GraphError(problem(key, str(file), f"empty: {wanted}", "write them into its first line"))
    head = [name.lower() for name in table[0][1]]
    if not {"source", "target"} <= set(head) <= set(_COLUMNS) or len(set(head)) < len(head):
        place = f"{file}, line {table[0][0]}: {show(','.join(table[0][1]))}"
        raise GraphError(problem(key, place, wanted, "correct the header"))
    found, edges = [], []
    for line, row in table[1:]:
        source, target, weight, undirected = _csv_row(key, f"{file}, line {line}", head, row)
        found.append((source, target, weight))
        edges.append(undirected)
    if not found:
        raise GraphError(problem(key, str(file), "expected rows below the header", "add one for each link"))
    nodes = list(dict.fromkeys(node for source, target, _ in found for node in (source, target)))
    if all(edges):
        return ForeignGraph(nodes, found, directed=False)
    back = [(b, a, weight) for (a, b, weight), undirected in zip(found, edges, strict=True) if undirected]
    return ForeignGraph(nodes, found + back, directed=True)


def _csv_row(key: str, place: str, head: Sequence[str], row: Sequence[str]) -> tuple[str, str, float, bool]:
    """Source, target, weight, and whether the row is an edge without direction."""
    if len(row) != len(head):
        shown = f"{place}: {show(','.join(row))}"
        raise GraphError(problem(key, shown, f"expected {len(head)} values as in the header", "correct the line"))
    cells = dict(zip(head, row, strict=True))
    for end in ("source", "target"):
        if not re.match(NAME_PATTERN, cells[end]):
            raise GraphError(problem(key, f"{place}: {end} {show(cells[end])}", _NODE, "correct the line"))
    text = cells.get("weight") or "1"
    try:
        weight = float(text)
    except ValueError:
        weight = 0.0
    if not is_number(weight) or not weight > 0:
        raise GraphError(problem(key, f"{place}: weight {show(text)}", "expected a number > 0", "correct the line"))
    kind = cells.get("type", "").lower() or "directed"
    if kind not in ("directed", "undirected"):
        shown = f"{place}: type {show(cells['type'])}"
        raise GraphError(problem(key, shown, "expected directed or undirected", "correct the line"))
    return cells["source"], cells["target"], weight, kind == "undirected"


def from_adjacency(key: str, rows: Sequence[Sequence[float]]) -> GraphSpec:
    """A matrix whose row i has the weights with which agent i listens; edges where it is symmetric, else arcs."""
    if any(len(row) != len(rows) for row in rows):
        shape = f"{len(rows)} rows of {' or '.join(sorted({str(len(row)) for row in rows}))} entries"
        wanted = "expected a square matrix"
        raise GraphError(problem(key, shape, wanted, "give one row and one column for each agent"))
    matrix = np.array(rows, dtype=float)
    for i in np.flatnonzero(np.diag(matrix)).tolist():
        wanted = "expected 0 on the diagonal, since no agent listens to itself"
        raise GraphError(problem(f"{key}[{i + 1}][{i + 1}]", float(matrix[i, i]), wanted, "set it to 0"))
    directed = not np.array_equal(matrix, matrix.T)
    listeners, sources = np.nonzero(matrix if directed else np.tril(matrix))
    links = [
        (source + 1, listener + 1, float(matrix[listener, source]))
        for listener, source in zip(listeners.tolist(), sources.tolist(), strict=True)
    ]
    return _spec(links, directed=directed)


def _spec(links: list[Link], *, directed: bool) -> GraphSpec:
    return GraphSpec.model_construct(arcs=links) if directed else GraphSpec.model_construct(edges=links)


def numbered(graphs: Iterable[ForeignGraph], names: Sequence[str] | None) -> tuple[dict[str, int], list[str] | None]:
    """The number of every node of these graphs together, and the names of the agents; None where they have none.

    Nodes that are all whole numbers are the agents' numbers, counted from 1, or from 0 if one of them is 0. Others are
    numbered in the order in which they first appear, or by ``names``, which raise a KeyError where a node is not there.
    """
    nodes = list(dict.fromkeys(node for graph in graphs for node in graph.nodes))
    if all(node.isascii() and node.isdigit() for node in nodes) and not set(nodes) <= set(names or []):
        first = min(map(int, nodes), default=1)
        return {node: int(node) + (first == 0) for node in nodes}, list(names) if names else None
    known = list(names) if names is not None else nodes
    places = {name: number for number, name in enumerate(known, start=1)}
    return {node: places[node] for node in nodes}, known


def as_spec(graph: ForeignGraph, numbers: Mapping[str, int]) -> GraphSpec:
    """The graph with numbers of agents instead of nodes."""
    links = [(numbers[source], numbers[target], weight) for source, target, weight in graph.links]
    return _spec(links, directed=graph.directed)
