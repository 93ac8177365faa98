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

"""From the ways in which the file gives a graph, or the losses of links, to links and matrices."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from msg_analysis.common.text.agent_names import agent_name, agent_text
from msg_analysis.common.text.number_words import listed
from msg_analysis.model.experiment.problems import problem, show
from msg_analysis.model.network.graphs import Graph, hops
from msg_analysis.model.network.markov_chain import Time
from msg_analysis.model.spec.graphs import GraphSpec, Link
from msg_analysis.model.spec.noise import LossSpec
from msg_analysis.types import BoolArray, FloatArray


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
    """(i, j, weight), agents from 1, of every edge (``arcs``: arc i -> j). Not for files: see ``graph_sources``."""
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


def link_problems(key: str, spec: GraphSpec, agents: int, names: Sequence[str] | None = None) -> list[str]:
    """Self-loops, duplicate links and agents that do not exist; ``key`` and ``names`` of the agents are for them."""
    kind = spec.kinds[0]
    largest = largest_label(spec)
    if largest > agents:
        return [
            problem(key, f"agent {largest}", f"expected agents 1 to {agents}", "correct it, or raise `agents`"),
        ]
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


def numbered_losses(loss: LossSpec, names: Sequence[str] | None) -> tuple[LossSpec, list[str]]:
    """The same with numbers instead of names of agents, and the names that are unknown."""
    found: list[str] = []

    def number(key: str, agent: int | str) -> int | str:
        if not isinstance(agent, str):
            return agent
        if agent in (names or []):
            return (names or []).index(agent) + 1
        wanted = f"expected one of the names {listed(names)}" if names else "expected a number, since no agent is named"
        found.append(problem(key, show(agent), wanted, "correct it"))
        return agent

    numbers = {
        kind: [(number(f"noise.loss.{kind}", i), number(f"noise.loss.{kind}", j), p) for i, j, p in getattr(loss, kind)]
        for kind in ("edges", "arcs")
    }
    return loss.model_copy(update=numbers), found


def loss_matrix(
    loss: LossSpec, graphs: Sequence[Graph], time: Time, names: Sequence[str] | None
) -> tuple[FloatArray, list[str]]:
    """(m, m) probability that a message from agent j (column) to agent i (row) is lost, 0 on the diagonal.

    Also the links in ``loss``, which has numbers of agents, that are in no graph or are repeated.
    """
    agents, found = graphs[0].agents, []
    heard = heard_links(graphs, time)
    matrix = np.where(np.eye(agents, dtype=np.bool_), 0.0, loss.default)
    seen: set[tuple[int, int]] = set()
    directed = [("arcs", int(i), int(j), p) for i, j, p in loss.arcs]
    directed += [("edges", *ends, p) for i, j, p in loss.edges for ends in ((int(i), int(j)), (int(j), int(i)))]
    for kind, i, j, probability in directed:
        key, ends = f"noise.loss.{kind}", show([i, j] if names is None else [agent_name(a, names) for a in (i, j)])
        if max(i, j) > agents or not heard[j - 1, i - 1]:
            wanted = f"expected agents of which {agent_name(j, names)} hears {agent_name(i, names)} in some graph"
            found.append(problem(key, ends, wanted, "correct it"))
        elif (i, j) in seen:
            found.append(problem(key, ends, "expected every link once, in each direction", "remove one"))
        else:
            matrix[j - 1, i - 1] = probability
        seen.add((i, j))
    return matrix, found


def heard_links(graphs: Sequence[Graph], time: Time) -> BoolArray:
    """(m, m) whether agent i hears agent j in some graph: in discrete time, with exp(-Z), over many arcs, too."""
    heard = np.any([graph.adjacency > 0 for graph in graphs], axis=0)
    if time == "discrete":
        heard = np.any([[hops(graph.adjacency > 0, [i]) > 0 for i in range(graph.agents)] for graph in graphs], axis=0)
    return np.asarray(heard)
