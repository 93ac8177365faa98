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

"""matplotlib style of the figures, their files, and drawings of graphs."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence, Set

import networkx as nx
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.model.network.graphs import Graph
from msg_analysis.report.figures.agent_places import LABELLED, line_width
from msg_analysis.report.figures.palette import BLACK, DARK_GREY, INK, LIGHT_GREY, PALE, shorten
from msg_analysis.types import FloatArray

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": LIGHT_GREY,
    "axes.titlesize": 10,
    "axes.labelcolor": INK,
    "xtick.color": DARK_GREY,
    "ytick.color": DARK_GREY,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "msg_analysis",
}


def plain(text: str) -> str:
    """The text without mathematics, which matplotlib finds between dollars."""
    return text.replace("$", r"\$")


def rendered(figure: Figure, kind: str, dpi: float) -> bytes:
    """The file of a figure (png, svg or pdf), without times and versions in it."""
    without = {"png": ("Software",), "svg": ("Date", "Creator")}.get(kind, ("CreationDate", "Creator", "Producer"))
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=dpi, metadata=dict.fromkeys(without))
    return stream.getvalue()


def draw_graph(
    axes: Axes,
    graph: Graph,
    places: Mapping[int, FloatArray],  # (2,) of every agent, from 0
    colour: str,
    *,
    leaders: Set[int] = frozenset(),  # from 0
    names: Sequence[str] | None = None,
    size: float | None = None,  # area of an agent [points^2]; None: by the number of agents
) -> None:
    """Draw one graph; leaders are squares."""
    agents = graph.agents
    size = size or (float(min(4200 / agents, 260)) if agents <= LABELLED else 14.0)
    network = nx.DiGraph() if not graph.symmetric else nx.Graph()
    network.add_nodes_from(range(agents))
    arcs = graph.edges if graph.symmetric else graph.arcs
    network.add_weighted_edges_from((source - 1, target - 1, weight) for source, target, weight in arcs)
    heaviest = max((weight for _, _, weight in arcs), default=1.0)
    widths = [line_width(weight / heaviest) for _, _, weight in arcs]
    for shape, members in (("o", [i for i in range(agents) if i not in leaders]), ("s", sorted(leaders))):
        nx.draw_networkx_nodes(
            network, places, nodelist=members, ax=axes, node_size=size, node_color="white",
            edgecolors=colour, linewidths=1.3, node_shape=shape,
        )  # fmt: skip
    arrows = {} if graph.symmetric else {"arrowsize": 7}
    nx.draw_networkx_edges(
        network, places, ax=axes, edge_color=colour, width=widths, node_size=size, alpha=0.8, **arrows
    )
    if agents <= LABELLED:
        labels = {i: plain(shorten(agent_name(i + 1, names), 8)) for i in range(agents)}
        nx.draw_networkx_labels(network, places, labels, ax=axes, font_size=8 if agents <= 20 else 5.5)
    axes.set_title(plain(shorten(graph.name)), color=BLACK)
    axes.margins(0.12)
    axes.set_aspect("equal")
