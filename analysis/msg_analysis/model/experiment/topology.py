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

"""From the ways in which the file gives a graph to links and matrices."""

from __future__ import annotations

import io
from itertools import combinations, pairwise
from pathlib import Path
from xml.etree.ElementTree import ParseError

import numpy as np

from msg_analysis.common.bounded_input import read_bytes
from msg_analysis.model.experiment.problems import problem, show
from msg_analysis.model.experiment.spec import GraphSpec, Link, is_number
from msg_analysis.model.network.graphs import Graph


def largest_label(spec: GraphSpec) -> int:
    """Largest agent number that the graph mentions; 0 where it mentions none."""
    if spec.path or spec.cycle:
        return max(spec.path or spec.cycle or [0])
    if spec.star:
        return spec.star.center
    if spec.grid:
        return spec.grid[0] * spec.grid[1]
    return max((label for link in spec.edges or spec.arcs or [] for label in link[:2]), default=0)


def links(spec: GraphSpec, agents: int) -> list[Link]:
    """(i, j, weight), agents from 1, of every edge (``arcs``: arc i -> j). Not for GraphML: see ``read_graphml``."""
    if spec.edges is not None or spec.arcs is not None:
        return list(spec.edges or spec.arcs or [])
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
    return [(i, j, 1.0) for i, j in pairs]


def link_problems(name: str, spec: GraphSpec, agents: int) -> list[str]:
    """Self-loops, duplicate links and agents that do not exist."""
    kind = spec.kinds[0]
    key = f"graphs.{name}.{kind}"
    largest = largest_label(spec)
    if largest > agents:
        return [
            problem(key, f"agent {largest}", f"expected agents 1 to {agents}", "correct it, or raise `agents`"),
        ]
    found = []
    seen: set[tuple[int, int]] = set()
    for i, j, _ in links(spec, agents):
        pair = (i, j) if kind == "arcs" else (min(i, j), max(i, j))
        if i == j:
            found.append(problem(key, show([i, j]), f"agent {i} is linked with itself", "remove the self-loop"))
        elif pair in seen:
            text = "arc" if kind == "arcs" else "edge (edges have no direction)"
            found.append(problem(key, show([i, j]), f"expected every {text} once", "remove the duplicate"))
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


def read_graphml(name: str, file: Path) -> tuple[GraphSpec, int, list[str]]:
    """A GraphML file as edges (arcs if directed), its number of agents, and problems (then the rest is meaningless).

    ``name`` of the graph is for messages.
    """
    import networkx as nx  # here, since every process of a run would wait for it

    key = f"graphs.{name}.graphml"
    empty = GraphSpec(edges=[])
    try:
        graph = nx.read_graphml(io.BytesIO(read_bytes(file)))
    except FileNotFoundError:
        return (
            empty,
            0,
            [problem(key, str(file), "no such file", "the path is relative to the experiment file")],
        )
    except OSError as error:
        return empty, 0, [problem(key, str(file), "cannot be read", str(error.strerror))]
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
        return empty, 0, [problem(key, str(file), f"expected a GraphML file ({reason})", "export it again")]
    nodes = list(graph.nodes)
    if not nodes:
        return empty, 0, [problem(key, str(file), "expected a graph with nodes", "export it again")]
    if all(str(node).isascii() and str(node).isdigit() and int(node) >= 1 for node in nodes):
        labels = {node: int(node) for node in nodes}
    else:
        labels = {node: number for number, node in enumerate(nodes, start=1)}
    found: list[Link] = []
    for source, target, weight in graph.edges(data="weight", default=1.0):
        if not is_number(weight) or weight <= 0:
            place = f"weight {show(weight)} of {source} - {target}"
            return empty, 0, [problem(key, place, "expected a weight > 0", "correct it in the file")]
        found.append((labels[source], labels[target], float(weight)))
    kind = "arcs" if graph.is_directed() else "edges"
    return GraphSpec.model_validate({kind: found}), max(labels.values(), default=0), []
