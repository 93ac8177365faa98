"""The picture of the README: what one recorded run looks like, from its bag.

.venv/bin/msg-agents run analysis/msg_analysis/experiment/bundled/line_ring.yaml
.venv/bin/python benchmarks/picture.py runs/line_ring_... docs/images/run.svg
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import matplotlib as mpl
import networkx as nx
import numpy as np
from matplotlib.figure import Figure

from msg_analysis.bags.reading import read_bag
from msg_analysis.experiment.graphs import Graph
from msg_analysis.inference.online_errors import RunningErrors
from msg_analysis.model.run import Run
from msg_analysis.theory.prediction import predict

SHOWN = 30.0  # units of time of which the states are drawn
POINTS = 80  # of the running error
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito: told apart by everybody


def main() -> None:
    """Draw the bag into the file."""
    parser = argparse.ArgumentParser(description="Draw a run: graphs, states, running error.")
    parser.add_argument("bag")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "msg_agents", "font.size": 10}):
        picture(read_bag(arguments.bag)).savefig(arguments.out, metadata={"Date": None})


def picture(run: Run) -> Figure:
    """Graphs on the left; on the right states under the active graph, and the running error with its interval."""
    experiment = run.record.experiment
    graphs = experiment.graph_list
    colours = [("#dce9f5", "#0072B2"), ("#fbe6d6", "#D55E00")] * len(graphs)
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 4.2), height_ratios=(1.15, 1))
    for row, graph in enumerate(graphs[:2]):
        axes = figure.add_subplot(grid[row, 0])
        draw(axes, graph, colours[row][1])
    shown = round(SHOWN / experiment.run.dt)
    times = experiment.run.dt * np.arange(shown + 1)
    axes = figure.add_subplot(grid[0, 1])
    changes = [0, *(np.flatnonzero(np.diff(run.modes[:shown])) + 1), shown]
    for first, behind in itertools.pairwise(changes):
        axes.axvspan(times[first], times[behind], color=colours[run.modes[first]][0], linewidth=0)
    values = run.values[: shown + 1, :, 0]
    for agent, colour in zip(range(experiment.agents), COLOURS, strict=False):
        axes.plot(times, values[:, agent], color=colour, linewidth=0.9, label=f"{agent + 1}")
    axes.set(xlim=(0, SHOWN), ylabel="state", title="What the agents published, and the graph they had")
    axes.legend(title="agent", ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    running(figure.add_subplot(grid[1, 1]), run)
    return figure


def draw(axes: mpl.axes.Axes, graph: Graph, colour: str) -> None:
    """One graph, agents on a circle, the first at the top."""
    network = nx.Graph((source, target) for source, target, _ in graph.edges)
    angles = np.pi / 2 - 2 * np.pi * np.arange(graph.agents) / graph.agents
    places = {i + 1: (np.cos(angle), np.sin(angle)) for i, angle in enumerate(angles)}
    nx.draw_networkx(network, places, ax=axes, node_color="white", edgecolors=colour, edge_color=colour, font_size=9)
    axes.set_title(graph.name, color=colour)
    axes.set_aspect("equal")
    axes.margins(0.25)
    axes.axis("off")


def running(axes: mpl.axes.Axes, run: Run) -> None:
    """The mean-square error so far with its 95 % interval, beside the prediction."""
    experiment = run.record.experiment
    prediction = predict(experiment)
    errors = RunningErrors(run.record, prediction)
    ends = np.unique(np.geomspace(10 / experiment.run.dt, experiment.steps, POINTS).astype(int))
    rows = []
    first = 0
    for end in ends:
        steps = np.arange(first, end)
        errors.add(steps, run.modes[first:end], run.values[first:end], run.values[first + 1 : end + 1])
        system, _ = errors.estimates()
        low, high = system.interval
        assert system.measured is not None
        assert low is not None
        assert high is not None
        rows.append((system.measured, low, high))
        first = int(end)
    times = experiment.run.dt * ends
    measured, low, high = np.array(rows).T
    axes.fill_between(times, low, high, color="#0072B2", alpha=0.2, linewidth=0, label="95 % interval")
    axes.plot(times, measured, color="#0072B2", label="measured so far")
    axes.axhline(prediction.emulated.system_error, color="#D55E00", linestyle="--", label="predicted")
    axes.set(xlabel="simulated time", ylabel="mean-square error", xlim=(0, times[-1]), ylim=(1.0, 2.0))
    axes.legend(loc="upper right", ncols=3, frameon=False)


if __name__ == "__main__":
    main()
