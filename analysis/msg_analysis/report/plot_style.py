# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What all interactive plots share: colours, axes, legends, thinned series; and what the verdict names."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import BasicTicker, BoxAnnotation, HoverTool, PlainText
from bokeh.plotting import figure

from msg_analysis.common.arrays import BLOCK_NUMBERS, FloatArray, release
from msg_analysis.report.look import shorten


@dataclass(frozen=True, slots=True)
class Candidates:
    """Agents (from 1), links and jumps that the causes name, the first cause first."""

    agents: tuple[int, ...] = ()  # by themselves
    links: tuple[tuple[int, int, str | None], ...] = ()  # sender, receiver or two ends; graph, None: all graphs
    pairs: tuple[tuple[int, int], ...] = ()  # with correlated noise
    jumps: tuple[tuple[str, str | None], ...] = ()  # from a graph to another, None: to any

    @classmethod
    def of(cls, causes: Sequence[Mapping[str, Any]]) -> Candidates:
        """Of the causes of a comparison's document."""
        links = [(cause, tuple(cause["link"])) for cause in causes if cause["link"]]
        return cls(
            tuple(dict.fromkeys(cause["agent"] for cause in causes if cause["agent"] is not None)),
            tuple((*ends, cause["graph"]) for cause, ends in links if cause["kind"] != "correlation"),
            tuple(ends for cause, ends in links if cause["kind"] == "correlation"),
            tuple(
                (cause["graph"][0], cause["graph"][1] if len(cause["graph"]) > 1 else None)
                for cause in causes
                if cause["kind"] == "switching" and cause["graph"]
            ),
        )

    @property
    def involved(self) -> list[int]:
        """The agents, and those at the ends of the links."""
        return list(dict.fromkeys([*self.agents, *(end for ends in self.entries for end in ends)]))

    @property
    def entries(self) -> list[tuple[int, int]]:
        """The two ends of each link, and the pairs."""
        return [*((first, second) for first, second, _ in self.links), *self.pairs]

    def links_of(self, graph: str) -> set[tuple[int, int]]:
        """The links in a graph."""
        return {(first, second) for first, second, where in self.links if where in (None, graph)}

    def jump(self, origin: str, to: str) -> bool:
        """Whether the jump from one graph to another is named."""
        return any(first == origin and second in (None, to) for first, second in self.jumps)


NOBODY = Candidates()


# Those of agents are saturated, mostly Okabe-Ito colours, which colour-blind readers can tell apart, darker where their
# contrast to white is below 3; those of graphs are dull; vermillion is what is rejected or named by the verdict, alone.
# Shapes and line styles differ as well. The page's script exchanges the colours in the plots.
BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#b97a00", "#00875f", "#b4598c"
SKY, VERMILLION, OLIVE, BLACK = "#2a8fcb", "#c85000", "#8a7d00", "#000000"
VIOLET = "#6a4fb3"
LINES = (BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK, OLIVE, VIOLET)
GRAPHS = ("#64788c", "#77864a", "#93709c", "#7a5c3e", "#4f8a8b", "#a0705a", "#7f8794", "#4b4f57")
_DARK_GRAPHS = ("#9fb3c8", "#b5c486", "#c8a8d1", "#b8977a", "#86c2c2", "#d6a58c", "#b9c0cc", "#e3e6ea")
INK, GREY, PALE, PAGE = "#374151", "#6b7280", "#e5e7eb", "#ffffff"
DARK = {
    **dict(zip(GRAPHS, _DARK_GRAPHS, strict=True)),
    BLUE: "#4da3e0",
    ORANGE: "#f0b030",
    GREEN: "#2fc79a",
    PURPLE: "#e39ac6",
    SKY: "#9adbff",
    VERMILLION: "#ff8a4c",
    OLIVE: "#f0e442",
    VIOLET: "#b3a3f0",
    BLACK: "#f9fafb",
    INK: "#d1d5db",
    GREY: "#9ca3af",
    PALE: "#2b3340",
    PAGE: "#12161d",
}
"""The colours on a dark page, by those on a white one; all different."""
HEAT = ("#b35806", "#f1a340", "#f7f7f7", "#998ec3", "#542788")
"""Of matrices, from the lowest to the highest number, with zero in the middle."""
DARK_HEAT = ("#ffb454", "#8a5a1e", "#1b2029", "#5a4c97", "#b9a8ff")

SCALE = ("#f7f7f7", "#c9bdf0", "#8a78d0")
"""Of results, from the lowest to the highest; black numbers are read on all of them, and white ones in the dark."""
DARK_SCALE = ("#1b2029", "#3d3578", "#6450c0")


def graph_colour(mode: int) -> str:
    """Colour of a graph, from 0; repeats after eight."""
    return GRAPHS[mode % len(GRAPHS)]


def graph_variable(mode: int) -> str:
    """The same as a variable of the page's style, which depends on the scheme."""
    return f"var(--graph-{mode % len(GRAPHS)})"


SANS = "system-ui, -apple-system, 'Segoe UI', 'Noto Sans', 'DejaVu Sans', sans-serif"


def new_figure(height: int, tools: str = "box_zoom,pan,wheel_zoom,reset,save", **options: Any) -> Any:
    """An empty figure in the report's style, ``height`` in pixels; the wheel scrolls the page unless zoom is chosen."""
    settings = {"sizing_mode": "stretch_width", "active_scroll": None} | options
    plot = figure(height=height, tools=tools, **settings)
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.outline_line_color = None
    plot.grid.grid_line_color = PALE
    plot.background_fill_color = plot.border_fill_color = None  # that of the page
    for axis in plot.axis:
        axis.axis_label_text_font = axis.major_label_text_font = SANS
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_color = axis.major_label_text_color = INK
        axis.axis_line_color = axis.major_tick_line_color = GREY
        axis.minor_tick_line_color = None
    plot.title.text_font, plot.title.text_color = SANS, INK
    return plot


def name_agents(axes: Any, names: Sequence[str] | None) -> None:
    """Write the names of the agents, if any, beside these axes, instead of the numbers 1 to m."""
    if names:
        axes.major_label_overrides = {i: PlainText(text=shorten(name, 10)) for i, name in enumerate(names, start=1)}


def agent_figure(
    height: int, count: int, names: Sequence[str] | None, marked: Iterable[int], *tools: str, **options: Any
) -> Any:
    """A ``new_figure`` with the agents along its horizontal axis; those that the verdict names are shaded."""
    plot = new_figure(height, *tools, x_axis_label="agent", x_range=(0.3, count + 0.7), **options)
    # Whole numbers; fewer on narrow screens, by the page's script.
    plot.xaxis.ticker = BasicTicker(desired_num_ticks=20, min_interval=1, num_minor_ticks=0, tags=["agents"])
    plot.xgrid.grid_line_color = None
    name_agents(plot.xaxis, names)
    for agent in marked:
        mark = BoxAnnotation(left=agent - 0.5, right=agent + 0.5, level="underlay", name=f"candidates {agent}")
        mark.fill_color, mark.fill_alpha, mark.line_color = VERMILLION, 0.18, None
        plot.add_layout(mark)
    return plot


def show_values(plot: Any, drawn: Sequence[Any], rows: Sequence[tuple[str, str]], **how: Any) -> None:
    """Show these rows while the pointer is on what is drawn."""
    plot.add_tools(HoverTool(renderers=[*drawn], tooltips=[*rows], **how))


def place_legend(plot: Any) -> None:
    """Move the legend, if any, above the figure, into one row."""
    if plot.legend:
        legend = plot.legend[0]
        plot.add_layout(legend, "above")
        legend.orientation = "horizontal"
        plain_legend(legend)


def plain_legend(legend: Any) -> None:
    """Give a legend the report's style."""
    legend.border_line_color = legend.background_fill_color = None
    legend.label_text_font, legend.label_text_font_size, legend.label_text_color = SANS, "12px", INK
    legend.margin = legend.padding = 0
    legend.spacing = 16


NUMBERS = 80_000  # values of the agents that are kept, at most about
_LARGEST = 1e30  # of single precision: 3e38


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """Arrays (bins, series) of single precision: lowest and highest known value in each bin; NaN where none is."""

    width: int  # steps in a bin; with one, lowest and highest are the same array
    values: tuple[FloatArray, FloatArray]  # (bins, m) states of the agents
    deviations: tuple[FloatArray, FloatArray]  # (bins, m) the same without the centre
    centre: tuple[FloatArray, FloatArray]  # (bins, 1) mean of the agents, or the reference
    error: tuple[FloatArray, FloatArray]  # (bins, 1) sum of the squared deviations


def thin(
    states: FloatArray,  # (N + 1, m, replicas), perhaps in a file; NaN where missing
    replica: int,
    reference: float | None,  # None: the mean of the agents
    numbers: int = NUMBERS,
    block_numbers: int = BLOCK_NUMBERS,
) -> Thinned:
    """Thin one replica; the memory needed does not depend on the length of the run."""
    return thin_together(states, slice(replica, replica + 1), reference, numbers, block_numbers)[0]


def thin_together(
    states: FloatArray,  # as in ``thin``
    replicas: slice,
    reference: float | None,
    numbers: int,  # of each replica, at most about
    block_numbers: int = BLOCK_NUMBERS,  # that are looked at together
) -> list[Thinned]:
    """Thin several replicas, each to the same width, while the states are read once."""
    count, agents = states.shape[:2]
    several = len(range(states.shape[2])[replicas])
    width = max(1, math.ceil(2 * count * agents / numbers)) if count * agents > numbers else 1
    bins = math.ceil(count / width)
    low, high = (
        [np.empty((several, bins, agents if key < 2 else 1), np.float32) for key in range(4)] for _ in range(2)
    )
    length = width * max(1, block_numbers // max(1, width * states[:1].size))
    for first in range(0, count, length):
        piece = np.clip(states[first : first + length, :, replicas], -_LARGEST, _LARGEST)
        centre = piece.mean(axis=1, keepdims=True) if reference is None else np.full_like(piece[:, :1], reference)
        deviations = piece - centre
        error = np.minimum(np.square(deviations).sum(axis=1, keepdims=True), _LARGEST)
        starts = np.arange(0, len(piece), width)
        place = slice(first // width, first // width + len(starts))
        for key, series in enumerate((piece, deviations, centre, error)):
            low[key][:, place] = np.moveaxis(np.fmin.reduceat(series, starts, axis=0), 2, 0)
            high[key][:, place] = np.moveaxis(np.fmax.reduceat(series, starts, axis=0), 2, 0)
        release(states)
    pairs = [
        [(one, one if width == 1 else other) for one, other in zip(*both, strict=True)]
        for both in zip(low, high, strict=True)
    ]
    return [Thinned(width, *of_replica) for of_replica in zip(*pairs, strict=True)]


def envelope(pair: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """(bins,) lowest and highest value of all series; NaN where none is known."""
    return np.fmin.reduce(pair[0], axis=1), np.fmax.reduce(pair[1], axis=1)
