# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The figure of a sweep: one column of its table over a swept key."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import write_whole
from msg_analysis.experiment.problems import show
from msg_analysis.report.figures import BLACK, DARK_GREY, MODE_COLOURS, STYLE, plain, rendered, shifted
from msg_analysis.sweep.results import Picture, Place, Series, axis_name, column_words
from msg_analysis.theory.prediction import LAW_NAMES

FORMATS = ("svg", "png")
_DPI = 150
_SIZE = (7.2, 4.2)  # inches
_MARKERS = "os^Dv<>p"
_NAMED = 8
"""Most series in the legend; of more, it has some, and colours go from dark to light."""


def write_figure(picture: Picture, title: str, directory: Path) -> list[Path]:
    """Write ``figure.svg`` and ``figure.png``, each whole or not at all."""
    with mpl.rc_context(STYLE):
        figure = draw(picture, title)
        return [write_whole(directory / f"figure.{name}", rendered(figure, name, _DPI)) for name in FORMATS]


def draw(picture: Picture, title: str) -> Figure:
    """The figure; the caller sets the style."""
    figure = Figure(figsize=_SIZE, layout="constrained")
    axes = figure.subplots()
    labels = list(dict.fromkeys(show(place.x) for series in picture.series for place in series.places))
    numbers = picture.numeric
    count = len(picture.series)
    colours = _colours(count)
    along = [
        np.array([float(place.x) if numbers else labels.index(show(place.x)) for place in series.places])
        for series in picture.series
    ]
    every, logarithmic = np.concatenate(along), numbers and picture.logarithmic
    for number, (series, x, colour) in enumerate(zip(picture.series, along, colours, strict=True)):
        beside = shifted(x, every, number, count, logarithmic=logarithmic)
        _draw_series(axes, picture, series, x, beside, colour, _MARKERS[number % len(_MARKERS)])
    if not numbers:
        axes.set_xticks(range(len(labels)), [plain(label) for label in labels])
        axes.set_xlim(-0.5, len(labels) - 0.5)
    elif picture.logarithmic:
        axes.set_xscale("log")
    _mark_failures(axes, picture, labels, numbers)
    axes.set(xlabel=plain(axis_name(picture.x, picture.names)), ylabel=plain(column_words(picture.y, picture.names)))
    axes.set_title(plain(title), loc="left")
    axes.margins(y=0.08)
    _legend(figure, axes, picture, colours)
    return figure


def _draw_series(
    axes: Axes,
    picture: Picture,
    series: Series,
    x: FloatArray,
    beside: FloatArray,  # the same, shifted sideways for intervals
    colour: Any,
    marker: str,
) -> None:
    order = np.argsort(x, kind="stable")
    values, predicted, reference = (_column(series.places, key)[order] for key in ("value", "predicted", "reference"))
    x, beside = x[order], beside[order]
    if picture.measured:
        low, high = (_column(series.places, key)[order] for key in ("low", "high"))
        axes.plot(x, predicted, color=colour, lw=1.2, alpha=0.8)
        bars = np.abs(np.array([values - low, high - values]))
        axes.errorbar(
            beside, values, bars, fmt=marker, ms=4.5, color=colour, mec="white", mew=0.5, elinewidth=1.1, capsize=2.5
        )
        return
    few = len(x) <= 40
    axes.plot(x, values, color=colour, lw=1.5, marker=marker if few else None, ms=4, mec="white", mew=0.5)
    axes.plot(x, reference, color=colour, lw=1.0, ls=(0, (4, 2)))


def _mark_failures(axes: Axes, picture: Picture, labels: Sequence[str], numbers: bool) -> None:
    """A cross at the foot of the axes for every place without a result."""
    lost = [place.x for series in picture.series for place in series.places if place.value is None]
    if lost:
        x = [float(place) if numbers else labels.index(show(place)) for place in lost]
        axes.plot(
            x, [0.015] * len(x), "x", color=BLACK, ms=5, transform=axes.get_xaxis_transform(), clip_on=False, zorder=5
        )


def _legend(figure: Figure, axes: Axes, picture: Picture, colours: Sequence[Any]) -> None:
    """Above the axes: what lines and points mean; next to them: the colours of the series."""
    entries: list[tuple[Line2D, str]] = []
    if picture.measured:
        entries.append((Line2D([], [], color=DARK_GREY, marker="o", ls="", ms=4.5), "measured, 95 % interval"))
        entries.append((Line2D([], [], color=DARK_GREY, lw=1.2), "predicted"))
    elif any(place.reference is not None for series in picture.series for place in series.places):
        entries.append((Line2D([], [], color=DARK_GREY, marker="o", lw=1.5, ms=4), LAW_NAMES["emulated"]))
        entries.append((Line2D([], [], color=DARK_GREY, lw=1.0, ls=(0, (4, 2))), LAW_NAMES["continuous"]))
    if any(place.value is None for series in picture.series for place in series.places):
        entries.append((Line2D([], [], color=BLACK, marker="x", ls="", ms=5), "no result"))
    if entries:
        figure.legend(*zip(*entries, strict=True), loc="outside upper right", ncols=3)
    if len(picture.series) > 1:
        chosen = np.unique(np.linspace(0, len(picture.series) - 1, _NAMED).round().astype(int))
        handles = [Line2D([], [], color=colours[i], marker=_MARKERS[i % len(_MARKERS)], ms=4.5, lw=1.2) for i in chosen]
        names = [plain(picture.words(picture.series[i].values)) for i in chosen]
        axes.legend(handles, names, loc="upper left", bbox_to_anchor=(1.0, 1.02), borderaxespad=0.4)


def _colours(count: int) -> list[Any]:
    if count <= _NAMED:
        return list(MODE_COLOURS[:count])
    return list(mpl.colormaps["viridis"](np.linspace(0, 0.92, count)))


def _column(places: Sequence[Place], key: str) -> Any:
    return np.array([getattr(place, key) for place in places], dtype=float)  # None: nan
