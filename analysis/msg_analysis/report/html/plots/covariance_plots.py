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

"""Heat maps of the covariance: measured, predicted, and the difference in standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTicker,
    BoxAnnotation,
    ColorBar,
    ColumnDataSource,
    HoverTool,
    LinearColorMapper,
    Range1d,
    UIElement,
)
from bokeh.palettes import interp_palette

from msg_analysis.report.html.plots.accused import NOBODY, Accused
from msg_analysis.report.html.plots.colours import BLACK, DARK_HEAT, HEAT, INK, PAGE, VERMILLION
from msg_analysis.report.html.plots.plot_style import SANS, name_agents, new_figure
from msg_analysis.types import FloatArray

_NUMBERED = 8  # most agents with which heat maps show numbers
_NORMAL = 3.0  # standard errors that the scale of the difference has at least
TITLES = {
    "measured": "measured",
    "predicted": "predicted",
    "difference": "measured − predicted",
    "z": "difference in standard errors",
}


def covariances(
    measured: FloatArray | None,
    predicted: FloatArray | None,
    z: FloatArray | None,
    accused: Accused = NOBODY,
    names: Sequence[str] | None = None,
) -> dict[str, UIElement]:
    """Heat maps of the matrices (m, m) that exist, by name; ``z``: measured - predicted in standard errors."""
    known = {key: value for key, value in (("measured", measured), ("predicted", predicted)) if value is not None}
    if z is not None:
        known["z"] = z
    elif measured is not None and predicted is not None:
        known["difference"] = measured - predicted
    if not known:
        return {}
    agents = len(next(iter(known.values())))
    limit = max(float(np.abs(matrix).max()) for key, matrix in known.items() if key != "z") or 1.0
    mappers = {"moments": _mapper(limit)}
    if z is not None:
        mappers["z"] = _mapper(max(float(np.nanmax(np.abs(z), initial=0.0)), _NORMAL))
    source = ColumnDataSource({key: [matrix] for key, matrix in known.items()})
    rows = [("agents", "$y{0}, $x{0}"), *((TITLES[key], f"@{key}{{0.0000}}") for key in known)]
    across, down = Range1d(0.5, agents + 0.5), Range1d(agents + 0.5, 0.5)
    return {
        f"covariance_{key}": _panel(
            key, matrix, mappers["z" if key == "z" else "moments"], source, rows, (across, down), accused, names
        )
        for key, matrix in known.items()
    }


def _mapper(limit: float) -> LinearColorMapper:
    light, dark = interp_palette(HEAT, 255), interp_palette(DARK_HEAT, 255)
    return LinearColorMapper(palette=light, low=-limit, high=limit, tags=[dark])


def _panel(
    key: str,
    matrix: FloatArray,
    mapper: LinearColorMapper,
    source: ColumnDataSource,
    rows: list[tuple[str, str]],
    ranges: tuple[Range1d, Range1d],
    accused: Accused,
    names: Sequence[str] | None,
) -> UIElement:
    agents = len(matrix)
    panel = new_figure(
        270, "box_zoom,wheel_zoom,pan,reset,save", title=TITLES[key], x_range=ranges[0], y_range=ranges[1],
        toolbar_location=None,
    )  # fmt: skip
    panel.grid.grid_line_color = None
    panel.axis.ticker = BasicTicker(desired_num_ticks=8, min_interval=1, num_minor_ticks=0)
    panel.xaxis.axis_label = "agent"
    name_agents(panel.axis, names)
    image = panel.image(key, x=0.5, y=0.5, dw=agents, dh=agents, color_mapper=mapper, source=source)
    panel.add_tools(HoverTool(renderers=[image], tooltips=rows))
    if agents <= _NUMBERED:
        _write_numbers(panel, matrix, mapper.high, 1 if key == "z" else None)
    _mark(panel, agents, accused)
    bar = ColorBar(color_mapper=mapper, width=8, label_standoff=5, border_line_color=None, padding=3)
    bar.major_label_text_font, bar.major_label_text_color, bar.background_fill_color = SANS, INK, None
    panel.add_layout(bar, "right")
    return panel


def _write_numbers(panel: Any, matrix: FloatArray, limit: float, decimals: int | None) -> None:
    digits = max(0, 2 - int(np.floor(np.log10(limit)))) if decimals is None else decimals
    i, j = np.indices(matrix.shape)
    panel.text(
        x=(j + 1).ravel(),
        y=(i + 1).ravel(),
        text=["–" if np.isnan(value) else f"{value:.{digits}f}".replace("-", "−") for value in matrix.ravel()],
        text_color=np.where(np.abs(matrix.ravel()) > 0.6 * limit, PAGE, BLACK).tolist(),
        text_align="center",
        text_baseline="middle",
        text_font={"value": SANS},
        text_font_size=f"{int(np.clip(60 / len(matrix), 7, 11))}px",
    )


def _mark(panel: Any, agents: int, accused: Accused) -> None:
    """Frames around rows and columns of the agents, and entries of the links, that the verdict names."""
    frames = [(agent, agent, 1, agents) for agent in accused.agents] + [
        (1, agents, agent, agent) for agent in accused.agents
    ]
    for first, second in accused.entries:
        frames += [(first, first, second, second), (second, second, first, first)]
    for top, bottom, left, right in frames:
        frame = BoxAnnotation(top=bottom + 0.5, bottom=top - 0.5, left=left - 0.5, right=right + 0.5, name="accused")
        frame.fill_color, frame.line_color, frame.line_width, frame.line_alpha = None, VERMILLION, 2.5, 1.0
        panel.add_layout(frame)
