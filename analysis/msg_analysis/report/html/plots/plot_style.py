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

"""Style of the report's Bokeh figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from bokeh.models import BasicTicker, BoxAnnotation, PlainText
from bokeh.plotting import figure

from msg_analysis.report.figures.palette import shorten
from msg_analysis.report.html.plots.colours import GREY, INK, PALE, VERMILLION

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


def agent_ticker() -> BasicTicker:
    """Whole numbers; fewer on narrow screens, by the page's script."""
    return BasicTicker(desired_num_ticks=20, min_interval=1, num_minor_ticks=0, tags=["agents"])


def mark_agents(plot: Any, agents: Iterable[int]) -> None:
    """Shade the agents, along the horizontal axis, that the verdict names."""
    for agent in agents:
        mark = BoxAnnotation(left=agent - 0.5, right=agent + 0.5, level="underlay", name=f"accused {agent}")
        mark.fill_color, mark.fill_alpha, mark.line_color = VERMILLION, 0.18, None
        plot.add_layout(mark)


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
