"""A run on a terminal: progress, active graph, and errors beside the prediction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from msg_analysis.common.intervals import HALF_WIDTH_95

if TYPE_CHECKING:
    from msg_agents.watching.snapshot import Moment
    from msg_analysis.inference.errors.estimates import Estimate
    from msg_analysis.model.experiment.experiment import Experiment

COLOURS = (
    "blue",
    "yellow",
    "green",
    "magenta",
    "cyan",
    "red",
    "bright_yellow",
    "white",
)  # of graphs; names say the same
FIXED_LINES = 9  # of the panel besides the agents
FAR = 2.0  # standard errors
_LEGEND = "  ● measured ◆ predicted"


def show(moment: Moment, experiment: Experiment, *, width: int, height: int) -> RenderableType:
    """The panel, for a terminal of ``width`` by ``height`` characters."""
    agents = "1 agent" if experiment.agents == 1 else f"{experiment.agents} agents"
    title = Text(f"{experiment.name}: {agents}, {experiment.run.pace}", style="bold")
    if moment.reached < 0:
        waiting = "starting" if not moment.steps else "waiting for the first states"
        return Panel(Text(waiting), title=title, title_align="left")
    inside = max(width - 4, 20)
    lines: list[RenderableType] = [_progress(moment, experiment, inside), _graph(moment, experiment), Text()]
    lines += _system(moment, inside)
    room = height - FIXED_LINES
    if room >= 3:
        lines += [Text(), *_agents(moment, experiment, room)]
    return Panel(Group(*lines), title=title, title_align="left")


def plain_line(moment: Moment, experiment: Experiment) -> str:
    """The same as one line of text."""
    parts = [f"step {moment.reached} of {experiment.steps}", f"{moment.rate:.0f} steps/s"]
    if moment.sojourn is not None:
        parts.append(f"graph {experiment.graph_list[moment.sojourn.mode].name}")
    if moment.left is not None:
        parts.append(f"{_duration(moment.left)} left")
    return ", ".join(parts)


def _progress(moment: Moment, experiment: Experiment, width: int) -> RenderableType:
    share = moment.reached / experiment.steps
    text = f"step {moment.reached} of {experiment.steps}  {100 * share:.0f} %  {moment.rate:.0f} steps/s"
    if moment.left is not None:
        text += f"  {_duration(moment.left)} left"
    bar = ProgressBar(
        total=1.0, completed=share, width=max(width - len(text) - 2, 4), complete_style="cyan", finished_style="green"
    )
    line = Table.grid(padding=(0, 2, 0, 0))
    line.add_row(Text(text, no_wrap=True, overflow="ellipsis"), bar)
    return line if width > len(text) + 6 else Text(text, no_wrap=True, overflow="ellipsis")


def _graph(moment: Moment, experiment: Experiment) -> Text:
    text = Text("graph ", no_wrap=True, overflow="ellipsis")
    sojourn = moment.sojourn
    if sojourn is None:
        return text + Text("-")
    graph = experiment.graph_list[sojourn.mode]
    text.append(graph.name, style=f"bold {COLOURS[sojourn.mode % len(COLOURS)]}")
    now, dt = moment.reached, experiment.step_length
    # The end of the run cuts the last sojourn short.
    end = "the end" if sojourn.last_step == experiment.steps - 1 else f"{sojourn.last_step + 1}"
    held = (now - sojourn.first_step) * dt
    text.append(f"  for {held:.3g} units of time, steps {sojourn.first_step} to {end}, after {sojourn.sequence} jumps")
    return text


def _system(moment: Moment, width: int) -> list[RenderableType]:
    report = moment.report
    if report is None or report.system.measured is None:
        return [Text(moment.note or "system error: nothing yet", no_wrap=True, overflow="ellipsis"), Text()]
    system = report.system
    text = Text("system error ", no_wrap=True, overflow="ellipsis")
    text.append(f"{system.measured:.4g}", style="bold")
    if system.standard_error is not None:
        text.append(f" ± {HALF_WIDTH_95 * system.standard_error:.2g} (95 %)")
    if system.predicted is not None:
        text.append(f", predicted {system.predicted:.4g}")
    if system.z is not None:
        text.append(f", z {system.z:+.2f}", style="bold red" if abs(system.z) > 4 else "")
    if report.note:
        text.append(f"  {report.note}")
    return [text, gauge(system, min(width - len(_LEGEND), 60))]


def gauge(estimate: Estimate, width: int) -> Text:
    """The 95 % interval of an error, and its prediction, in ``width`` characters: ``├───●──◆───┤``."""
    measured, predicted, error = estimate.measured, estimate.predicted, estimate.standard_error
    if measured is None or predicted is None or not error or not math.isfinite(error) or width < 10:
        return Text()
    low, high = measured - HALF_WIDTH_95 * error, measured + HALF_WIDTH_95 * error
    left, right = min(low, predicted) - error, max(high, predicted) + error
    cells = [" "] * width

    def place(value: float) -> int:
        return min(max(int((value - left) / (right - left) * width), 0), width - 1)

    for cell in range(place(low), place(high) + 1):
        cells[cell] = "─"
    cells[place(low)], cells[place(high)], cells[place(measured)] = "├", "┤", "●"
    text = Text("".join(cells), no_wrap=True, overflow="crop", style="blue")
    at = place(predicted)
    together = at == place(measured)
    text.plain = text.plain[:at] + ("◉" if together else "◆") + text.plain[at + 1 :]
    text.stylize("bold yellow", at, at + 1)
    return text.append(_LEGEND, style="dim not bold default")


def _agents(moment: Moment, experiment: Experiment, room: int) -> list[RenderableType]:
    """One row per agent; of many, a summary and the rows that are furthest off, or slowest."""
    nodes = moment.report.nodes if moment.report else []
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("agent", "step", "steps/s", "error", "predicted", "z"):
        table.add_column(name, justify="right", no_wrap=True)
    order = list(range(experiment.agents))
    tail: list[RenderableType] = []
    if experiment.agents > room - 1:
        tail = [_summary(moment)]
        judged = any(node.z is not None for node in nodes)
        order.sort(key=lambda i: -abs(nodes[i].z or 0.0) if judged else moment.steps[i])
        order = order[: max(room - 3, 0)]
        tail.append(Text(f"above, the {'agents furthest off' if judged else 'slowest agents'}", style="dim"))
    for i in order:
        rate = f"{moment.rates[i]:.0f}" if moment.rates else "-"
        node = nodes[i] if i < len(nodes) else None
        numbers = ["-"] * 3 if node is None else [_number(node.measured), _number(node.predicted), _z(node.z)]
        style = "red" if node is not None and abs(node.z or 0.0) > 4 else ""
        table.add_row(str(i + 1), str(moment.steps[i]), rate, *numbers, style=style)
    return [table, *tail] if order else tail


def _summary(moment: Moment) -> Text:
    steps, rates = moment.steps, moment.rates
    text = f"{len(steps)} agents at steps {min(steps)} to {max(steps)}"
    if rates:
        text += f", {min(rates):.0f} to {max(rates):.0f} steps/s"
    judged = [abs(node.z) for node in (moment.report.nodes if moment.report else []) if node.z is not None]
    if judged:
        text += f"; {sum(z > FAR for z in judged)} errors are off by more than {FAR:g} standard errors"
    return Text(text, no_wrap=True, overflow="ellipsis")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _z(value: float | None) -> str:
    return "-" if value is None else f"{value:+.1f}"


def _duration(seconds: float) -> str:
    whole = math.ceil(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"
