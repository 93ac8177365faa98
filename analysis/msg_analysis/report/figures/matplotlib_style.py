"""matplotlib style of the figures, and drawings of graphs."""

from __future__ import annotations

from collections.abc import Mapping, Set

import networkx as nx
from matplotlib.axes import Axes

from msg_analysis.model.network.graphs import Graph
from msg_analysis.report.figures.palette import BLACK, shorten
from msg_analysis.types import FloatArray

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9ca3af",
    "axes.titlesize": 10,
    "axes.labelcolor": "#374151",
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "msg_analysis",
}
_LABELLED = 40  # most agents whose numbers are shown


def draw_graph(
    axes: Axes,
    graph: Graph,
    places: Mapping[int, FloatArray],  # (2,) of every agent, from 0
    colour: str,
    *,
    leaders: Set[int] = frozenset(),  # from 0
    size: float | None = None,  # area of an agent [points^2]; None: by the number of agents
) -> None:
    """Draw one graph; leaders are squares."""
    agents = graph.agents
    size = size or (float(min(4200 / agents, 260)) if agents <= _LABELLED else 14.0)
    network = nx.DiGraph() if not graph.symmetric else nx.Graph()
    network.add_nodes_from(range(agents))
    arcs = graph.edges if graph.symmetric else graph.arcs
    network.add_weighted_edges_from((source - 1, target - 1, weight) for source, target, weight in arcs)
    heaviest = max((weight for _, _, weight in arcs), default=1.0)
    widths = [0.4 + 1.3 * weight / heaviest for _, _, weight in arcs]
    for shape, members in (("o", [i for i in range(agents) if i not in leaders]), ("s", sorted(leaders))):
        nx.draw_networkx_nodes(
            network, places, nodelist=members, ax=axes, node_size=size, node_color="white",
            edgecolors=colour, linewidths=1.3, node_shape=shape,
        )  # fmt: skip
    arrows = {} if graph.symmetric else {"arrowsize": 7}
    nx.draw_networkx_edges(
        network, places, ax=axes, edge_color=colour, width=widths, node_size=size, alpha=0.8, **arrows
    )
    if agents <= _LABELLED:
        names = {i: str(i + 1) for i in range(agents)}
        nx.draw_networkx_labels(network, places, names, ax=axes, font_size=8 if agents <= 20 else 5.5)
    axes.set_title(shorten(graph.name).replace("$", r"\$"), color=BLACK)  # matplotlib reads $ as mathematics
    axes.margins(0.12)
    axes.set_aspect("equal")
