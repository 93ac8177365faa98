"""Figures of the report, as SVG texts. Colours of Okabe and Ito, which the colour-blind can tell apart."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from msg_analysis.model.experiment import Experiment
from msg_analysis.model.graphs import Graph
from msg_analysis.types import FloatArray, IntArray

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
MODE_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, YELLOW, BLACK)
_GREY = "#6b7280"
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
_WIDTH = 9.1  # inches, of the report's text
_NUMBERED = 8  # agents up to which heat maps show their numbers
_SOJOURNS = 150  # sojourns that can be told apart in a figure
_GRAPHS = 8  # graphs that are drawn
_LABELLED = 40  # agents up to which the drawings show their numbers


@contextmanager
def _figure(height: float, width: float = _WIDTH) -> Iterator[tuple[Figure, io.StringIO]]:
    """A figure and where its SVG text goes when the context ends."""
    text = io.StringIO()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, text
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None}, dpi=150)


def node_errors(nodes: Sequence[Mapping[str, Any]], level: float) -> str:
    """Node errors with their 95 % intervals beside the predicted ones.

    Parameters
    ----------
    nodes
        Sequence[Mapping[str, Any]] ``node_errors`` of a comparison
    level
        below which an adjusted p counts as a disagreement
    """
    agents = np.arange(1, len(nodes) + 1)
    predicted = _column(nodes, "predicted")
    measured, error = _column(nodes, "measured"), _column(nodes, "standard_error")
    p = _column(nodes, "p_holm")
    apart = np.nan_to_num(p, nan=1.0) < level
    size = float(np.clip(120 / len(nodes), 2.5, 7))
    with _figure(2.7) as (figure, text):
        axes = figure.subplots()
        half = min(0.32, 0.28 + len(nodes) / 1000)
        if not np.isnan(predicted).all():
            axes.hlines(predicted, agents - half, agents + half, color=BLACK, lw=1.4, label="predicted", zorder=3)
        for chosen, colour, label in (
            (~apart, BLUE, "measured" if np.isnan(error).all() else "measured, 95 % interval"),
            (apart, VERMILLION, "measured, disagrees"),
        ):
            if chosen.any() and not np.isnan(measured[chosen]).all():
                axes.errorbar(
                    agents[chosen],
                    measured[chosen],
                    1.96 * error[chosen],
                    fmt="o" if colour == BLUE else "s",
                    ms=size,
                    color=colour,
                    elinewidth=1.2,
                    capsize=size / 2,
                    label=label,
                )
        axes.set(xlabel="agent", ylabel="mean-square error")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=20))
        axes.grid(visible=False, axis="x")
        axes.set_xlim(0.4, len(nodes) + 0.6)
        axes.margins(y=0.12)
        if axes.get_legend_handles_labels()[0]:
            figure.legend(loc="outside upper right", ncols=3)
    return text.getvalue()


def running_estimate(running: Mapping[str, FloatArray], predicted: float | None) -> str:
    """The measured system error as it converges to the predicted one.

    Parameters
    ----------
    running
        Mapping[str, FloatArray] "time", "system_error" and "standard_error", (points,) each
    predicted
        system error
    """
    time, mean, error = running["time"], running["system_error"], running["standard_error"]
    with _figure(2.7) as (figure, text):
        axes = figure.subplots()
        if predicted is not None:
            band = (predicted - 1.96 * error, predicted + 1.96 * error)
            axes.fill_between(time, *band, color=SKY, alpha=0.3, lw=0, label="predicted ± 1.96 standard errors")
            axes.axhline(predicted, color=BLACK, lw=1.2, label="predicted")
        axes.plot(time, mean, color=BLUE, lw=1.5, label="mean up to this time")
        axes.set(xlabel="simulated time", ylabel="system error", xlim=(0, time[-1]))
        # The first moments are noise: they would flatten everything after them.
        late = time >= time[-1] / 50
        low = min(np.min(mean[late]), np.min((predicted or mean[-1]) - 1.96 * error[late]))
        high = max(np.max(mean[late]), np.max((predicted or mean[-1]) + 1.96 * error[late]))
        margin = 0.08 * (high - low) or 1.0
        axes.set_ylim(max(low - margin, 0), high + margin)  # an error is never negative
        figure.legend(loc="outside upper right", ncols=3)
    return text.getvalue()


def lateness(timing: Mapping[str, Any]) -> str:
    """Histogram of how late the steps of a run in real time were, with the deadline.

    Parameters
    ----------
    timing
        Mapping[str, Any] ``timing`` of a comparison
    """
    edges = np.array(timing["histogram"]["lateness_ms"])
    counts = np.array(timing["histogram"]["steps"])
    deadline = timing["period_ms"]
    with _figure(2.4) as (figure, text):
        axes = figure.subplots()
        axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=BLUE, lw=0)
        missed = edges[:-1] >= deadline
        axes.bar(edges[:-1][missed], counts[missed], np.diff(edges)[missed], align="edge", color=VERMILLION, lw=0)
        if edges[-1] > deadline / 2:
            axes.axvline(deadline, color=BLACK, lw=1.2, label="deadline")
            figure.legend(loc="outside upper right")
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set(xlabel="late by [ms]", ylabel="steps", ylim=(0, None))
        axes.grid(visible=False, axis="x")
    return text.getvalue()


def covariances(measured: FloatArray | None, predicted: FloatArray | None) -> str:
    """Heat maps of one scale: measured, predicted, and their difference; what there is of these.

    Parameters
    ----------
    measured, predicted
        (m, m) each
    """
    panels = [
        (title, matrix) for title, matrix in (("measured", measured), ("predicted", predicted)) if matrix is not None
    ]
    if measured is not None and predicted is not None:
        panels.append(("measured − predicted", measured - predicted))
    if not panels:
        return ""
    agents = len(panels[0][1])
    limit = max(float(np.abs(matrix).max()) for _, matrix in panels) or 1.0
    with _figure(3.1 if len(panels) > 1 else 3.4, _WIDTH if len(panels) > 1 else 4.4) as (figure, text):
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for panel, (title, matrix) in zip(axes, panels, strict=True):
            extent = (0.5, agents + 0.5, agents + 0.5, 0.5)
            image = panel.imshow(matrix, cmap="PuOr_r", vmin=-limit, vmax=limit, extent=extent, interpolation="nearest")
            panel.set_title(title)
            panel.grid(visible=False)
            panel.spines[:].set_visible(False)
            panel.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=8, min_n_ticks=1))
            panel.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=8, min_n_ticks=1))
            if agents <= _NUMBERED:
                _write_numbers(panel, matrix, limit)
        axes[0].set_ylabel("agent")
        figure.colorbar(image, ax=list(axes), shrink=0.78, pad=0.02, aspect=18).outline.set_visible(False)
    return text.getvalue()


def _write_numbers(axes: Axes, matrix: FloatArray, limit: float) -> None:
    digits = max(0, 2 - int(np.floor(np.log10(limit))))
    size = float(np.clip(48 / len(matrix), 5.5, 9))
    for (i, j), value in np.ndenumerate(matrix):
        colour = "white" if abs(value) > 0.6 * limit else BLACK
        axes.text(j + 1, i + 1, f"{value:.{digits}f}", ha="center", va="center", size=size, color=colour)


def active_graph(modes: IntArray, names: Sequence[str], stationary: FloatArray, dt: float) -> str:
    """Which graph was active when, and its share of the time beside the stationary law.

    Parameters
    ----------
    modes
        (steps,) index of the graph; -1 where not known
    names
        Sequence[str] of the graphs
    stationary
        (n,) predicted shares
    dt
        length of a step [units of simulated time]
    """
    starts = np.flatnonzero(np.diff(modes, prepend=-2))
    ends = np.append(starts[1:], len(modes))
    shown = min(len(starts), _SOJOURNS)
    colours = [MODE_COLOURS[mode % len(MODE_COLOURS)] for mode in range(len(names))]
    labels = [_shorten(name) for name in names]
    known = modes[modes >= 0]
    share = np.bincount(known, minlength=len(names)) / max(len(known), 1)
    with _figure(min(1.5 + 0.28 * len(names), 6.0)) as (figure, text):
        path, shares = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
        for mode, colour in enumerate(colours):
            mine = [s for s in range(shown) if modes[starts[s]] == mode]
            spans = [(starts[s] * dt, (ends[s] - starts[s]) * dt) for s in mine]
            path.broken_barh(spans, (mode - 0.36, 0.72), facecolors=colour, lw=0)
        path.step(
            np.append(starts[:shown], ends[shown - 1]) * dt,
            np.append(modes[starts[:shown]], modes[starts[shown - 1]]).astype(float),
            where="post",
            color=_GREY,
            lw=0.7,
        )
        path.set_yticks(range(len(names)), labels)
        path.set_xlim(0, ends[shown - 1] * dt)
        path.set_ylim(len(names) - 0.4, -0.6)
        cut = f" (the first {shown} of {len(starts)} sojourns)" if shown < len(starts) else ""
        path.set_title(f"active graph{cut}", loc="left")
        path.set_xlabel("simulated time")
        path.grid(visible=False, axis="y")
        shares.barh(range(len(names)), share, height=0.72, color=colours, alpha=0.85)
        positions = np.arange(len(names))
        shares.vlines(stationary, positions - 0.45, positions + 0.45, color=BLACK, lw=2, label="predicted")
        shares.set_title("share of the time", loc="left")
        shares.set_xlim(0, 1.12 * max(share.max(), stationary.max()))
        shares.tick_params(labelleft=False)
        shares.grid(visible=False, axis="y")
        shares.legend(loc="upper left", bbox_to_anchor=(0, -0.18), handlelength=0.8)
    return text.getvalue()


def graphs(experiment: Experiment) -> str:
    """The graphs, drawn with the same places for the agents; leaders are squares.

    Parameters
    ----------
    experiment
        whose graphs are drawn (the first eight)
    """
    chosen = experiment.graph_list[:_GRAPHS]
    places = _places(experiment.graph_list)
    columns = min(len(chosen), 4)
    rows = -(-len(chosen) // columns)
    leaders = {agent - 1 for agent in experiment.leaders.agents} if experiment.leaders else set()
    height = min(_WIDTH / columns, 3.0) * rows
    with _figure(height) as (figure, text):
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for number, panel in enumerate(panels):
            panel.set_axis_off()
            if number < len(chosen):
                draw_graph(panel, chosen[number], places, MODE_COLOURS[number % len(MODE_COLOURS)], leaders=leaders)
    return text.getvalue()


def draw_graph(
    axes: Axes,
    graph: Graph,
    places: Mapping[int, FloatArray],
    colour: str,
    *,
    leaders: Set[int] = frozenset(),
    size: float | None = None,
) -> None:
    """Draw one graph; leaders are squares.

    Parameters
    ----------
    axes
        where
    graph
        what
    places
        Mapping[int, FloatArray] (2,) of every agent, from 0
    colour
        of the links, and of the agents
    leaders
        Set[int] agents from 0
    size
        area of an agent [points^2]; by default what fits the number of agents
    """
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
    axes.set_title(_shorten(graph.name), color=BLACK)
    axes.margins(0.12)
    axes.set_aspect("equal")


def _places(graph_list: Sequence[Graph]) -> Mapping[int, FloatArray]:
    """Where the agents are drawn: by the union of all graphs."""
    union = nx.from_numpy_array(sum((g.adjacency + g.adjacency.T > 0) for g in graph_list) > 0)
    if max(degree for _, degree in union.degree) > max(4, len(union) / 2):
        places: Mapping[int, FloatArray] = nx.circular_layout(union)  # stars, complete graphs
    elif nx.is_connected(union) and len(union) <= 120:
        places = nx.kamada_kawai_layout(union)
    else:
        places = nx.spring_layout(union, seed=1, iterations=200)
    return places


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> FloatArray:
    return np.array([np.nan if row.get(key) is None else row[key] for row in rows], dtype=float)


def _shorten(name: str, length: int = 18) -> str:
    """Short enough for a label, and without what matplotlib takes for mathematics."""
    text = name if len(name) <= length else name[: length - 1] + "…"
    return text.replace("$", r"\$")
