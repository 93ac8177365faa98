# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Figures of matplotlib: runs, comparisons, predictions, spectra."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import matplotlib as mpl
import networkx as nx
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from msg_analysis.common.arrays import FloatArray, IntArray, release
from msg_analysis.common.files import write_whole
from msg_analysis.common.text import HALF_WIDTH_95, agent_name
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graphs import Graph
from msg_analysis.inference.autocovariance import LoggedAutocovariance, LoggedDensity
from msg_analysis.inference.comparison import Comparison
from msg_analysis.model.run import Run
from msg_analysis.report.comparison_text import agent_errors, verdict_line
from msg_analysis.report.look import (
    BLACK,
    BLUE,
    DARK_GREY,
    INK,
    LABELLED,
    LIGHT_GREY,
    LINE_COLOURS,
    MODE_COLOURS,
    PALE,
    SKY,
    VERMILLION,
    column_of,
    shorten,
)
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.spectrum import Spectrum

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": LIGHT_GREY,
    "axes.titlesize": 10,
    "axes.labelcolor": INK,
    "xtick.color": DARK_GREY,
    "ytick.color": DARK_GREY,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "msg_analysis",
}


def plain(text: str) -> str:
    """The text without mathematics, which matplotlib finds between dollars."""
    return text.replace("$", r"\$")


def rendered(figure: Figure, kind: str, dpi: float) -> bytes:
    """The file of a figure (png, svg or pdf), without times and versions in it."""
    without = {"png": ("Software",), "svg": ("Date", "Creator")}.get(kind, ("CreationDate", "Creator", "Producer"))
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=dpi, metadata=dict.fromkeys(without))
    return stream.getvalue()


def draw_graph(
    axes: Axes,
    graph: Graph,
    places: Mapping[int, FloatArray],  # (2,) of every agent, from 0
    colour: str,
    *,
    leaders: Set[int] = frozenset(),  # from 0
    names: Sequence[str] | None = None,
    size: float | None = None,  # area of an agent [points^2]; None: by the number of agents
) -> None:
    """Draw one graph; leaders are squares."""
    agents = graph.agents
    size = size or (float(min(4200 / agents, 260)) if agents <= LABELLED else 14.0)
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
    if agents <= LABELLED:
        labels = {i: plain(shorten(agent_name(i + 1, names), 8)) for i in range(agents)}
        nx.draw_networkx_labels(network, places, labels, ax=axes, font_size=8 if agents <= 20 else 5.5)
    axes.set_title(plain(shorten(graph.name)), color=BLACK)
    axes.margins(0.12)
    axes.set_aspect("equal")


MOST_LINES = len(LINE_COLOURS)  # agents drawn by default
MOST_POINTS = 4000  # of a line
_NAMED = 30  # most agents below an axis that are all named
_DPI = 120


class NotebookFigure(Figure):
    """A figure that notebooks show, whatever their settings of matplotlib are."""

    def _repr_png_(self) -> bytes:
        return rendered(self, "png", _DPI)


def stacked_panels(*sizes: float) -> tuple[NotebookFigure, Sequence[Axes]]:
    """A figure with panels of these heights [inches] below each other."""
    figure = NotebookFigure(figsize=(7.2, sum(sizes)), layout="constrained")
    panels = figure.subplots(len(sizes), 1, squeeze=False, gridspec_kw={"height_ratios": sizes})
    return figure, list(panels[:, 0])


def legend_beside(figure: Figure, place: str, *entries: Any, **how: Any) -> None:
    """A legend outside of the panels, at ``right upper`` or ``upper right``."""
    try:
        figure.legend(*entries, loc=f"outside {place}", **how)
    except ValueError:  # before matplotlib 3.7
        corner = "upper left" if place == "right upper" else "lower right"
        figure.axes[0].legend(*entries, loc=corner, bbox_to_anchor=(1.0, 1.0), **how)


def run_figure(trajectory: Run, agents: Sequence[int] | None, replica: int) -> NotebookFigure:
    """States of agents (from 0; None: the first ones) over time, and the graph of every step. InputError: no agent."""
    experiment = trajectory.record.experiment
    chosen = list(range(min(experiment.agents, MOST_LINES)) if agents is None else agents)
    if not chosen:
        raise InputError("agents: none: expected at least one")
    every = max(1, -(-len(trajectory.states) // MOST_POINTS))
    values = trajectory.states[::every, chosen, replica]
    release(trajectory.states)
    times = np.arange(0, len(trajectory.states), every) * experiment.step_length
    with mpl.rc_context(STYLE):
        figure, (axes, band) = stacked_panels(3.4, 0.7)
        for place, agent in enumerate(chosen):
            label = plain(shorten(f"agent {agent_name(agent + 1, experiment.names)}"))
            axes.plot(times, values[:, place], lw=0.9, color=LINE_COLOURS[place % MOST_LINES], label=label)
        if experiment.problem == "tracking":
            axes.axhline(experiment.reference, color=BLACK, lw=0.9, ls=(0, (4, 2)), label="reference")
        axes.set(ylabel="state", xlim=(0.0, max(float(times[-1]), experiment.step_length)))
        axes.set_title(plain(experiment.name), loc="left")
        axes.tick_params(labelbottom=False)
        legend_beside(figure, "right upper", fontsize=8)
        modes, dt = trajectory.modes, experiment.step_length
        starts = np.concatenate(([0], np.flatnonzero(np.diff(modes)) + 1)) if len(modes) else np.empty(0, dtype=int)
        draw_path(band, experiment, starts * dt, np.append(starts[1:], len(modes)) * dt, modes[starts])
        band.set_xlim(axes.get_xlim())
    return figure


def draw_path(axes: Axes, experiment: Experiment, starts: FloatArray, ends: FloatArray, graphs: IntArray) -> None:
    """A stripe for each graph, filled while it is active: in stretches (p,) of the path [units of simulated time]."""
    names = [graph.name for graph in experiment.graph_list]
    for mode in range(len(names)):
        own = graphs == mode
        stretches = np.stack([starts[own], ends[own] - starts[own]], axis=1)
        axes.broken_barh(stretches.tolist(), (mode - 0.4, 0.8), color=MODE_COLOURS[mode % len(MODE_COLOURS)])
    axes.set(xlabel="simulated time", ylim=(len(names) - 0.4, -0.6))
    few = len(names) <= 6
    axes.set_yticks(range(len(names)) if few else [], [plain(shorten(name)) for name in names] if few else [])
    axes.grid(visible=False)
    axes.set_ylabel("" if few else "graph")


def comparison_figure(comparison: Comparison) -> NotebookFigure:
    """The system error up to each time, and the agents' errors, each with 95 % intervals, beside the prediction."""
    document, experiment = comparison.to_json(), comparison.trajectory.record.experiment
    nodes, given_path = agent_errors(document)
    running = comparison.running
    with mpl.rc_context(STYLE):
        figure, (above, below) = stacked_panels(2.3, 2.6)
        time, mean, error = running["time"], running["system_error"], running["standard_error"]
        predicted = comparison.system_error.predicted
        if len(time):
            if error.any():
                centre = mean if predicted is None else predicted
                half = HALF_WIDTH_95 * error
                above.fill_between(time, centre - half, centre + half, color=SKY, alpha=0.3, lw=0, label="95 % band")
            above.plot(time, mean, color=BLUE, lw=1.6, label="measured up to this time")
            late = mean[time >= time[-1] / 50]
            low, high = min(late.min(), predicted or late.min()), max(late.max(), predicted or late.max())
            above.set_ylim(max(low - 0.4 * (high - low), 0.0), high + 0.4 * (high - low) + 1e-12)
        if predicted is not None:
            above.axhline(predicted, color=BLACK, lw=1.0, ls=(0, (4, 2)), label="predicted")
        above.set(xlabel="simulated time", ylabel="system error")
        above.set_title(plain(f"{experiment.name}: {verdict_line(document)}"), loc="left")
        above.legend(loc="upper right", ncols=3, fontsize=8)
        numbers = np.arange(1, len(nodes) + 1)
        measured, wanted, spread = (column_of(nodes, key) for key in ("measured", "predicted", "standard_error"))
        apart = np.nan_to_num(column_of(nodes, "p_adjusted"), nan=1.0) < comparison.level
        below.hlines(wanted, numbers - 0.32, numbers + 0.32, color=BLACK, lw=1.5, label="predicted")
        for which, colour, label in ((~apart, BLUE, "measured, 95 % interval"), (apart, VERMILLION, "rejected")):
            if which.any():
                below.errorbar(
                    numbers[which], measured[which], np.nan_to_num(HALF_WIDTH_95 * spread[which]),
                    fmt="o", ms=4, color=colour, mec="white", mew=0.5, elinewidth=1.1, capsize=2.5, label=label,
                )  # fmt: skip
        below.set_ylabel("mean-square error" + (", corrected for graphs" if given_path else ""))
        _name_agents(below, experiment)
        below.legend(loc="best", ncols=3, fontsize=8)
    return figure


def prediction_figure(prediction: Prediction) -> NotebookFigure:
    """The agents' errors in the steady state, by every law that there is."""
    experiment, laws = prediction.experiment, prediction.laws()
    numbers = np.arange(1, experiment.agents + 1)
    with mpl.rc_context(STYLE):
        figure, (axes,) = stacked_panels(3.2)
        for place, (name, moments) in enumerate(laws.items()):
            shift = 0.16 * (place - (len(laws) - 1) / 2)
            label = f"{name}: system error {moments.system_error:.4g}"
            axes.plot(numbers + shift, moments.node_errors, "os^"[place], ms=5, color=LINE_COLOURS[place], label=label)
        axes.set_ylabel("mean-square error")
        axes.set_title(plain(experiment.name), loc="left")
        axes.set_ylim(bottom=0.0)
        axes.margins(y=0.15)
        _name_agents(axes, experiment)
        axes.legend(loc="best", fontsize=8)
    return figure


def _name_agents(axes: Axes, experiment: Experiment) -> None:
    axes.set(xlabel="agent", xlim=(0.4, experiment.agents + 0.6))
    if experiment.agents <= _NAMED:
        numbers = range(1, experiment.agents + 1)
        names = [plain(shorten(agent_name(agent, experiment.names))) for agent in numbers]
        turned: dict[str, Any] = {"rotation": 45, "ha": "right"} if sum(map(len, names)) > 70 else {}
        axes.set_xticks(numbers, names, **turned)
    axes.grid(visible=False, axis="x")


FORMATS = ("png", "svg", "pdf")
_SPECTRUM_DPI = 150


def require_format(file: Path) -> str:
    """The format that the name of a file says; InputError: none that is written."""
    kind = file.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise InputError(f"{file}: expected a name that ends with .png, .svg or .pdf")
    return kind


def write_spectrum(figure: NotebookFigure, file: Path) -> Path:
    """Write it in the format of its name, whole or not at all."""
    return write_whole(file, rendered(figure, require_format(file), _SPECTRUM_DPI))


def spectrum_figure(
    spectrum: Spectrum, log: LoggedAutocovariance | None = None, density: LoggedDensity | None = None
) -> NotebookFigure:
    """Autocovariance over the lag, and density over the frequency: of the system, and of some agents."""
    experiment = spectrum.prediction.experiment
    with mpl.rc_context(STYLE):
        figure, (above, below) = stacked_panels(2.7, 2.9)
        above.plot(spectrum.times, spectrum.system_autocovariance, color=BLACK, lw=1.5, label="system, predicted")
        below.plot(spectrum.frequencies, spectrum.system_density, color=BLACK, lw=1.5)
        for agent in range(min(experiment.agents, len(LINE_COLOURS))):
            label = plain(shorten(f"agent {agent_name(agent + 1, experiment.names)}"))
            colour = LINE_COLOURS[agent % len(LINE_COLOURS)]
            above.plot(spectrum.times, spectrum.node_autocovariances[:, agent], color=colour, lw=0.8, label=label)
            below.plot(spectrum.frequencies, spectrum.node_densities[:, agent], color=colour, lw=0.8)
        if density is not None:
            inner = slice(1, -1)  # at its ends, Welch's density is half of the one-sided one
            below.plot(density.frequencies[inner], density.system[inner], color=SKY, lw=3.0, zorder=1)
            above.plot([], [], color=SKY, lw=3.0, label="density of the log (Welch)")
        if log is not None:
            half = HALF_WIDTH_95 * log.standard_errors
            above.errorbar(
                log.times, log.corrected, half, fmt="o", color=VERMILLION, ms=3.5, lw=1.2, label="measured, 95 %"
            )
        above.axhline(0.0, color=BLACK, lw=0.5)
        above.set(xlabel="lag [simulated time]", ylabel="autocovariance")
        above.set_title(plain(experiment.name), loc="left")
        below.set(xlabel="frequency [cycles per unit of simulated time]", ylabel="spectral density", xscale="log")
        if any((np.asarray(line.get_ydata()) > 0.0).any() for line in below.get_lines()):
            below.set_yscale("log")
        legend_beside(figure, "right upper", *above.get_legend_handles_labels(), fontsize=8)
    return figure
