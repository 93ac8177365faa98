# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Plots of a sweep: interactive lines and heat maps over its keys for the page, and a figure for the files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    LinearColorMapper,
    LogColorMapper,
    PlainText,
    Range1d,
    UIElement,
    Whisker,
)
from bokeh.palettes import interp_palette
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import write_whole
from msg_analysis.common.text import measured_text, number_text
from msg_analysis.experiment.problems import show
from msg_analysis.report.figures import STYLE, NotebookFigure, legend_beside, plain, rendered
from msg_analysis.report.look import DARK_GREY, MODE_COLOURS, shifted, shorten
from msg_analysis.report.plot_style import BLACK, DARK_SCALE, GREY, INK, LINES, SANS, SCALE, new_figure, show_values
from msg_analysis.sweeps.results import Picture, PlotPoint, Series, axis_name, column_words, key_words, value_text
from msg_analysis.theory.prediction import LAW_NAMES

MOST_LINES = 8  # series of one figure; of more values, some
MOST_PANELS = 12  # figures side by side; of more combinations, the first
MARKERS = {
    "circle": "M2 6a4 4 0 1 0 8 0a4 4 0 1 0-8 0Z",
    "square": "M2 2H10V10H2Z",
    "triangle": "M6 1.5L10.5 10H1.5Z",
    "inverted_triangle": "M6 10.5L10.5 2H1.5Z",
    "diamond": "M6 .5L10 6L6 11.5L2 6Z",
    "hex": "M3.5 2H8.5L11 6L8.5 10H3.5L1 6Z",
    "plus": "M4.5 1H7.5V4.5H11V7.5H7.5V11H4.5V7.5H1V4.5H4.5Z",
    "square_pin": "M1 1Q6 4 11 1Q8 6 11 11Q6 8 1 11Q4 6 1 1Z",
}
"""Of the series of a figure, with their outlines in a square of 12 by 12."""
_WIDE = 10.0  # ratio of results from which on the colours of heat maps are on a logarithmic scale
_NUMBERED = 8  # most columns of a heat map with numbers
_TICKS = 10  # most values written along an axis; fewer on narrow screens, by the page's script


@dataclass(frozen=True, slots=True)
class Panel:
    """The series that have the same values of all keys but two."""

    title: str  # these values, in words; empty where there are none
    series: tuple[Series, ...]  # one for each value of the second key; one alone without a second key


def key_of_lines(picture: Picture) -> tuple[str, list[str]] | None:
    """The key whose values the lines of a figure have, in words, and these values; None with one line."""
    chosen = _some(panels(picture)[0].series)
    if not chosen[0].values:
        return None
    return key_words(chosen[0].values[0][0], picture.names), [value_text(series.values[0][1]) for series in chosen]


def panels(picture: Picture) -> list[Panel]:
    """Series by the values of the third key and those after it."""
    found: dict[tuple[str, ...], list[Series]] = {}
    for series in picture.series:
        found.setdefault(tuple(show(value) for _, value in series.values[1:]), []).append(series)
    return [Panel(picture.words(group[0].values[1:]), tuple(group)) for group in found.values()]


def lines(picture: Picture, panel: Panel, name: str) -> UIElement:
    """Lines over the key along the axis; measured values with intervals, beside each other; ``name`` for the page."""
    chosen = _some(panel.series)
    labels, logarithmic = picture.labels, picture.numeric and picture.logarithmic
    along = [_along(picture, series, labels) for series in chosen]
    every = np.concatenate(along)
    drawn = [shifted(x, every, i, len(chosen), logarithmic=logarithmic) for i, x in enumerate(along)]
    plot = new_figure(330, x_axis_type="log" if logarithmic else "linear", x_range=_reach(every, drawn, logarithmic))
    _name_axes(plot, axis_name(picture.x, picture.names), column_words(picture.y, picture.names))
    if not picture.numeric:
        _name_values(plot.xaxis, [shorten(label, 12) for label in labels])
        plot.xgrid.grid_line_color = None
    points: dict[str, list[Any]] = {key: [] for key in ("x", "value", "words")}
    hovered = []
    low, high = _span(picture)
    for number, (series, true, beside) in enumerate(zip(chosen, along, drawn, strict=True)):
        order = np.argsort(true, kind="stable")
        places = [series.places[i] for i in order]
        words = [_place_words(picture, series, place) for place in places]
        data: dict[str, Any] = {
            "second": [value_text(series.values[0][1]) if series.values else ""] * len(places),
            "x": true[order],
            "beside": beside[order],
            "words": words,
            **{key: _column(places, key) for key in ("value", "low", "high", "predicted", "reference")},
            "known": [value_text(place.x) for place in places],
            "shown": [_value_words(place) for place in places],
            "expected": [number_text(place.predicted if picture.measured else place.reference) for place in places],
        }
        hovered.append(_series(plot, picture, ColumnDataSource(data), number))
        there = ~np.isnan(data["value"])
        if not there.all():
            lost = {"x": data["x"][~there], "y": np.full((~there).sum(), low)}
            lost["words"] = [words[i] for i in np.flatnonzero(~there)]
            crosses = plot.scatter("x", "y", source=lost, marker="x", size=9, color=BLACK, line_width=2)
            show_values(plot, [crosses], [("", "@words")])
        points["x"] += data["beside"].tolist()
        points["value"] += [value if known else low for value, known in zip(data["value"].tolist(), there, strict=True)]
        points["words"] += words
    rows = [(key_words(picture.x, picture.names), "@known"), (_result_words(picture), "@shown")]
    if picture.measured:
        rows.append(("predicted", "@expected"))
    elif any(place.reference is not None for series in chosen for place in series.places):
        rows.append((LAW_NAMES["continuous"], "@expected"))
    if chosen[0].values:
        rows.insert(0, (key_words(chosen[0].values[0][0], picture.names), "@second"))
    show_values(plot, hovered, rows)
    plot.y_range = Range1d(low, high)
    _add_focus(plot, points, name)
    return plot


def _series(plot: Any, picture: Picture, source: ColumnDataSource, number: int) -> Any:
    """Draw one series; the points that show values under the pointer."""
    colour, marker = LINES[number], list(MARKERS)[number]
    place = "beside" if picture.measured else "x"
    if picture.intervals:
        whisker = Whisker(source=source, base=place, lower="low", upper="high", line_color=colour, level="glyph")
        whisker.line_width = 1.5
        whisker.upper_head.size = whisker.lower_head.size = 5
        whisker.upper_head.line_color = whisker.lower_head.line_color = colour
        plot.add_layout(whisker)
    if picture.measured:
        plot.line("x", "predicted", source=source, color=colour, line_width=1.5)
    else:
        plot.line("x", "value", source=source, color=colour, line_width=1.8)
        plot.line("x", "reference", source=source, color=colour, line_dash="dashed")
    return plot.scatter(place, "value", source=source, marker=marker, size=7, color=colour)


def dashed(picture: Picture) -> bool:
    """Whether a figure has a dashed line: of a reference at two places of a line that is drawn, or more."""
    drawn = [series for panel in panels(picture)[:MOST_PANELS] for series in _some(panel.series)]
    return not picture.measured and any(
        sum(place.reference is not None for place in series.places) > 1 for series in drawn
    )


def by_factors(picture: Picture) -> bool:
    """Whether the colours of its heat maps are on a logarithmic scale: results > 0 that differ much."""
    known = [place.value for place in picture.places if place.value is not None]
    return bool(known) and min(known) > 0 and max(known) / min(known) >= _WIDE


def heat_map(picture: Picture, panel: Panel, name: str) -> UIElement:
    """Values over two keys; cells without a result have a cross; ``name`` for the page."""
    second = panel.series[0].values[0][0]
    columns = picture.labels
    across = {show(place.x): _short(place.x) for place in picture.places}
    down = [value_text(series.values[0][1]) for series in panel.series]
    known = [place.value for place in picture.places if place.value is not None]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    mapper = (LogColorMapper if by_factors(picture) else LinearColorMapper)(
        palette=interp_palette(SCALE, 255), low=low, high=high if high > low else low + 1.0,
        nan_color="rgba(0, 0, 0, 0)", tags=[interp_palette(DARK_SCALE, 255)],
    )  # fmt: skip
    found = [
        {
            "x": columns.index(show(place.x)),
            "y": row,
            "value": math.nan if place.value is None else place.value,
            "words": _place_words(picture, series, place),
            "text": "×" if place.value is None else f"{place.value:.3g}",
            "along": value_text(place.x),
            "second": down[row],
            "shown": _value_words(place),
            "expected": number_text(place.predicted if picture.measured else place.reference),
        }
        for row, series in enumerate(panel.series)
        for place in series.places
    ]
    cells: dict[str, list[Any]] = {key: [cell[key] for cell in found] for key in found[0]}
    if len(columns) > _NUMBERED:  # no room for numbers
        cells["text"] = ["×" if text == "×" else "" for text in cells["text"]]
    plot = new_figure(
        100 + int(np.clip(34 * len(down), 200, 420)), "box_zoom,pan,wheel_zoom,reset,save",
        x_range=Range1d(-0.5, len(columns) - 0.5), y_range=Range1d(-0.5, len(down) - 0.5),
    )  # fmt: skip
    plot.grid.grid_line_color = None
    _name_axes(plot, axis_name(picture.x, picture.names), axis_name(second, picture.names).replace(" [", "\n["))
    _name_values(plot.xaxis, [across[column] for column in columns])
    _name_values(plot.yaxis, [_short(series.values[0][1]) for series in panel.series])
    source, fill = ColumnDataSource(cells), {"field": "value", "transform": mapper}
    drawn = plot.rect("x", "y", 1, 1, source=source, fill_color=fill, line_color=GREY, line_width=0.5)
    if any(cells["text"]):
        plot.text(
            "x", "y", "text", source=source, text_color=BLACK, text_align="center", text_baseline="middle",
            text_font={"value": SANS}, text_font_size="11px",
        )  # fmt: skip
    rows = [(key_words(picture.x, picture.names), "@along"), (key_words(second, picture.names), "@second")]
    rows.append((_result_words(picture), "@shown"))
    if picture.measured:
        rows.append(("predicted", "@expected"))
    show_values(plot, [drawn], rows)
    bar = ColorBar(color_mapper=mapper, height=8, label_standoff=5, border_line_color=None, padding=3)
    bar.major_label_text_font, bar.major_label_text_color, bar.background_fill_color = SANS, INK, None
    plot.add_layout(bar, "above")
    _add_focus(plot, {key: cells[key] for key in ("x", "value", "words")} | {"value": cells["y"]}, name)
    return plot


def _some(series: Sequence[Series]) -> list[Series]:
    """At most MOST_LINES of them, the first and the last included."""
    places = np.unique(np.linspace(0, len(series) - 1, min(len(series), MOST_LINES)).round().astype(int))
    return [series[place] for place in places]


def _along(picture: Picture, series: Series, labels: Sequence[str]) -> FloatArray:
    """Places of a series along the axis: numbers, or the numbers of the values, from 0."""
    found = [float(place.x) if picture.numeric else labels.index(show(place.x)) for place in series.places]
    return np.array(found, dtype=float)


def _reach(every: FloatArray, drawn: Sequence[FloatArray], logarithmic: bool) -> Range1d:
    """All places and a margin."""
    every = np.concatenate([every, *drawn])
    ends = np.array([every.min(), every.max()])
    if logarithmic:
        ends = np.log(ends)
    margin = 0.04 * float(ends[1] - ends[0]) or 0.5
    ends = ends + np.array([-margin, margin])
    return Range1d(*(np.exp(ends) if logarithmic else ends).tolist())


def _span(picture: Picture) -> tuple[float, float]:
    """Ends of the vertical axis: all panels have the same."""
    every = ((place.value, place.low, place.high, place.predicted, place.reference) for place in picture.places)
    numbers = [number for group in every for number in group if number is not None]
    low, high = (min(numbers), max(numbers)) if numbers else (0.0, 1.0)
    margin = 0.08 * (high - low) or 0.5
    return low - margin, high + margin


def _name_axes(plot: Any, across: str, up: str) -> None:
    plot.xaxis.axis_label, plot.yaxis.axis_label = PlainText(text=across), PlainText(text=up)


def _name_values(axis: Any, labels: Sequence[str]) -> None:
    """Write values at 0, 1, …: all, or some of many."""
    ticks = list(range(0, len(labels), math.ceil(len(labels) / _TICKS)))
    axis.ticker = FixedTicker(ticks=ticks, tags=["values", ticks])
    axis.major_label_overrides = {tick: PlainText(text=labels[tick]) for tick in ticks}


def _short(value: Any) -> str:
    """A value beside an axis."""
    return f"{value:.3g}" if isinstance(value, float) else shorten(show(value), 12)


def _add_focus(plot: Any, points: dict[str, list[Any]], name: str) -> None:
    """Points that the arrow keys visit, and a ring around the present one; both are found by name."""
    plot.tags = [ColumnDataSource(points, name=f"{name} points")]
    ring = ColumnDataSource({"x": [], "value": []}, name=f"{name} ring")
    plot.scatter("x", "value", source=ring, size=18, fill_color=None, line_color=BLACK, line_width=2.5)


def _column(places: Sequence[PlotPoint], key: str) -> FloatArray:
    return np.array([getattr(place, key) for place in places], dtype=float)  # None: nan


def _result_words(picture: Picture) -> str:
    return "measured" if picture.measured else column_words(picture.y, picture.names)


def _value_words(place: PlotPoint) -> str:
    """A result with its interval, or why there is none."""
    if place.value is None:
        return f"no result: {place.reason or 'not done'}"
    return measured_text(place.value, (place.low, place.high))


def _place_words(picture: Picture, series: Series, place: PlotPoint) -> str:
    """All of a point in one line."""
    text = f"{picture.words([(picture.x, place.x), *series.values])}: {_value_words(place)}"
    if picture.measured and place.predicted is not None:
        text += f", predicted {number_text(place.predicted)}"
    if place.reference is not None:
        text += f", {LAW_NAMES['continuous']} {number_text(place.reference)}"
    return text


FORMATS = ("svg", "png")
_DPI = 150
_SIZE = (7.2, 4.2)  # inches
_SHAPES = "os^Dv<>p"
_IN_LEGEND = 8
"""Most series in the legend; of more, it has some, and colours go from dark to light."""


def write_figure(picture: Picture, title: str, directory: Path) -> list[Path]:
    """Write ``figure.svg`` and ``figure.png``, each whole or not at all."""
    with mpl.rc_context(STYLE):
        figure = draw(picture, title)
        return [write_whole(directory / f"figure.{name}", rendered(figure, name, _DPI)) for name in FORMATS]


def draw(picture: Picture, title: str) -> NotebookFigure:
    """The figure; the caller sets the style."""
    figure = NotebookFigure(figsize=_SIZE, layout="constrained")
    axes = figure.subplots()
    labels, count, numbers = picture.labels, len(picture.series), picture.numeric
    colours = list(MODE_COLOURS[:count])
    if count > _IN_LEGEND:
        colours = list(mpl.colormaps["viridis"](np.linspace(0, 0.92, count)))
    along = [_along(picture, series, labels) for series in picture.series]
    every, logarithmic = np.concatenate(along), numbers and picture.logarithmic
    for number, (series, x, colour) in enumerate(zip(picture.series, along, colours, strict=True)):
        beside = shifted(x, every, number, count, logarithmic=logarithmic)
        _draw_series(axes, picture, series, x, beside, colour, _SHAPES[number % len(_SHAPES)])
    if not numbers:
        axes.set_xticks(range(len(labels)), [plain(label) for label in labels])
        axes.set_xlim(-0.5, len(labels) - 0.5)
    elif picture.logarithmic:
        axes.set_xscale("log")
    if lost := [place.x for place in picture.places if place.value is None]:  # a cross at the foot of the axes
        at = [float(place) if numbers else labels.index(show(place)) for place in lost]
        foot = axes.get_xaxis_transform()
        axes.plot(at, [0.015] * len(at), "x", color=BLACK, ms=5, transform=foot, clip_on=False, zorder=5)
    axes.set(xlabel=plain(axis_name(picture.x, picture.names)), ylabel=plain(column_words(picture.y, picture.names)))
    axes.set_title(plain(title), loc="left")
    axes.margins(y=0.08)
    _add_legend(figure, axes, picture, colours)
    return figure


def _draw_series(
    axes: Axes, picture: Picture, series: Series, x: FloatArray, beside: FloatArray, colour: Any, marker: str
) -> None:
    """``beside``: x, shifted sideways for intervals."""
    order = np.argsort(x, kind="stable")
    values, predicted, reference = (_column(series.places, key)[order] for key in ("value", "predicted", "reference"))
    x, beside = x[order], beside[order]
    low, high = (_column(series.places, key)[order] for key in ("low", "high"))
    bars = np.abs(np.array([values - low, high - values]))
    if picture.measured:
        axes.plot(x, predicted, color=colour, lw=1.2, alpha=0.8)
        axes.errorbar(
            beside, values, bars, fmt=marker, ms=4.5, color=colour, mec="white", mew=0.5, elinewidth=1.1, capsize=2.5
        )
        return
    few = len(x) <= 40
    axes.plot(x, values, color=colour, lw=1.5, marker=marker if few else None, ms=4, mec="white", mew=0.5)
    axes.plot(x, reference, color=colour, lw=1.0, ls=(0, (4, 2)))
    if picture.intervals:
        axes.errorbar(x, values, bars, fmt="none", color=colour, elinewidth=1.1, capsize=2.5)


def _add_legend(figure: Figure, axes: Axes, picture: Picture, colours: Sequence[Any]) -> None:
    """Above the axes: what lines and points mean; next to them: the colours of the series."""
    entries: list[tuple[Line2D, str]] = []

    def enter(label: str, colour: str = DARK_GREY, **look: Any) -> None:
        entries.append((Line2D([], [], color=colour, **look), label))

    if picture.measured:
        enter("measured, 95 % interval", marker="o", ls="", ms=4.5)
        enter("predicted", lw=1.2)
    elif any(place.reference is not None for place in picture.places):
        enter(LAW_NAMES["emulated"], marker="o", lw=1.5, ms=4)
        enter(LAW_NAMES["continuous"], lw=1.0, ls=(0, (4, 2)))
    elif picture.intervals:
        enter("sampled, 95 % interval", marker="o", lw=1.5, ms=4)
    if any(place.value is None for place in picture.places):
        enter("no result", BLACK, marker="x", ls="", ms=5)
    if entries:
        legend_beside(figure, "upper right", *zip(*entries, strict=True), ncols=3)
    if len(picture.series) > 1:
        chosen = np.unique(np.linspace(0, len(picture.series) - 1, _IN_LEGEND).round().astype(int))
        handles = [Line2D([], [], color=colours[i], marker=_SHAPES[i % len(_SHAPES)], ms=4.5, lw=1.2) for i in chosen]
        names = [plain(picture.words(picture.series[i].values)) for i in chosen]
        axes.legend(handles, names, loc="upper left", bbox_to_anchor=(1.0, 1.02), borderaxespad=0.4)
