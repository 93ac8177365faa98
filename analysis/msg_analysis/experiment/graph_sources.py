# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Graphs of all kinds: by agents, from GraphML, CSV, networkx and matrices."""

from __future__ import annotations

import csv
import io
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np

from msg_analysis.common.files import read_bytes
from msg_analysis.common.text import agent_text
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.problems import problem, show
from msg_analysis.experiment.spec import NAME_PATTERN, GraphSpec, Link, WrittenLink, is_number

_COLUMNS = ("source", "target", "weight", "type")
_NODE = f"expected a node's name of the form {NAME_PATTERN.strip('^$')}"


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


@dataclass(frozen=True, slots=True)
class ForeignGraph:
    """A graph with the nodes of its source, as texts, in their order."""

    nodes: Sequence[str]
    links: Sequence[tuple[str, str, float]]  # of a directed one: source, target, weight
    directed: bool


class GraphError(Exception):
    """One mistake in a graph from elsewhere: key, value, what was expected and what to do, as of ``problem``."""

    def __init__(self, key: str, value: object, wanted: str, remedy: str) -> None:
        super().__init__(problem(key, value, wanted, remedy))


def read_graphml(key: str, file: Path) -> ForeignGraph:
    """The graph of a GraphML file; ``key`` is for the GraphError."""
    import networkx as nx  # here, since every process of a run would wait for it

    try:
        graph = nx.read_graphml(io.BytesIO(_content(key, file)))
    except (ParseError, nx.NetworkXError, ValueError, KeyError, StopIteration, AttributeError, TypeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise GraphError(key, str(file), f"expected a GraphML file ({reason})", "export it again") from error
    if not graph:
        raise GraphError(key, str(file), "expected a graph with nodes", "export it again")
    return _of_networkx(key, graph)


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
    return _of_networkx(key, graph)


def _of_networkx(key: str, graph: Any) -> ForeignGraph:
    nodes = {node: _node(key, node) for node in graph.nodes}
    twice = [name for name, count in Counter(nodes.values()).items() if count > 1]
    if twice:
        raise GraphError(key, f"node {show(min(twice))} twice", "expected different names", "rename one")
    links = []
    for source, target, weight in graph.edges(data="weight", default=1.0):
        plain = weight.item() if isinstance(weight, np.generic) else weight
        if not is_number(plain) or plain <= 0:
            place = f"weight {show(plain)} of {source} - {target}"
            raise GraphError(key, place, "expected a weight > 0", "correct it in the file")
        links.append((nodes[source], nodes[target], float(plain)))
    return ForeignGraph(list(nodes.values()), links, graph.is_directed())


def _node(key: str, node: object) -> str:
    name = str(node).strip()
    if not re.match(NAME_PATTERN, name):
        raise GraphError(key, f"node {show(str(node))}", _NODE, "rename it")
    return name


def _content(key: str, file: Path) -> bytes:
    try:
        return read_bytes(file)
    except FileNotFoundError as error:
        raise GraphError(key, str(file), "no such file", "the path is relative to the experiment file") from error
    except OSError as error:
        raise GraphError(key, str(file), "cannot be read", str(error.strerror)) from error


def read_csv(key: str, file: Path) -> ForeignGraph:
    """The edge list of a CSV file with a header, rows are arcs or edges; ``key`` is for the GraphError."""
    wanted = "expected the columns source,target[,weight][,type], separated by commas"
    try:
        rows = csv.reader(io.StringIO(_content(key, file).decode("utf-8-sig"), newline=""), skipinitialspace=True)
        table = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except (UnicodeDecodeError, csv.Error) as error:
        raise GraphError(key, str(file), f"expected a CSV file in UTF-8 ({error})", "export it again") from error
    table = [(line, row) for line, row in table if any(row)]
    if not table:
        raise GraphError(key, str(file), f"empty: {wanted}", "write them into its first line")
    head = [name.lower() for name in table[0][1]]
    if not {"source", "target"} <= set(head) <= set(_COLUMNS) or len(set(head)) < len(head):
        place = f"{file}, line {table[0][0]}: {show(','.join(table[0][1]))}"
        raise GraphError(key, place, wanted, "correct the header")
    found, edges = [], []
    for line, row in table[1:]:
        source, target, weight, undirected = _csv_row(key, f"{file}, line {line}", head, row)
        found.append((source, target, weight))
        edges.append(undirected)
    if not found:
        raise GraphError(key, str(file), "expected rows below the header", "add one for each link")
    nodes = list(dict.fromkeys(node for source, target, _ in found for node in (source, target)))
    if all(edges):
        return ForeignGraph(nodes, found, directed=False)
    back = [(b, a, weight) for (a, b, weight), undirected in zip(found, edges, strict=True) if undirected]
    return ForeignGraph(nodes, found + back, directed=True)


def _csv_row(key: str, place: str, head: Sequence[str], row: Sequence[str]) -> tuple[str, str, float, bool]:
    """Source, target, weight, and whether the row is an edge without direction."""
    if len(row) != len(head):
        shown = f"{place}: {show(','.join(row))}"
        raise GraphError(key, shown, f"expected {len(head)} values as in the header", "correct the line")
    cells = dict(zip(head, row, strict=True))
    for end in ("source", "target"):
        if not re.match(NAME_PATTERN, cells[end]):
            raise GraphError(key, f"{place}: {end} {show(cells[end])}", _NODE, "correct the line")
    text = cells.get("weight") or "1"
    try:
        weight = float(text)
    except ValueError:
        weight = 0.0
    if not is_number(weight) or not weight > 0:
        raise GraphError(key, f"{place}: weight {show(text)}", "expected a number > 0", "correct the line")
    kind = cells.get("type", "").lower() or "directed"
    if kind not in ("directed", "undirected"):
        shown = f"{place}: type {show(cells['type'])}"
        raise GraphError(key, shown, "expected directed or undirected", "correct the line")
    return cells["source"], cells["target"], weight, kind == "undirected"


def read_matrix(key: str, file: Path) -> list[list[float]]:
    """The rows of a matrix in a file, .csv or .npy; ``key`` is for the GraphError."""
    content = io.BytesIO(_content(key, file))
    try:
        if file.suffix == ".npy":
            matrix = np.load(content, allow_pickle=False)
        else:
            matrix = np.loadtxt(io.TextIOWrapper(content, encoding="utf-8-sig"), delimiter=",", ndmin=2)
        matrix = np.asarray(matrix, dtype=float)
    except (ValueError, TypeError, EOFError) as error:
        reason = " ".join(str(error).split())
        raise GraphError(key, str(file), f"expected a matrix of numbers ({reason})", "correct it") from None
    if matrix.ndim != 2 or len(matrix) < 2 or not np.isfinite(matrix).all() or matrix.min() < 0.0:
        shape = " x ".join(map(str, matrix.shape))
        wanted = "expected a square matrix of finite numbers >= 0"
        raise GraphError(key, f"{file}: {shape}", wanted, "row i has the weights with which agent i listens")
    rows: list[list[float]] = matrix.tolist()
    return rows


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


def numbered(graphs: Iterable[ForeignGraph], names: Sequence[str] | None) -> tuple[dict[str, int], list[str] | None]:
    """The number of every node of these graphs together, and the names of the agents; None where they have none."""
    # Nodes that are all whole numbers are the agents' numbers, from 1, or from 0 if one of them is 0. Others are
    # numbered as they first appear, or by names, which raise a KeyError where a node is not there.
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


def named_agents(spec: GraphSpec) -> list[str]:
    """Names that stand in a graph for numbers of agents, in their order."""
    labels: Iterable[object] = spec.path or spec.cycle or ()
    if spec.star:
        labels = [spec.star.center]
    elif spec.edges or spec.arcs:
        labels = (end for link in spec.edges or spec.arcs or [] for end in link[:2])
    return [label for label in labels if isinstance(label, str)]


def with_numbers(spec: GraphSpec, numbers: Mapping[str, int]) -> GraphSpec:
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
    if spec.path or spec.cycle:
        return max(map(int, spec.path or spec.cycle or [0]))
    if spec.star:
        return spec.star.center
    if spec.grid:
        return spec.grid[0] * spec.grid[1]
    return max((int(end) for link in spec.edges or spec.arcs or [] for end in link[:2]), default=0)


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


def link_problems(key: str, spec: GraphSpec, agents: int, names: Sequence[str] | None = None) -> list[str]:
    """Self-loops, duplicate links and agents that do not exist; ``key`` and ``names`` of the agents are for them."""
    kind = spec.kinds[0]
    largest = largest_label(spec)
    if largest > agents:
        return [problem(key, f"agent {largest}", f"expected agents 1 to {agents}", "correct it, or raise `agents`")]
    found = []
    seen: set[tuple[int, int]] = set()
    for i, j, _ in links(spec, agents):
        pair = (i, j) if kind == "arcs" else (min(i, j), max(i, j))
        ends = show([i, j] if names is None else [names[i - 1], names[j - 1]])
        if i == j:
            who = agent_text(i, names)
            found.append(problem(key, ends, f"{who} is linked with itself", "remove the self-loop"))
        elif pair in seen:
            text = "arc" if kind == "arcs" else "edge (edges have no direction)"
            found.append(problem(key, ends, f"expected every {text} once", "remove the duplicate"))
        seen.add(pair)
    return found


def build_graph(name: str, spec: GraphSpec, agents: int) -> Graph:
    """The graph with its (m, m) adjacency, from a spec without mistakes."""
    adjacency = np.zeros((agents, agents))
    for i, j, weight in links(spec, agents):
        adjacency[j - 1, i - 1] = weight
        if spec.arcs is None:
            adjacency[i - 1, j - 1] = weight
    return Graph(name, adjacency)
