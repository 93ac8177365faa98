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

"""What drawings of graphs share: places of the agents, the same in every graph, numbers of agents, widths of links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import networkx as nx

from msg_analysis.model.network.graphs import Graph
from msg_analysis.types import FloatArray

LABELLED = 40
"""Most agents whose numbers are shown."""


def line_width(share: float) -> float:
    """Width of a link whose weight is this share of the heaviest one."""
    return 0.4 + 1.3 * share


def places(graph_list: Sequence[Graph]) -> Mapping[int, FloatArray]:
    """Position (2,) of every agent, from 0, within about -1 to 1; laid out by the union of all graphs."""
    union = nx.from_numpy_array(sum((g.adjacency + g.adjacency.T > 0) for g in graph_list) > 0)
    if max(degree for _, degree in union.degree) > max(4, len(union) / 2):
        found: Mapping[int, FloatArray] = nx.circular_layout(union)  # for example stars and complete graphs
    elif nx.is_connected(union) and len(union) <= 120:
        found = nx.kamada_kawai_layout(union)
    else:
        found = nx.spring_layout(union, seed=1, iterations=200)
    return found
