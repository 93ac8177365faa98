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

"""Figures of a run, a comparison and a prediction, for scripts and notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.common.large_arrays import release
from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.errors import InputError
from msg_analysis.inference.verdict.comparison import Comparison
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.report.documents.comparison_words import agent_errors, verdict_line
from msg_analysis.report.figures.matplotlib_style import STYLE, plain, rendered
from msg_analysis.report.figures.palette import BLACK, BLUE, LINE_COLOURS, SKY, VERMILLION, mode_colour, shorten
from msg_analysis.theory.prediction import Prediction
from msg_analysis.types import FloatArray

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


def run_figure(trajectory: Trajectory, agents: Sequence[int] | None, replica: int) -> NotebookFigure:
    """States of agents (from 0; None: the first ones) over time, and the graph of every step.

    Of long runs, ``MOST_POINTS`` states at equal distances. InputError: no such agent or replica.
    """
    experiment = trajectory.record.experiment
    chosen = list(range(min(experiment.agents, MOST_LINES)) if agents is None else agents)
    wrong = [agent for agent in chosen if not 0 <= agent < experiment.agents]
    if wrong or not chosen:
        wanted = f"expected agents from 0 to {experiment.agents - 1}"
        raise InputError(f"agents: {wrong[0] if wrong else 'none'}: {wanted}: choose at least one")
    if not 0 <= replica < experiment.run.replicas:
        raise InputError(f"replica: {replica}: expected a number from 0 to {experiment.run.replicas - 1}")
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
        figure.legend(loc="outside right upper", fontsize=8)
        _draw_graphs(band, trajectory)
        band.set_xlim(axes.get_xlim())
    return figure


def _draw_graphs(axes: Axes, trajectory: Trajectory) -> None:
    """A stripe for each graph, filled while it is active."""
    experiment, modes = trajectory.record.experiment, trajectory.modes
    names = [graph.name for graph in experiment.graph_list]
    starts = np.concatenate(([0], np.flatnonzero(np.diff(modes)) + 1)) if len(modes) else np.empty(0, dtype=int)
    ends = np.append(starts[1:], len(modes))
    for mode in range(len(names)):
        own = modes[starts] == mode
        stretches = np.stack([starts[own], ends[own] - starts[own]], axis=1) * experiment.step_length
        axes.broken_barh(stretches.tolist(), (mode - 0.4, 0.8), color=mode_colour(mode))
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
        measured, wanted, spread = (_column(nodes, key) for key in ("measured", "predicted", "standard_error"))
        apart = np.nan_to_num(_column(nodes, "p_holm"), nan=1.0) < comparison.level
        below.hlines(wanted, numbers - 0.32, numbers + 0.32, color=BLACK, lw=1.5, label="predicted")
        for which, colour, label in ((~apart, BLUE, "measured, 95 % interval"), (apart, VERMILLION, "rejected")):
            if which.any():
                below.errorbar(
                    numbers[which], measured[which], np.nan_to_num(HALF_WIDTH_95 * spread[which]),
                    fmt="o", ms=4, color=colour, mec="white", mew=0.5, elinewidth=1.1, capsize=2.5, label=label,
                )  # fmt: skip
        below.set_ylabel("mean-square error" + (", given the path" if given_path else ""))
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


def _name_agents(axes: Axes, experiment: ValidExperiment) -> None:
    axes.set(xlabel="agent", xlim=(0.4, experiment.agents + 0.6))
    if experiment.agents <= _NAMED:
        names = [plain(shorten(agent_name(agent, experiment.names))) for agent in range(1, experiment.agents + 1)]
        long = sum(map(len, names)) > 70
        axes.set_xticks(
            range(1, experiment.agents + 1), names, rotation=45 if long else 0, ha="right" if long else "center"
        )
    axes.grid(visible=False, axis="x")


def _column(rows: Sequence[dict[str, Any]], key: str) -> FloatArray:
    return np.array([row.get(key) for row in rows], dtype=float)  # None: nan
