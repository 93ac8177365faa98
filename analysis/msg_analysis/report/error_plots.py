# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Interactive plots of errors and covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from bokeh.models import (
    BasicTicker,
    BoxAnnotation,
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    Legend,
    LegendItem,
    LinearColorMapper,
    Range1d,
    Span,
    UIElement,
    Whisker,
)
from bokeh.palettes import interp_palette

from msg_analysis.common.arrays import BLOCK_NUMBERS, FloatArray, release
from msg_analysis.common.text import HALF_WIDTH_95, agent_name
from msg_analysis.report.comparison_text import TIMES
from msg_analysis.report.look import column_of
from msg_analysis.report.plot_style import (
    BLACK,
    BLUE,
    DARK_HEAT,
    GREY,
    HEAT,
    INK,
    NOBODY,
    PAGE,
    SANS,
    SKY,
    VERMILLION,
    Candidates,
    agent_figure,
    name_agents,
    new_figure,
    place_legend,
    plain_legend,
    show_values,
)

MOST_DECADES = 12, 300  # of evidence that are shown, below and above 1
MOST_LINES = 8  # agents whose convergence is drawn at once
_POINTS = 200  # at most, on the line of an agent


def convergence(running: Mapping[str, FloatArray], predicted: float | None) -> UIElement:
    """The running system error, of ``Comparison.running`` with (points,) each, next to the predicted one."""
    time, mean, error = running["time"], running["system_error"], running["standard_error"]
    centre = predicted if predicted is not None else mean[-1]
    low, high = centre - HALF_WIDTH_95 * error, centre + HALF_WIDTH_95 * error
    plot = new_figure(270, x_axis_label="simulated time", y_axis_label="system error", x_range=(0.0, float(time[-1])))
    data = {"time": time, "mean": mean, "low": low, "high": high, "z": (mean - centre) / np.where(error > 0, error, 1)}
    source = ColumnDataSource(data)
    rows = [("time", "@time{0.[00]}"), ("measured up to this time", "@mean{0.0000}")]
    if error.any():
        plot.varea("time", "low", "high", source=source, color=SKY, alpha=0.3, legend_label="95 % band")
    if predicted is not None:
        plot.line(time, np.full(len(time), predicted), color=BLACK, line_dash="dashed", legend_label="predicted")
        rows.append(("predicted", f"{predicted:.4g}"))
    if error.any():
        rows += [("95 % band", "@low{0.0000} … @high{0.0000}"), ("z", "@z{+0.00}")]
    line = plot.line("time", "mean", source=source, color=BLUE, line_width=2, legend_label="measured up to this time")
    show_values(plot, [line], rows, mode="vline", line_policy="nearest")
    # The earliest values are mostly noise, and would flatten the rest.
    late = time >= time[-1] / 50
    bottom, top = min(mean[late].min(), low[late].min()), max(mean[late].max(), high[late].max())
    margin = 0.08 * (top - bottom) or 1.0
    plot.y_range = Range1d(max(bottom - margin, 0.0), top + margin)  # an error is never negative
    place_legend(plot)
    return plot


def evidence(time: FloatArray, logarithms: FloatArray, threshold: float, crossed: float | None) -> UIElement:
    """The evidence against the prediction after some steps, (points,) each, its threshold, and when it was exceeded."""
    shown = np.clip(logarithms, -MOST_DECADES[0] * np.log(10.0), MOST_DECADES[1] * np.log(10.0))
    x_range = (0.0, float(time[-1]))
    plot = new_figure(230, x_axis_label="simulated time", y_axis_label="evidence", x_range=x_range, y_axis_type="log")
    source = ColumnDataSource({"time": time, "evidence": np.exp(shown)})
    line = plot.line("time", "evidence", source=source, color=BLUE, line_width=2)
    plot.add_layout(Span(location=threshold, dimension="width", line_color=VERMILLION, line_dash="dashed"))
    if crossed is not None:
        plot.add_layout(Span(location=crossed, dimension="height", line_color=VERMILLION, line_dash="dotted"))
    rows = [("time", "@time{0.[00]}"), ("evidence", "@evidence{0.000 a}")]
    show_values(plot, [line], rows, mode="vline", line_policy="nearest")
    low, high = float(shown.min()), max(float(shown.max()), float(np.log(threshold)))
    plot.y_range = Range1d(float(np.exp(low - 0.7)), float(np.exp(high + 0.7)))
    return plot


def node_errors(
    nodes: Sequence[Mapping[str, Any]], level: float, candidates: Candidates, names: Sequence[str] | None
) -> UIElement:
    """Node errors with 95 % intervals next to the predicted ones; marked if p < ``level``; agents can be chosen."""
    agents = np.arange(1, len(nodes) + 1)
    measured, predicted, error = (column_of(nodes, key) for key in ("measured", "predicted", "standard_error"))
    apart = np.nan_to_num(column_of(nodes, "p_adjusted"), nan=1.0) < level
    half = HALF_WIDTH_95 * error
    data = {
        "agent": agents,
        "name": [agent_name(agent, names) for agent in agents.tolist()],
        "measured": measured,
        "predicted": predicted,
        "left": agents - 0.32,
        "right": agents + 0.32,
        "low": measured - half,
        "high": measured + half,
        "z": column_of(nodes, "z"),
        "p": column_of(nodes, "p_adjusted"),
        "colour": np.where(apart, VERMILLION, BLUE),
        "marker": np.where(apart, "square", "circle"),
    }
    source = ColumnDataSource(data, name="nodes")
    tools = "box_zoom,tap,box_select,pan,wheel_zoom,reset,save"
    plot = agent_figure(270, len(nodes), names, candidates.involved, tools, y_axis_label="mean-square error")
    rows = [("agent", "@name"), ("measured", "@measured{0.0000}")]
    size = float(np.clip(220 / len(nodes), 5, 11))
    if not np.isnan(predicted).all():
        plot.segment(
            "left", "predicted", "right", "predicted", source=source, color=BLACK, line_width=2,
            legend_label="predicted", nonselection_alpha=0.4,
        )  # fmt: skip
        rows.append(("predicted", "@predicted{0.0000}"))
    if not np.isnan(error).all():
        whisker = Whisker(source=source, base="agent", lower="low", upper="high", line_color="colour", level="glyph")
        whisker.upper_head.size = whisker.lower_head.size = size * 0.7
        whisker.upper_head.line_color = whisker.lower_head.line_color = GREY
        plot.add_layout(whisker)
        rows += [("95 % interval", "@low{0.0000} … @high{0.0000}"), ("z", "@z{+0.00}"), ("p, adjusted", "@p{0.0000}")]
    points = plot.scatter(
        "agent", "measured", source=source, marker="marker", size=size, color="colour", nonselection_alpha=0.25
    )
    show_values(plot, [points], rows)
    ends = np.concatenate([measured, predicted, data["low"], data["high"]])
    if not np.isnan(ends).all():
        margin = 0.08 * float(np.nanmax(ends) - np.nanmin(ends)) or 1.0
        plot.y_range = Range1d(max(float(np.nanmin(ends)) - margin, 0.0), float(np.nanmax(ends)) + margin)
    legend = plot.legend[0] if plot.legend else Legend()
    name = "measured" if np.isnan(error).all() else "measured, 95 % interval"
    for chosen, label in ((~apart, name), (apart, "measured, rejected")):
        there = np.flatnonzero(chosen & ~np.isnan(measured))
        if len(there):  # takes shape and colour of one such point
            legend.items.append(LegendItem(label=label, renderers=[points], index=int(there[0])))
    if not plot.legend:
        plot.add_layout(legend)
    place_legend(plot)
    return plot


def agent_convergence(
    states: FloatArray,  # (steps, m, replicas), without gaps
    reference: float | None,  # None: the mean of the agents
    dt: float,  # [units of simulated time]
    nodes: Sequence[Mapping[str, Any]],
) -> UIElement | None:
    """Measured node errors of the chosen agents over time, relative to the predicted ones; None: there are none."""
    predicted, error = column_of(nodes, "predicted"), column_of(nodes, "standard_error")
    if len(states) < 2 or not (np.nan_to_num(predicted) > 0).any():
        return None
    ends = np.unique(np.rint(np.geomspace(1, len(states), _POINTS)).astype(np.int64))
    sums, total, done = np.empty((len(ends), states.shape[1])), np.zeros(states.shape[1]), 0
    length = max(1, BLOCK_NUMBERS // max(1, states[0].size))
    for place, end in enumerate(ends.tolist()):
        while done < end:  # in pieces: a run may be long
            piece = states[done : min(done + length, end)]
            middle = piece.mean(axis=1, keepdims=True) if reference is None else reference
            total = total + np.square(piece - middle).mean(axis=2).sum(axis=0)
            done += len(piece)
            release(states)
        sums[place] = total
    scale = np.where(np.nan_to_num(predicted) > 0, predicted, np.nan)
    parts = (sums / ends[:, None] / scale).T
    everything = ColumnDataSource({"part": parts.ravel().astype(np.float32)}, name="all_agents")
    times = ColumnDataSource({"time": (ends * dt).astype(np.float32)}, name="all_times")
    widths = ColumnDataSource({"width": HALF_WIDTH_95 * error / scale}, name="all_widths")
    lines = ColumnDataSource({key: [] for key in ("xs", "ys", "agent", "colour", "dash", "width")}, name="lines")
    bands = ColumnDataSource({key: [] for key in ("xs", "ys", "colour")}, name="bands")
    plot = new_figure(270, x_axis_label="simulated time", y_axis_label="measured / predicted")
    plot.x_range = Range1d(0.0, float(len(states) * dt))
    settled = parts[:, ends >= len(states) / 20]
    reach = min(1.2 * float(np.nanmax(np.abs(settled - 1))), 1.0)
    plot.y_range = Range1d(1 - reach, 1 + reach)
    plot.add_layout(Span(location=1.0, dimension="width", line_color=BLACK, line_width=1.2, line_dash="dashed"))
    plot.patches("xs", "ys", source=bands, color="colour", alpha=0.1, line_alpha=0)
    drawn = plot.multi_line("xs", "ys", source=lines, color="colour", line_dash="dash", line_width="width")
    plot.add_layout(
        Legend(items=[LegendItem(label={"field": "agent"}, renderers=[drawn])], orientation="horizontal"), "above"
    )
    plain_legend(plot.legend[0])
    rows = [("", "@agent"), ("time", "$data_x{0.[00]}"), ("measured / predicted", "$data_y{0.000}")]
    show_values(plot, [drawn], rows, line_policy="nearest")
    # Sources that no glyph uses reach the page as tags.
    plot.tags = [everything, times, widths]
    return plot


def innovation_sizes(
    ratios: FloatArray,  # (m,); NaN for an agent without noise
    samples: int,  # innovations per agent
    candidates: Candidates,
    names: Sequence[str] | None,
) -> UIElement:
    """Variance of each agent's one-step residuals relative to the predicted one, and where 95 % of such ratios lie."""
    agents = np.arange(1, len(ratios) + 1)
    half = HALF_WIDTH_95 * np.sqrt(2.0 / max(samples, 1))
    inside = np.abs(ratios - 1.0) <= half
    data = {
        "agent": agents,
        "name": [agent_name(agent, names) for agent in agents.tolist()],
        "ratio": ratios,
        "colour": np.where(inside, BLUE, VERMILLION),
        "marker": np.where(inside, "circle", "square"),
    }
    plot = agent_figure(200, len(ratios), names, candidates.agents, y_axis_label="variance / predicted")
    ends = np.array([0.3, len(ratios) + 0.7])
    plot.varea(ends, np.full(2, 1 - half), np.full(2, 1 + half), color=SKY, alpha=0.3, legend_label="95 % band")
    plot.line(ends, np.ones(2), color=BLACK, line_dash="dashed", legend_label="predicted")
    points = plot.scatter(
        "agent", "ratio", source=data, marker="marker", size=float(np.clip(220 / len(ratios), 5, 10)), color="colour"
    )
    show_values(plot, [points], [("agent", "@name"), ("variance / predicted", "@ratio{0.0000}")])
    reach = 1.25 * max(float(np.nanmax(np.abs(ratios - 1.0), initial=0.0)), half)
    plot.y_range = Range1d(max(1 - reach, 0.0), 1 + reach)
    place_legend(plot)
    return plot


def histogram(timing: Mapping[str, Any], key: Literal["lateness_ms", "staleness_ms"]) -> UIElement:
    """How late the steps of a run in real time were, or how old the neighbours' values that they used."""
    found, period, steps = timing["histogram"], timing["period_ms"], key == "lateness_ms"
    left, right = np.array(found[key][:-1]), np.array(found[key][1:])
    count, what = (np.array(found["steps"]), "steps") if steps else (np.array(found["uses"]), "values used")
    beyond = (left >= period) & steps
    plot = new_figure(250, x_axis_label=TIMES[key], y_axis_label=what, min_border_right=12)
    # log10(count + 1): an empty bar has height 0.
    data = {
        "left": left,
        "right": right,
        "count": count,
        "height": np.log10(count + 1.0),
        "colour": np.where(beyond, VERMILLION, BLUE),
    }
    bars = plot.quad("left", "right", "height", 0, source=data, color="colour", line_color=PAGE, line_width=0.5)
    show_values(plot, [bars], [("ms", "@left{0.00} to @right{0.00}"), (what, "@count")])
    most = max(int(count.max(initial=0)), 1)
    ticks = [0, *(10**power for power in range(len(str(most))))]
    plot.yaxis.ticker = FixedTicker(ticks=[float(np.log10(tick + 1.0)) for tick in ticks])
    plot.yaxis.major_label_overrides = {float(np.log10(tick + 1.0)): f"{tick}" for tick in ticks}
    plot.y_range.start = 0.0
    far = right[-1] > period / 2
    plot.x_range = Range1d(left[0] - period / 100, 1.02 * max(right[-1], period if far else period / 20))
    plot.xgrid.grid_line_color = None
    if far:
        name = "deadline" if steps else "one period"
        top = float(np.log10(most + 1.0))
        plot.line([period] * 2, [0.0, top], color=BLACK, line_width=1.5, line_dash="dashed", legend_label=name)
        place_legend(plot)
    return plot


_NUMBERED = 5  # most agents with which heat maps show numbers
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
    candidates: Candidates = NOBODY,
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
            key, matrix, mappers["z" if key == "z" else "moments"], source, rows, (across, down), candidates, names
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
    candidates: Candidates,
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
    show_values(panel, [image], rows)
    if agents <= _NUMBERED:
        _write_numbers(panel, matrix, mapper.high, 1 if key == "z" else None)
    _mark(panel, agents, candidates)
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


def _mark(panel: Any, agents: int, candidates: Candidates) -> None:
    """Frames around rows and columns of the agents, and entries of the links, that the verdict names."""
    frames = [(agent, agent, 1, agents) for agent in candidates.agents]
    frames += [(1, agents, agent, agent) for agent in candidates.agents]
    for first, second in candidates.entries:
        frames += [(first, first, second, second), (second, second, first, first)]
    for top, bottom, left, right in frames:
        frame = BoxAnnotation(top=bottom + 0.5, bottom=top - 0.5, left=left - 0.5, right=right + 0.5, name="candidates")
        frame.fill_color, frame.line_color, frame.line_width, frame.line_alpha = None, VERMILLION, 2.5, 1.0
        panel.add_layout(frame)
