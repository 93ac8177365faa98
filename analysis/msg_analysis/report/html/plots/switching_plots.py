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

"""Figure of the report about the graphs: for what share of the time each was active."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    PlainText,
    Range1d,
    UIElement,
)

from msg_analysis.report.figures.palette import shorten
from msg_analysis.report.html.plots.colours import BLACK, graph_colour
from msg_analysis.report.html.plots.plot_style import new_figure
from msg_analysis.types import FloatArray, IntArray


def occupancy(modes: IntArray, names: Sequence[str], stationary: FloatArray) -> UIElement:
    """Share of the time of every graph next to the stationary law (n,)."""
    present = modes[modes >= 0]
    share = np.bincount(present, minlength=len(names)) / max(len(present), 1)
    places = np.arange(len(names))
    shares = new_figure(
        _height(names),
        "save",
        title="share of time",
        y_range=Range1d(len(names) - 0.4, -0.6),
        toolbar_location=None,
        x_axis_label="bar: measured; mark: predicted",
    )
    most = 1.12 * max(share.max(), stationary.max())
    shares.x_range = Range1d(0.0, float(most))
    table = {
        "mode": places,
        "share": share,
        "predicted": stationary,
        "name": list(names),
        "colour": [graph_colour(g) for g in range(len(names))],
        "low": places - 0.45,
        "high": places + 0.45,
    }
    source = ColumnDataSource(table)
    drawn = shares.hbar(
        "mode", left=0, right="share", height=0.72, fill_color="colour", line_alpha=0, alpha=0.85, source=source
    )
    shares.segment("predicted", "low", "predicted", "high", source=source, color=BLACK, line_width=2.5)
    shares.add_tools(
        HoverTool(
            renderers=[drawn],
            tooltips=[("graph", "@name"), ("measured", "@share{0.0 %}"), ("predicted", "@predicted{0.0 %}")],
        )
    )
    _name_graphs(shares, names)
    # As plain text: for mathematics, the page would load a library from the network.
    shares.yaxis.major_label_overrides = {g: PlainText(text=shorten(name)) for g, name in enumerate(names)}
    return shares


def _height(names: Sequence[str]) -> int:
    return int(min(110 + 30 * len(names), 520))


def _name_graphs(plot: Any, names: Sequence[str]) -> None:
    plot.ygrid.grid_line_color = None
    plot.yaxis.ticker = FixedTicker(ticks=list(range(len(names))))
