# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The paper's figures: curves by the theory and, if wanted, points that real networks measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import transforms as mtransforms
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import NullLocator

from msg_analysis.common.files import write_whole
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.inference.statistics import holm
from msg_analysis.paper import examples
from msg_analysis.paper.examples import CENTRALITY, NODE, SYSTEM, Curve, Example
from msg_analysis.report import look
from msg_analysis.report.figures import STYLE, draw_graph, rendered
from msg_analysis.report.look import BLACK, DARK_GREY
from msg_analysis.sweeps.grid import own_seed
from msg_analysis.sweeps.points import DONE, Job, Outcome

DT = 0.025  # simulated time of a step: its errors are about 2 % above those of continuous time
REPLICAS = 32
DURATION = 100.0
CYCLES = 30  # least length of a run, in sums of the mean holding times of all graphs: shorter intervals are unreliable
LEVEL = 0.01  # probability that any point is said to disagree although all networks follow the model


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run of a network, in lockstep, with ``REPLICAS`` replicas."""

    example: int  # 1, 2 or 3
    network: str  # key of ``NETWORKS``
    epsilon: float  # [1 / unit of simulated time], scales r12 and r21
    r12: float
    r21: float
    leader: int | None = None  # from 0, held at the reference; None: consensus
    duration: float | None = None  # [units of simulated time]; None: DURATION, or CYCLES if longer

    def job(self) -> Job:
        """The run as a job for a sweep worker."""
        network = examples.NETWORKS[self.network]
        rates = network.generator(self.epsilon, self.r12, self.r21)
        least = CYCLES * float(np.sum(-1.0 / np.diag(rates)))
        duration = self.duration or DT * round(max(DURATION, least) / DT)
        document: dict[str, Any] = {
            "name": self.network,
            "graphs": network.graphs,
            "switching": {"generator": rates.tolist()},
            "run": {"dt": DT, "duration": duration, "replicas": REPLICAS},
        }
        if self.leader is not None:
            document |= {"problem": "tracking", "leaders": {"agents": [self.leader + 1], "gain": "inf"}}
        document["run"]["seed"] = own_seed(self.example, document, 0)
        return Job.of("network", document)

    @property
    def quantities(self) -> list[tuple[str, int | None]]:
        """What is drawn of the run: quantity, and agent from 0 (None: the system)."""
        if self.leader is not None:
            return [(CENTRALITY, self.leader)]
        nodes: list[tuple[str, int | None]] = [(NODE, agent) for agent in range(5)]
        if self.example == 3:
            return nodes
        drawn = 1.0 in (self.r12, self.r21) if self.example == 1 else self.epsilon in examples.NODE_SCALES
        return [(SYSTEM, None), *(nodes if drawn else [])]


def runs_of(example: int) -> list[PlannedRun]:
    """The runs for an example (1, 2 or 3), at rates that the paper's curves go through."""
    if example == 1:
        # Each of these is on one curve over r12 and on one over r21.
        levels = [level for level in examples.LEVELS if level >= 0.5]
        pairs = [(r12, r21) for r12 in levels for r21 in levels] + [(0.1, 1.0), (1.0, 0.1)]
        return [PlannedRun(1, "line_ring", 0.5, *pair) for pair in pairs]
    if example == 2:
        swept = {0.5: (0.25, 0.55, 0.9), 1.0: (0.4, 0.8), 5.0: (0.2, 0.6), 10.0: (0.16, 0.5, 0.9)}
        return [
            PlannedRun(2, "three_lines", scale, r12, examples.R2J) for scale, values in swept.items() for r12 in values
        ]
    runs = []
    for network in ("knife_edge", "smallest"):
        runs += [PlannedRun(3, network, epsilon, 1.0, 1.0, agent) for epsilon in (0.5, 5.0) for agent in range(5)]
        runs += [PlannedRun(3, network, epsilon, 1.0, 1.0) for epsilon in (0.1, 0.5, 2.0, 10.0, 50.0)]
    return runs


@dataclass(frozen=True, slots=True)
class Measured:
    """A measured certainty next to its prediction."""

    run: PlannedRun
    quantity: str  # SYSTEM, NODE or CENTRALITY
    agent: int | None  # from 0; None: the system
    value: float  # 1 / E [1 / variance]
    low: float  # to high: the 95 % interval of the value
    high: float
    predicted: float  # exact for the steps of the run
    z: float  # of the error E, like p
    p: float
    p_adjusted: float = 1.0  # adjusted over all points that were measured together


def measured(runs: Sequence[PlannedRun], outcomes: Sequence[Outcome]) -> list[Measured]:
    """The points that are drawn, of all runs that did not fail; Holm's adjustment is over all of them."""
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        if outcome.status != DONE:
            continue
        for quantity, agent in run.quantities:
            result = outcome.result
            error = result["node_errors"][agent] if quantity == NODE else result["system_error"]
            low, high = error["interval"]
            numbers = (1.0 / error["measured"], 1.0 / high, 1.0 / low if low > 0 else np.inf, 1.0 / error["predicted"])
            found.append(Measured(run, quantity, agent, *numbers, error["z"], error["p"]))
    if not found:
        return []
    adjusted = holm(np.array([point.p for point in found]))
    return [dataclasses.replace(point, p_adjusted=float(p)) for point, p in zip(found, adjusted, strict=True)]


COLUMNS = (*examples.RATES, "value [1/variance]", "low", "high", "predicted", "z", "p", "p_adjusted")


def csv_text(number: int, points: Sequence[Measured]) -> str:
    """The points of one example as CSV: comment lines, a header, a row per point."""
    comments = (
        f"Example {number}: networks of ROS 2 processes in lockstep, dt = {DT:g}, {REPLICAS} replicas, F = I",
        "agent 0 is the system; low to high is the 95 % interval; predicted is exact for the steps of the run",
    )
    rows = []
    for point in points:
        run, agent = point.run, 0 if point.agent is None else point.agent + 1
        numbers = (point.value, point.low, point.high, point.predicted, point.z, point.p, point.p_adjusted)
        if run.example == number:
            rows.append((run.network, point.quantity, agent, run.epsilon, run.r12, run.r21, *numbers))
    return examples.commented_csv(comments, COLUMNS, rows)


def summary(points: Sequence[Measured], runs: int) -> str:
    """One sentence: whether all points agree with theory; ``runs`` is the number of networks."""
    apart = disagreeing(points)
    within = np.mean([point.low <= point.predicted <= point.high for point in points])
    least = min(point.p_adjusted for point in points)
    verdict = f"{len(apart)} disagree with theory" if apart else "all agree with theory"
    return (
        f"{len(points)} points of {runs} networks: {verdict} (Holm over all points, level {LEVEL:g}; smallest adjusted "
        f"p {least:.3g}); {100 * within:.0f} % of the 95 % intervals contain the prediction"
    )


def disagreeing(points: Sequence[Measured]) -> list[Measured]:
    """The points whose adjusted p is below ``LEVEL``."""
    return [point for point in points if point.p_adjusted < LEVEL]


FORMATS = ("png", "svg", "pdf")
WIDTH = 7.16  # inches: two columns of a journal
_DPI = 300
_STYLE = (
    STYLE
    | dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), 8)
    | dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize", "legend.title_fontsize"), 7.5)
    | dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6)
    | dict.fromkeys(("axes.labelcolor", "xtick.color", "ytick.color"), BLACK)
    | {"axes.edgecolor": DARK_GREY, "grid.linewidth": 0.5, "legend.handlelength": 2.0, "legend.borderaxespad": 0.2}
    | {"lines.linewidth": 1.3, "lines.markersize": 3.6, "mathtext.fontset": "dejavusans"}
    | {"pdf.fonttype": 42, "svg.fonttype": "path"}  # TrueType: text stays text; the same where the font is missing
)
# Colour, dashes and marker of the first, second ... curve of a panel; each of the three alone is distinctive.
_COLOURS = (look.BLUE, look.VERMILLION, look.GREEN, look.ORANGE, look.PURPLE)
_DASHES: Any = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (1, 1)), (0, (8, 2)))
_LINES = tuple(zip(_COLOURS, _DASHES, "os^Dv", strict=True))
_SIDE = 0.05  # inches between points at the same rate
_NOTE = (
    "Curves: continuous time.  Points: networks of ROS 2 processes, 95 % intervals.  "
    f"Dashes: prediction for their steps (dt = {DT:g})."
)


def write_figures(
    numbers: Sequence[int], directory: str | Path, formats: Sequence[str] = FORMATS, measured: Sequence[Measured] = ()
) -> list[Path]:
    """Write ``example_<number>``, or with measured points ``example_<number>_emulated``; InputError: it cannot be."""
    directory = Path(directory)
    written = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for number in numbers:
            example = examples.EXAMPLES[number]()
            stem = f"example_{number}{'_emulated' if measured else ''}"
            with mpl.rc_context(_STYLE):
                figure = draw(example, measured)
                for name in formats:
                    written.append(write_whole(directory / f"{stem}.{name}", rendered(figure, name, _DPI)))
            text = csv_text(number, measured) if measured else examples.csv_text(example)
            written.append(write_whole(directory / f"{stem}.csv", text.encode()))
    except OSError as error:
        place = error.filename or directory
        raise InputError(f"{place}: cannot be written ({error.strerror}): choose another place with --out") from error
    return written


def draw(example: Example, measured: Sequence[Measured] = ()) -> Figure:
    """The figure of an example, with measured points on its curves; the caller sets the style."""
    figure = {1: _draw_1, 2: _draw_2, 3: _draw_3}[example.number](example, measured)
    if measured:
        figure.supxlabel(_NOTE, size=7.5, color=DARK_GREY)
    layout = figure.get_layout_engine()
    assert layout
    layout.execute(figure)
    figure.set_layout_engine("none")
    for axes in figure.axes:  # rounded: the last digits depend on the iteration order of a set
        axes.set_position(np.round(axes.get_position(original=True).bounds, 5).tolist())
    return figure


def _draw_1(example: Example, measured: Sequence[Measured]) -> Figure:
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(0.6, 1, 1))
    for row, graph in enumerate(example.networks["line_ring"]):
        _draw_network(
            figure.add_subplot(grid[row, 0]), graph, f"({'ab'[row]}) $G_{row + 1}$: {graph.name}", reconstructed=False
        )
    for row, (swept, held) in enumerate((("r12", "r21"), ("r21", "r12"))):
        system, node = figure.add_subplot(grid[row, 1]), figure.add_subplot(grid[row, 2])
        for value, name, side in ((0.5, "$G_1$ held", "top"), (1.0, "$G_2$ held", "bottom")):
            system.axhline(value, color=DARK_GREY, lw=0.7, zorder=1)
            system.annotate(name, (2.5, value), color=DARK_GREY, va=side, ha="center")
        system.set(ylabel="system certainty $1/E$", ylim=(0.43, 1.07), xlim=(0, 5), xlabel=_rate(swept))
        node.set(ylabel="node certainty $1/E_i$", ylim=(1.3, 5.4), xlim=(0, 5), xlabel=_rate(swept))
        curves = [c for c in example.select("line_ring", SYSTEM) if np.ptp(getattr(c, swept)) > 0]
        named = [(f"{getattr(curve, held)[0]:g}", curve) for curve in curves]
        _plot(system, swept, named, _rate(held), measured)
        nodes = _coinciding([c for c in example.select("line_ring", NODE) if np.ptp(getattr(c, swept)) > 0])
        _plot(node, swept, nodes, "agents", measured)
        system.set_title(rf"({'cd'[row]}) $\epsilon$ = {curves[0].epsilon[0]:g}", loc="left")
        node.set_title(f"({'ef'[row]}) {_rate(held)} = 1", loc="left")
    return figure


def _draw_2(example: Example, measured: Sequence[Measured]) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
    grid = figure.add_gridspec(1, 3, width_ratios=(0.5, 1, 1))
    places = grid[0].subgridspec(3, 1)
    for row, graph in enumerate(example.networks["three_lines"]):
        _draw_network(figure.add_subplot(places[row]), graph, f"({'abc'[row]}) $G_{row + 1}$")
    rates = "$r_{12} = r_{32}$    ($r_{21} = r_{23} = 0.05$)"
    system = figure.add_subplot(grid[1])
    system.set(ylabel="system certainty $1/E$", xlabel=rates, xlim=(0, 1), ylim=(0.495, 0.645))
    curves = example.select("three_lines", SYSTEM)
    _plot(system, "r12", [(f"{c.epsilon[0]:g}", c) for c in curves], r"$\epsilon$", measured=measured)
    for (colour, _, _), curve in zip(_LINES, curves, strict=False):
        peak = (curve.r12[curve.peak], curve.value[curve.peak])
        system.plot(*peak, "*", ms=9, color=colour, mec="white", mew=0.6, zorder=4)
        text = "" if measured else f"{peak[1]:.4f}"
        system.annotate(text, peak, (0, 6), textcoords="offset points", ha="center", color=colour, size=7.5)
    system.set_title("(d) largest values: stars", loc="left")
    halves = grid[2].subgridspec(2, 1)
    for row, scale in enumerate(examples.NODE_SCALES):
        panel = figure.add_subplot(halves[row])
        panel.set(ylabel="node certainty $1/E_i$", xlabel=rates, xlim=(0, 1), ylim=(1.5, 5.2))
        nodes = _coinciding([c for c in example.select("three_lines", NODE) if c.epsilon[0] == scale])
        _plot(panel, "r12", nodes, "agents", measured)
        panel.set_title(rf"({'ef'[row]}) $\epsilon$ = {scale:g}", loc="left")
    return figure


def _draw_3(example: Example, measured: Sequence[Measured]) -> Figure:
    figure = Figure(figsize=(WIDTH, 5.4), layout=ConstrainedLayoutEngine(hspace=0.04))
    letters = iter("abcdefghij")
    names = {"knife_edge": "Knife-edge pair", "smallest": "Smallest pair"}
    rows = figure.add_gridspec(2, 1)
    for row, network in enumerate(example.networks):
        grid = rows[row].subgridspec(2, 4, width_ratios=(0.62, 1, 1, 1))
        for mode, graph in enumerate(example.networks[network]):
            name = f"{names[network]}\n" if mode == 0 else ""
            _draw_network(figure.add_subplot(grid[mode, 0]), graph, f"{name}({next(letters)}) $G_{mode + 1}$")
        centrality, certainty, lead = (figure.add_subplot(grid[:, column]) for column in (1, 2, 3))
        central, certain = example.select(network, CENTRALITY), example.select(network, NODE)
        for axes in (centrality, certainty, lead):
            axes.set(xscale="log", xlim=(1e-2, 1e2), xlabel=r"$\epsilon = q_{12} = q_{21}$ [1/time]")
            axes.set_title(f"({next(letters)})", loc="left")
        named = ((centrality, central, "robustness centrality $1/E$"), (certainty, certain, "node certainty $1/E_i$"))
        for axes, curves, name in named:
            axes.set_ylabel(name)
            found = [point for c in curves for point in _on_curve(_agent(c), c, "epsilon", measured)]
            low = min([c.value.min() for c in curves] + [point.low for point in found])
            high = max([c.value.max() for c in curves] + [point.high for point in found])
            axes.set_ylim(low - 0.06 * (high - low), high + 0.36 * (high - low))
            _plot(axes, "epsilon", [(_agent(c), c) for c in curves], "agent", measured)
            orders = []
            for at in (0.1, 1.0, 10.0):
                order = examples.order(curves, int(np.abs(curves[0].epsilon - at).argmin()))
                orders.append("-".join(str(agent + 1) for agent in order) + rf" at $\epsilon$ = {at:g}")
            axes.text(0.03, 0.985, "\n".join(orders), transform=axes.transAxes, va="top", size=7, color=DARK_GREY)
        lead.set(ylabel="agent 1 above agent 3 [%]", ylim=(-2, 2))
        lead.set_yscale("symlog", linthresh=0.01, linscale=0.6)
        lead.set_yticks([-1, -0.1, -0.01, 0, 0.01, 0.1, 1], ["−1", "−0.1", "−0.01", "0", "0.01", "0.1", "1"])
        lead.yaxis.set_minor_locator(NullLocator())
        lead.axhline(0, color=DARK_GREY, lw=0.7, zorder=1)
        ahead = [
            (name, dataclasses.replace(curves[0], value=100 * (curves[0].value / curves[2].value - 1)))
            for name, curves in (("centrality", central), ("certainty", certain))
        ]
        _plot(lead, "epsilon", ahead, "in")
    return figure


def _plot(
    axes: Axes, swept: str, curves: Sequence[tuple[str, Curve]], heading: str, measured: Sequence[Measured] = ()
) -> None:
    """Curves over one of their rates, or measured points on them, and a legend; set the limits before."""
    logarithmic = axes.get_xscale() == "log"
    points = [_on_curve(label, curve, swept, measured) for label, curve in curves]
    ends = [end for found in points for point in found for end in (point.low, point.high)]
    axes.set_ylim(min([axes.get_ylim()[0], *ends]), max([axes.get_ylim()[1], *ends]))
    if ends and not logarithmic:  # room for points at the end of the curves
        axes.set_xlim(right=1.03 * max(getattr(curve, swept).max() for _, curve in curves))
    for number, (label, curve) in enumerate(curves):
        colour, dashes, marker = _LINES[number]
        every = (0.04 * (number + 1), 0.2)  # so that markers do not overlap
        (line,) = axes.plot(getattr(curve, swept), curve.value, color=colour, ls=dashes, label=label, markevery=every)
        line.set(marker="" if measured else marker, mec="white", mew=0.4)
        beside = 0.4 * _SIDE * (number - (len(curves) - 1) / 2) if logarithmic else 0.0
        _plot_points(axes, swept, points[number], colour, marker, beside)
    axes.legend(title=heading, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _on_curve(label: str, curve: Curve, swept: str, measured: Sequence[Measured]) -> list[Measured]:
    """The measured points on a curve, which may stand for several agents: ``label`` has their numbers."""
    held = [name for name in ("epsilon", "r12", "r21") if name != swept]
    agents = {None} if curve.agent is None else {int(number) - 1 for number in label.split(", ") if number.isdigit()}
    return [
        point
        for point in measured
        if (point.run.network, point.quantity) == (curve.network, curve.quantity)
        and point.agent in agents
        and all(np.isclose(getattr(curve, name), getattr(point.run, name)).all() for name in held)
    ]


def _plot_points(axes: Axes, swept: str, points: Sequence[Measured], colour: str, marker: str, beside: float) -> None:
    """Measured points with their intervals, and dashes for their predictions; shifted by ``beside`` [inches]."""
    for point in points:
        x = getattr(point.run, swept)
        # Side by side where several agents share a curve.
        here = [other for other in points if getattr(other.run, swept) == x]
        shift = beside + _SIDE * (here.index(point) - (len(here) - 1) / 2)
        place = axes.transData + mtransforms.ScaledTranslation(shift, 0, axes.figure.dpi_scale_trans)
        bars = axes.vlines(x, point.low, point.high, color=colour, lw=0.9, zorder=3)
        bars.set_transform(place)
        axes.plot(x, point.value, marker, color=colour, ms=3.8, mec="white", mew=0.4, zorder=4, transform=place)
        axes.plot(x, point.predicted, "_", color=BLACK, ms=4.5, mew=0.8, zorder=5, transform=place)


def _draw_network(axes: Axes, graph: Graph, title: str, *, reconstructed: bool = True) -> None:
    angles = np.pi / 2 - 2 * np.pi * np.arange(graph.agents) / graph.agents
    places = {agent: np.array([np.cos(angle), np.sin(angle)]) for agent, angle in enumerate(angles)}
    draw_graph(axes, graph, places, look.INK, size=110)
    for artist in axes.collections:
        artist.set_clip_on(False)
    axes.set_title("")
    axes.set_title(title, loc="left")
    axes.set_axis_off()
    if reconstructed:
        style: dict[str, Any] = {"size": 7, "color": DARK_GREY, "style": "italic", "ha": "center", "va": "top"}
        axes.text(0.5, 0.0, "reconstructed", transform=axes.transAxes, **style)


def _coinciding(curves: Sequence[Curve]) -> list[tuple[str, Curve]]:
    """Curves that are equal by symmetry, once, under the numbers of all their agents."""
    groups: list[list[Curve]] = []
    for curve in curves:
        alike = (group for group in groups if np.allclose(curve.value, group[0].value, rtol=1e-9))
        group = next(alike, None)
        if group is None:
            groups.append(group := [])
        group.append(curve)
    return [(", ".join(map(_agent, group)), group[0]) for group in groups]


def _agent(curve: Curve) -> str:
    """Number of a curve's agent, from 1."""
    return "" if curve.agent is None else str(curve.agent + 1)


def _rate(name: str) -> str:
    return f"$r_{{{name[1:]}}}$"
