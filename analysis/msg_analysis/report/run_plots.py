# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Interactive plots of a run: states, graphs, events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, PlainText, Range1d, RangeTool, UIElement

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray, pieces
from msg_analysis.common.text import agent_text, counted
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import phases
from msg_analysis.report.look import shorten
from msg_analysis.report.plot_style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    NUMBERS,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Thinned,
    envelope,
    graph_colour,
    new_figure,
    show_values,
    thin,
    thin_together,
)

KINDS = ("killed", "back", "late", "refused", "missing")
MOST_LANES = 16  # graphs that have a lane each
MOST_EVENTS = 400  # of a kind, the longest; others are counted
_NEAR = 5  # steps between two late ones of an agent that are told together


@dataclass(frozen=True, slots=True)
class Event:
    """One event, from step to step (both included)."""

    kind: str  # one of KINDS
    first: int
    last: int
    words: str


def run_events(
    trajectory: Run, reported: Sequence[Mapping[str, Any]] = (), most: int = MOST_EVENTS
) -> tuple[list[Event], int]:
    """The events, also those that the network reported, of each kind at most so many, and how many more there are."""
    names, late, missing = trajectory.record.experiment.names, [], []
    for agent, first, last, number in _stretches(_late(trajectory), _NEAR):
        words = f"{agent_text(agent, names)}: late by more than a period in {counted(number, 'step')}"
        late.append(Event("late", first, last, words))
    for agent, first, last, number in _stretches(_missing(trajectory), 1):
        words = f"{agent_text(agent, names)}: {counted(number, 'state')} missing"
        missing.append(Event("missing", first, last, words))
    others = [Event(one["kind"], one["step"], one["step"], one["words"]) for one in reported if one["kind"] in KINDS]
    kept, more = [], 0
    for kind in (others, late, missing):
        longest = sorted(kind, key=lambda event: event.first - event.last)[:most]
        kept += longest
        more += len(kind) - len(longest)
    return sorted(kept, key=lambda event: (event.first, KINDS.index(event.kind))), more


def _late(trajectory: Run) -> Iterable[tuple[int, BoolArray]]:
    """Pieces (first step, (steps, m)): which states were made more than a period after they were due."""
    if trajectory.made is None:
        return
    experiment, made = trajectory.record.experiment, trajectory.made
    clocks = [StepClock(experiment.step_length, phase) for phase in phases(experiment).tolist()]
    for piece in pieces(made):
        first, last = max(piece.start, 1), min(piece.stop, len(made))
        due = np.stack([clock.times(np.arange(first - 1, last - 1)) for clock in clocks], axis=1)
        yield first, made[first:last] - due > experiment.step_length * 1e9


def _missing(trajectory: Run) -> Iterable[tuple[int, BoolArray]]:
    """Pieces (first step, (steps, m)): which states are missing."""
    if not trajectory.completeness.missing:
        return
    for states in (trajectory.states, trajectory.published):
        if states is not None:
            for piece in pieces(states):
                yield piece.start, np.asarray(np.isnan(states[piece]).any(axis=2))


def _stretches(found: Iterable[tuple[int, BoolArray]], near: int) -> list[tuple[int, int, int, int]]:
    """(agent from 1, first step, last step, number of steps) of those that are at most ``near`` steps apart."""
    stretches: list[tuple[int, int, int, int]] = []
    open_ones: dict[int, tuple[int, int, int]] = {}  # by agent
    for start, piece in found:
        for step, agent in np.argwhere(piece).tolist():
            at, (first, last, number) = start + step, open_ones.get(agent, (-1, -1, 0))
            if number and 0 <= at - last <= near:
                open_ones[agent] = first, at, number + (at > last)
            else:
                if number:
                    stretches.append((agent + 1, first, last, number))
                open_ones[agent] = at, at, 1
    stretches += [(agent + 1, *stretch) for agent, stretch in open_ones.items()]
    return stretches


def occupancy(modes: IntArray, names: Sequence[str], stationary: FloatArray) -> UIElement:
    """Share of the time of every graph next to the stationary law (n,)."""
    present = modes[modes >= 0]
    share = np.bincount(present, minlength=len(names)) / max(len(present), 1)
    places = np.arange(len(names))
    shares = new_figure(
        min(110 + 30 * len(names), 520), "save", title="share of time", y_range=Range1d(len(names) - 0.4, -0.6),
        toolbar_location=None, x_axis_label="bar: measured; mark: predicted",
    )  # fmt: skip
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
    rows = [("graph", "@name"), ("measured", "@share{0.0 %}"), ("predicted", "@predicted{0.0 %}")]
    show_values(shares, [drawn], rows)
    _name_lanes(shares, [PlainText(text=shorten(name)) for name in names])
    return shares


def _name_lanes(plot: Any, names: Sequence[str | PlainText]) -> None:
    """Names that may hold mathematics are plain texts: for those, the page would load a library from the network."""
    plot.ygrid.grid_line_color = None
    plot.yaxis.ticker = FixedTicker(ticks=list(range(len(names))))
    plot.yaxis.major_label_overrides = dict(enumerate(names))


OTHER_REPLICAS = 1_000_000  # bytes of the page for the replicas after the first
MOST_INTERVALS = 20_000  # of a run, that are drawn
_WHOLE, _FIRST_INTERVALS = 1500, 30  # steps of a run that is seen whole at first; intervals visible at first of others
_LEAST_BINS = 250  # of a replica after the first, if the run has as many steps
_UNKNOWN = 65_535  # stands for NaN among whole numbers of 16 bits
_SIDES = {"min_border_left": 76, "min_border_right": 14}  # pixels: equal, so that the figures have one time axis
_EVENT_STYLE = {
    "killed": (VERMILLION, "x"),
    "back": (GREEN, "triangle"),
    "late": (ORANGE, "square"),
    "refused": (PURPLE, "diamond"),
    "missing": (BLACK, "dash"),
}
_TOOLS = "xpan,xbox_zoom,xwheel_zoom,reset,save"


def trajectory_plots(
    trajectory: Run, predicted: float | None, events: Sequence[Event] = ()
) -> tuple[dict[str, UIElement], dict[str, int]]:
    """The figures by name, none for a run without states; how many replicas and intervals of ``all_intervals``."""
    experiment = trajectory.record.experiment
    states, modes, dt = trajectory.values, trajectory.modes, experiment.step_length
    if len(states) < 2 or not len(modes):
        return {}, {"intervals": 0, "all_intervals": 0, "replicas": 0}
    reference = None if experiment.problem == "consensus" else experiment.reference
    first = thin(states, 0, reference)
    replicas, numbers = _room(*states.shape)
    others = thin_together(states, slice(1, replicas), reference, numbers) if replicas > 1 else []
    names = [graph.name for graph in experiment.graph_list]
    starts = np.flatnonzero(np.diff(modes, prepend=-2))
    time = Range1d(*_first_view(starts, len(modes), events, dt), bounds=(0.0, float(len(modes) * dt)), name="time")
    shown = min(len(starts), MOST_INTERVALS)
    end = int(starts[shown]) if shown < len(starts) else len(modes)
    by_agent, by_bin = _columns(first)
    data = [
        _source("thinned_agents_1", **by_agent),
        _source("thinned_bins_1", **by_bin),
        _source("thinned_scale_1", width=[first.width], dt=[dt], agents=[experiment.agents]),
    ]
    for number, thinned in enumerate(others, start=2):
        data += _coded(thinned, experiment.agents, dt, number)
    data.append(
        _source("intervals", start=np.append(starts[:shown], end) * dt, graph=np.append(modes[starts[:shown]], -1))
    )
    many = len(names) > MOST_LANES
    lane, colour = np.arange(len(names)), [graph_colour(mode) for mode in range(len(names))]
    if many:
        lane = np.array([graph.links for graph in experiment.graph_list])
        parts = [graph.parts for graph in experiment.graph_list]
        colour = [SKY if each == 1 else GREY for each in parts]
        names = [f"{name}: {n} links, {each} parts" for name, n, each in zip(names, lane, parts, strict=True)]
    data.append(_source("graphs", name=names, colour=colour, lane=lane))
    figures = {
        "trajectories": _states(time, data),
        **({"events": _events(time, events, dt)} if events else {}),
        "path": _links_over_time(time, int(lane.max())) if many else _active_graph(time, names),
        "errors": _error(time, predicted),
        "overview": _overview(time, float(len(modes) * dt)),
    }
    return figures, {"intervals": shown, "all_intervals": len(starts), "replicas": replicas}


def _room(count: int, agents: int, replicas: int) -> tuple[int, int]:
    """How many replicas have room, the first included; to how many values of the agents the others are thinned."""
    bin_size = (4 * agents + 8) * 2 * 4 / 3  # bytes: lowest and highest values of 16 bits, as text in base64
    others = min(int(OTHER_REPLICAS / (bin_size * min(count, _LEAST_BINS))), replicas - 1)
    bins = OTHER_REPLICAS / (bin_size * max(others, 1))
    return 1 + others, min(int(2 * agents * bins), NUMBERS)


def _first_view(starts: IntArray, steps: int, events: Sequence[Event], dt: float) -> tuple[float, float]:
    """What is visible at first: so little that single intervals can be seen, and the first process that was killed."""
    if steps <= _WHOLE:
        return 0.0, float(steps * dt)
    intervals = int(starts[_FIRST_INTERVALS]) if len(starts) > _FIRST_INTERVALS else steps
    length = min(max(intervals, _WHOLE // 3), steps)
    killed = next((event.first for event in events if event.kind == "killed"), 0)
    first = min(max(killed - length // 3, 0), steps - length)
    return float(first * dt), float((first + length) * dt)


def _source(label: str, **columns: object) -> ColumnDataSource:
    return ColumnDataSource(dict(columns), name=label)


def _columns(thinned: Thinned) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """What the script draws from: agent by agent, and bin by bin."""
    (low, high), (below, above) = thinned.values, thinned.deviations
    by_agent = {"low": low, "deviation_low": below}
    if thinned.width > 1:
        by_agent |= {"high": high, "deviation_high": above}
    pairs = {
        "centre": (thinned.centre[0][:, 0], thinned.centre[1][:, 0]),
        "error": (thinned.error[0][:, 0], thinned.error[1][:, 0]),
        "band": envelope(thinned.values),
        "spread": envelope(thinned.deviations),
    }
    by_bin = {f"{name}_{end}": pair[at] for name, pair in pairs.items() for at, end in enumerate(("low", "high"))}
    return {name: array.T.ravel() for name, array in by_agent.items()}, by_bin


def _coded(thinned: Thinned, agents: int, dt: float, number: int) -> list[ColumnDataSource]:
    """The same in whole numbers of 16 bits, for a replica after the first; the scale has what one means."""
    scale: dict[str, Any] = {"width": [thinned.width], "dt": [dt], "agents": [agents]}
    coded = []
    for label, columns in zip(("agents", "bins"), _columns(thinned), strict=True):
        whole = {}
        for name, column in columns.items():
            known = column[~np.isnan(column)]
            low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
            unit = (high - low) / (_UNKNOWN - 1) or 1.0
            whole[name] = np.nan_to_num(np.rint((column - low) / unit), nan=_UNKNOWN).astype(np.uint16)
            scale |= {f"{name}_from": [low], f"{name}_unit": [unit]}
        coded.append(_source(f"thinned_{label}_{number}", **whole))
    return [*coded, _source(f"thinned_scale_{number}", **scale)]


def _over_time(height: float, time: Range1d, **options: Any) -> Any:
    return new_figure(int(height), _TOOLS, x_range=time, **({"toolbar_location": None} | _SIDES | options))


def _states(time: Range1d, data: list[ColumnDataSource]) -> UIElement:
    y_range = Range1d(-1.0, 1.0, name="states_range")
    plot = _over_time(330, time, y_range=y_range, y_axis_label="state", toolbar_location="above")
    plot.xaxis.visible = False
    plot.vstrip("left", "right", source=_source("strips", left=[], right=[], colour=[]), color="colour", alpha=0.16)
    plot.varea("x", "low", "high", source=_source("band", x=[], low=[], high=[]), color=GREY, alpha=0.25)
    lines = plot.multi_line(
        "xs", "ys", color="colour", line_dash="dash", line_width="width",
        source=_source("states", xs=[], ys=[], agent=[], colour=[], dash=[], width=[]),
    )  # fmt: skip
    plot.line("x", "y", source=_source("centre", x=[], y=[]), color=BLACK, line_width=1.5, line_dash="dashed")
    rows = [("", "@agent"), ("time", "$data_x{0.[000]}"), ("state", "$data_y{0.000}")]
    show_values(plot, [lines], rows, line_policy="nearest")
    plot.tags = data  # sources that no glyph uses
    return plot


def _active_graph(time: Range1d, names: Sequence[str]) -> UIElement:
    plot = _lanes(time, Range1d(len(names) - 0.4, -0.6), 26 + 22 * len(names), "graph")
    _name_lanes(plot, [PlainText(text=shorten(name, 7)) for name in names])
    return plot


def _links_over_time(time: Range1d, most: int) -> UIElement:
    """Instead of a lane for each graph: its number of links, and whether it is in one part (blue)."""
    return _lanes(time, Range1d(-0.6, most + 0.6), 150, "links")


def _lanes(time: Range1d, lane: Range1d, height: float, label: str) -> Any:
    plot = _over_time(height, time, y_range=lane, y_axis_label=label)
    plot.xaxis.visible = False
    lanes = _source("lanes", graph=[], left=[], right=[], colour=[], name=[])
    bars = plot.hbar("graph", left="left", right="right", height=0.76, color="colour", line_alpha=0, source=lanes)
    rows = [("graph", "@name"), ("from", "@left{0.[00]} to @right{0.[00]}")]
    show_values(plot, [bars], rows)
    return plot


def _events(time: Range1d, events: Sequence[Event], dt: float) -> UIElement:
    """A lane for each kind that there is."""
    kinds = [kind for kind in KINDS if any(event.kind == kind for event in events)]
    lane = Range1d(len(kinds) - 0.4, -0.6)
    plot = _over_time(26 + 20 * len(kinds), time, y_range=lane, y_axis_label="events")
    plot.xaxis.visible = False
    _name_lanes(plot, kinds)
    source = _source(
        "events",
        lane=[kinds.index(event.kind) for event in events],
        left=[event.first * dt for event in events],
        right=[event.last * dt for event in events],
        colour=[_EVENT_STYLE[event.kind][0] for event in events],
        marker=[_EVENT_STYLE[event.kind][1] for event in events],
        words=[event.words for event in events],
    )
    bars = plot.hbar("lane", left="left", right="right", height=0.5, color="colour", line_alpha=0, source=source)
    marks = plot.scatter("left", "lane", marker="marker", size=9, color="colour", line_width=2, source=source)
    rows = [("", "@words"), ("from", "@left{0.[00]} to @right{0.[00]}")]
    show_values(plot, [bars, marks], rows)
    return plot


def _error(time: Range1d, predicted: float | None) -> UIElement:
    y_range = Range1d(0.0, 1.0, name="error_range")
    plot = _over_time(170, time, y_range=y_range, x_axis_label="simulated time", y_axis_label="error")
    strips = _source("error_strips", left=[], right=[], colour=[])
    plot.vstrip("left", "right", source=strips, color="colour", alpha=0.16)
    line = plot.line("x", "y", source=_source("error", x=[], y=[]), color=BLUE, line_width=1.3)
    show_values(plot, [line], [("time", "@x{0.[000]}"), ("error", "@y{0.0000}")], mode="vline")
    if predicted is not None:
        plot.line([*time.bounds], [predicted] * 2, color=BLACK, line_width=1.5, line_dash="dashed", name="predicted")
    return plot


def _overview(time: Range1d, end: float) -> UIElement:
    """The whole run, small, with the visible part as a frame that can be moved."""
    plot = new_figure(64, "", x_range=Range1d(0.0, end), toolbar_location=None, **_SIDES)
    source = _source("overview", x=[], low=[], high=[])
    plot.varea("x", "low", "high", source=source, color=SKY, alpha=0.8)
    plot.line("x", "low", source=source, color=BLUE, line_width=0.7)
    plot.line("x", "high", source=source, color=BLUE, line_width=0.7)
    plot.yaxis.visible = False
    plot.ygrid.grid_line_color = None
    tool = RangeTool(x_range=time)
    tool.overlay.fill_color, tool.overlay.fill_alpha = GREY, 0.2
    tool.overlay.line_color, tool.overlay.line_width = BLUE, 2
    plot.add_tools(tool)
    return plot
