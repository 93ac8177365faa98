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
from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.report.figures.palette import shorten
from msg_analysis.report.terminal.live_text import any_time_text, coverage, error_text

if TYPE_CHECKING:
    from msg_agents.watching.snapshot import Snapshot
    from msg_analysis.inference.errors.estimates import Estimate
    from msg_analysis.model.experiment.experiment import ValidExperiment

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
FIXED_LINES = 10  # of the panel besides the agents
FAR = 2.0  # standard errors
_LEGEND = "  ● measured ◆ predicted"


def panel_of(snapshot: Snapshot, experiment: ValidExperiment, *, width: int, height: int) -> RenderableType:
    """The panel, for a terminal of ``width`` by ``height`` characters."""
    agents = "1 agent" if experiment.agents == 1 else f"{experiment.agents} agents"
    title = Text(f"{experiment.name}: {agents}, {experiment.run.pace}", style="bold")
    if snapshot.reached < 0:
        waiting = "starting" if not snapshot.steps else "waiting for the first states"
        return Panel(Text(waiting), title=title, title_align="left")
    inside = max(width - 4, 20)
    lines: list[RenderableType] = [_progress(snapshot, experiment, inside), _graph(snapshot, experiment)]
    lines.append(_coverage(snapshot, experiment))
    lines += _system(snapshot, inside)
    room = height - FIXED_LINES
    if room >= 3:
        lines += [Text(), *_agents(snapshot, experiment, room)]
    return Panel(Group(*lines), title=title, title_align="left")


def plain_line(snapshot: Snapshot, experiment: ValidExperiment) -> str:
    """The same as one line of text."""
    parts = [f"step {snapshot.reached} of {snapshot.last or experiment.steps}", *_speed(snapshot)]
    if snapshot.sojourn is not None:
        parts.append(f"graph {experiment.graph_list[snapshot.sojourn.mode].name}")
    if snapshot.left is not None:
        parts.append(f"{_duration(snapshot.left)} left")
    return ", ".join(parts)


def _speed(snapshot: Snapshot) -> list[str]:
    """The speed, where it is known."""
    return [] if snapshot.rate is None else [f"{snapshot.rate:.0f} steps/s"]


def _progress(snapshot: Snapshot, experiment: ValidExperiment, width: int) -> RenderableType:
    last = snapshot.last or experiment.steps
    share = snapshot.reached / last
    parts = [f"step {snapshot.reached} of {last}", f"{100 * share:.0f} %", *_speed(snapshot)]
    if snapshot.left is not None:
        parts.append(f"{_duration(snapshot.left)} left")
    text = "  ".join(parts)
    bar = ProgressBar(
        total=1.0, completed=share, width=max(width - len(text) - 2, 4), complete_style="cyan", finished_style="green"
    )
    line = Table.grid(padding=(0, 2, 0, 0))
    line.add_row(Text(text, no_wrap=True, overflow="ellipsis"), bar)
    return line if width > len(text) + 6 else Text(text, no_wrap=True, overflow="ellipsis")


def _graph(snapshot: Snapshot, experiment: ValidExperiment) -> Text:
    text = Text("graph ", no_wrap=True, overflow="ellipsis")
    sojourn = snapshot.sojourn
    if sojourn is None:
        return text + Text("-")
    graph = experiment.graph_list[sojourn.mode]
    text.append(graph.name, style=f"bold {COLOURS[sojourn.mode % len(COLOURS)]}")
    now, dt = snapshot.reached, experiment.step_length
    # The end of the run cuts the last sojourn short.
    end = "the end" if sojourn.last_step >= (snapshot.last or experiment.steps) - 1 else f"{sojourn.last_step + 1}"
    held = (now - sojourn.first_step) * dt
    text.append(f"  for {held:.3g} units of time, steps {sojourn.first_step} to {end}, after {sojourn.sequence} jumps")
    return text


def _coverage(snapshot: Snapshot, experiment: ValidExperiment) -> Text:
    """What the errors below are computed from."""
    report = snapshot.report
    if report is None or not report.steps:
        return Text()
    text = f"simulated time {snapshot.reached * experiment.step_length:g}, errors of {', '.join(coverage(report))}"
    return Text(text, style="dim", no_wrap=True, overflow="ellipsis")


def _system(snapshot: Snapshot, width: int) -> list[RenderableType]:
    report = snapshot.report
    if report is None or report.system.measured is None:
        return [Text(snapshot.note or "system error: no data yet", no_wrap=True, overflow="ellipsis"), Text(), Text()]
    system = report.system
    style = "bold red" if abs(system.z or 0.0) > 4 else ""
    text = Text(f"system error {error_text(system)}", style=style, no_wrap=True, overflow="ellipsis")
    if snapshot.note:
        text.append(f"  {snapshot.note}")
    seen = report.any_time
    any_time = Text(any_time_text(report), style="bold red" if seen.crossed else "", no_wrap=True, overflow="ellipsis")
    return [text, gauge(system, min(width - len(_LEGEND), 60)), any_time]


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


def _agents(snapshot: Snapshot, experiment: ValidExperiment, room: int) -> list[RenderableType]:
    """One row per agent; of many, a summary and the rows that are furthest off, or slowest."""
    nodes = snapshot.report.nodes if snapshot.report else []
    steps_known = len(snapshot.steps) == experiment.agents
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("agent", *(("step", "steps/s") if steps_known else ()), "error", "± 95 %", "predicted", "z"):
        table.add_column(name, justify="right", no_wrap=True)
    order = list(range(experiment.agents))
    tail: list[RenderableType] = []
    if experiment.agents > room - 1:
        judged = any(node.z is not None for node in nodes)
        if judged:
            order.sort(key=lambda i: -abs(nodes[i].z or 0.0))
        elif steps_known:
            order.sort(key=lambda i: snapshot.steps[i])
        order = order[: max(room - 3, 0)]
        which = "agents with the largest |z|" if judged else "slowest agents" if steps_known else "first agents"
        tail = [_summary(snapshot, experiment), Text(f"above: the {which}", style="dim")]
    for i in order:
        cells = [shorten(agent_name(i + 1, experiment.names))]
        if steps_known:
            cells += [str(snapshot.steps[i]), f"{snapshot.rates[i]:.0f}" if snapshot.rates else "-"]
        node = nodes[i] if nodes else None
        cells += _errors(node) if node else ["-"] * 4
        table.add_row(*map(Text, cells), style="red" if node and abs(node.z or 0.0) > 4 else "")
    return [table, *tail] if order else tail


def _summary(snapshot: Snapshot, experiment: ValidExperiment) -> Text:
    steps, rates = snapshot.steps, snapshot.rates
    text = f"{experiment.agents} agents at step"
    text += f"s {min(steps)} to {max(steps)}" if len(steps) > 1 else f" {steps[0]}"
    if len(rates) > 1:
        text += f", {min(rates):.0f} to {max(rates):.0f} steps/s"
    judged = [abs(node.z) for node in (snapshot.report.nodes if snapshot.report else []) if node.z is not None]
    if judged:
        text += f"; {sum(z > FAR for z in judged)} differ from the prediction by more than {FAR:g} standard errors"
    return Text(text, no_wrap=True, overflow="ellipsis")


def _errors(node: Estimate) -> list[str]:
    half = None if node.standard_error is None else HALF_WIDTH_95 * node.standard_error
    numbers = ((node.measured, ".4g"), (half, ".2g"), (node.predicted, ".4g"), (node.z, "+.1f"))
    return ["-" if value is None else f"{value:{form}}" for value, form in numbers]


def _duration(seconds: float) -> str:
    whole = math.ceil(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"
