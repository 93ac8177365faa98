# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The panel in the terminal."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from msg_agents.process_layout import Process
from msg_agents.terminal import JobControl
from msg_agents.watch.observer import RunObserver
from msg_agents.watch.snapshot import Snapshot, SnapshotSource, run_description, snapshot_document
from msg_analysis.common.console import print_note
from msg_analysis.common.text import HALF_WIDTH_95, agent_name
from msg_analysis.messages.topics import agent_node_name
from msg_analysis.model.run_record import RunRecord
from msg_analysis.report.look import shorten

if TYPE_CHECKING:
    from rich.console import Console

    from msg_agents.watch.web_server import WebServer
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.inference.estimates import Estimate


class View:
    """Follows a run; the thread that runs the network calls all methods. This one hands on steps and notes."""

    def __init__(self, on_progress: Callable[[int], None], on_note: Callable[[str], None]) -> None:
        self._on_progress, self._on_note = on_progress, on_note

    def joined(self, domain: int) -> None:
        """The run is in this ROS_DOMAIN_ID, and nothing has been started yet."""

    def begin(self, record: RunRecord, checkpoints: Path | None, observer: RunObserver | None = None) -> None:
        """The processes have been started; ``checkpoints``: of the agents; ``observer``: follows the run already."""

    def ends_at(self, step: int) -> None:
        """The run ends at this step, before its planned end."""

    def started(self, processes: Mapping[str, Process]) -> None:
        """The processes, by the names of their nodes; again after each restart."""

    def look(self, steps: Sequence[int]) -> None:
        """The newest step of every agent (-1: none; empty before the start), about 20 times a second."""
        if (reached := min(steps, default=-1)) >= 0:
            self._on_progress(reached)

    def note(self, line: str) -> None:
        """A line of text about a restart or stall."""
        self._on_note(line)

    def end(self) -> None:
        """The run is over; its processes may still be there."""


COLOURS = ("blue", "yellow", "green", "magenta", "cyan", "red", "bright_yellow", "white")  # of graphs, beside names
FIXED_LINES = 10  # of the panel besides the agents
FAR = 2.0  # standard errors
_LEGEND = "  ● measured ◆ predicted"


def panel_of(snapshot: Snapshot, experiment: Experiment, *, width: int, height: int) -> RenderableType:
    """The panel, for a terminal of ``width`` by ``height`` characters."""
    agents = "1 agent" if experiment.agents == 1 else f"{experiment.agents} agents"
    pace = "real time, predicted for sequential steps" if experiment.run.pace == "realtime" else "lockstep"
    title = Text(f"{experiment.name}: {agents}, {pace}", style="bold")
    if snapshot.reached < 0:
        waiting = "starting" if not snapshot.steps else "waiting for the first states"
        return Panel(Text(waiting), title=title, title_align="left")
    inside = max(width - 4, 20)
    lines = [_progress(snapshot, experiment, inside), _graph(snapshot, experiment), _coverage(snapshot, experiment)]
    if snapshot.warning:
        lines.append(Text(snapshot.warning, style="bold yellow", no_wrap=True, overflow="ellipsis"))
    lines += _system(snapshot, inside)
    room = height - FIXED_LINES
    if room >= 3:
        lines += [Text(), *_agents(snapshot, experiment, room)]
    return Panel(Group(*lines), title=title, title_align="left")


def plain_line(snapshot: Snapshot, experiment: Experiment) -> str:
    """The same as one line of text."""
    graph = "" if snapshot.holding is None else f"graph {experiment.graph_list[snapshot.holding.mode].name}"
    return ", ".join(_parts(snapshot, experiment, graph))


def _parts(snapshot: Snapshot, experiment: Experiment, more: str) -> list[str]:
    """How far the run is, as far as it is known."""
    left = "" if snapshot.left is None else f"{_duration(snapshot.left)} left"
    speed = "" if snapshot.rate is None else f"{snapshot.rate:.0f} steps/s"
    step = f"step {snapshot.reached} of {snapshot.last or experiment.steps}"
    return [part for part in (step, speed, more, left) if part]


def _progress(snapshot: Snapshot, experiment: Experiment, width: int) -> RenderableType:
    fraction = snapshot.reached / (snapshot.last or experiment.steps)
    step, *rest = _parts(snapshot, experiment, "")
    text = "  ".join([step, f"{100 * fraction:.0f} %", *rest])
    line = Text(text, no_wrap=True, overflow="ellipsis")
    if width <= len(text) + 6:
        return line
    room = max(width - len(text) - 2, 4)
    bar = ProgressBar(1.0, fraction, room, complete_style="cyan", finished_style="green")
    row = Table.grid(padding=(0, 2, 0, 0))
    row.add_row(line, bar)
    return row


def _graph(snapshot: Snapshot, experiment: Experiment) -> Text:
    text = Text("graph ", no_wrap=True, overflow="ellipsis")
    holding = snapshot.holding
    if holding is None:
        return text + Text("-")
    graph = experiment.graph_list[holding.mode]
    text.append(graph.name, style=f"bold {COLOURS[holding.mode % len(COLOURS)]}")
    now, dt = snapshot.reached, experiment.step_length
    # The end of the run cuts the last holding period short.
    end = "the end" if holding.last_step >= (snapshot.last or experiment.steps) - 1 else f"{holding.last_step + 1}"
    held = (now - holding.first_step) * dt
    text.append(f"  for {held:.3g} units of time, steps {holding.first_step} to {end}, after {holding.sequence} jumps")
    return text


def _coverage(snapshot: Snapshot, experiment: Experiment) -> Text:
    report = snapshot.report
    if report is None or not report.steps:
        return Text()
    from msg_analysis.report.comparison_text import coverage  # takes as long to import as a network to start

    text = f"simulated time {snapshot.reached * experiment.step_length:g}, errors of {', '.join(coverage(report))}"
    return Text(text, style="dim", no_wrap=True, overflow="ellipsis")


def _system(snapshot: Snapshot, width: int) -> list[RenderableType]:
    report = snapshot.report
    if report is None or report.system.measured is None:
        return [Text(snapshot.note or "system error: no data yet", no_wrap=True, overflow="ellipsis"), Text(), Text()]
    from msg_analysis.report.comparison_text import any_time_text, error_text

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


def _agents(snapshot: Snapshot, experiment: Experiment, room: int) -> list[RenderableType]:
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
        cells = [shorten(agent_name(i + 1, experiment.names)) + (" (external)" if i in experiment.external else "")]
        if steps_known:
            cells += [str(snapshot.steps[i]), f"{snapshot.rates[i]:.0f}" if snapshot.rates else "-"]
        node = nodes[i] if nodes else None
        cells += _errors(node) if node else ["-"] * 4
        table.add_row(*map(Text, cells), style="red" if node and abs(node.z or 0.0) > 4 else "")
    return [table, *tail] if order else tail


def _summary(snapshot: Snapshot, experiment: Experiment) -> Text:
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


class Display:
    """Draws snapshots, as a context; ``panel``: whether on ``console``. It stays there unless it is ``transient``."""

    def __init__(self, console: Console, web: WebServer | None, *, panel: bool, transient: bool) -> None:
        from rich.live import Live

        self.panel = panel
        self._console, self._web = console, web
        self._document: dict[str, Any] | None = None  # the newest on the page
        self._description: threading.Thread | None = None  # gives the page what does not change
        # No thread: ``draw`` refreshes it.
        self._live = Live(console=console, auto_refresh=False, transient=transient, vertical_overflow="crop")
        self._jobs = JobControl(before=self._live.stop, after=lambda: self._live.start(refresh=True))

    def __enter__(self) -> Self:
        if self.panel:
            self._live.start()
            self._jobs.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self.panel:
            self._jobs.__exit__(*_)
            self._live.stop()
        if self._description is not None:
            self._description.join()

    def begin(self, experiment: Experiment) -> bool:
        """Give the page what does not change in a run; whether anything is drawn."""
        if (web := self._web) is not None:
            # What it imports can take seconds beside a network that starts, which has to be watched meanwhile.
            self._description = threading.Thread(target=lambda: web.begin(run_description(experiment)), daemon=True)
            self._description.start()
        return self.panel or self._web is not None

    def check(self) -> None:
        """Stop if Ctrl-Z was typed; to be called often."""
        if self.panel:
            self._jobs.check()

    def draw(self, snapshot: Snapshot, experiment: Experiment) -> None:
        """Draw a snapshot in place of the last one."""
        if self.panel:
            size = self._console.size
            self._live.update(panel_of(snapshot, experiment, width=size.width, height=size.height), refresh=True)
        if self._web is not None:
            self._document = snapshot_document(snapshot, self._document)
            self._web.show(self._document)

    def end(self, words: dict[str, Any], report: Path | None = None) -> None:
        """Tell the page how the run ended: "text", and "verdict" or None; it gets the report, too."""
        if self._web is not None:
            self._web.end(words, report)


REFRESH = 0.25  # s between two updates
LINES = 10.0  # s between two lines where there is no terminal


class RunView(View):
    """Shows a run in all these ways; a context."""

    def __init__(self, experiment: Experiment, web: WebServer | None = None, *, prints_domain: bool = True) -> None:
        from msg_analysis.common.console import SafeConsole

        self._experiment, self._prints_domain = experiment, prints_domain
        self._console = SafeConsole(stderr=True)
        self.display = Display(self._console, web, panel=self._console.is_terminal, transient=True)
        self._source = SnapshotSource(experiment)
        self._observer: RunObserver | None = None
        self._made_observer = True  # and has to end it
        self._last_step = experiment.steps
        self._note: str | None = None
        self._begun = False
        self._shown, self._printed = 0.0, time.monotonic()
        self._steps: Sequence[int] = ()
        self._processes: list[Process | None] = [None] * experiment.agents  # by agent; those of this host
        self._replaced: set[int] = set()  # agents that have got a new process since the last look

    def __enter__(self) -> Self:
        self.display.__enter__()
        self.look((), force=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self.display.__exit__(*_)

    def note(self, line: str) -> None:
        """Print a note, above the panel; of a run that has begun, it is an event on the page."""
        print_note(line, self._console)
        if self._begun:
            self._source.happened(line)

    def joined(self, domain: int) -> None:
        """Say where the run is, for whoever wants to watch it."""
        if self._prints_domain or self.display.panel:
            self.note(f"ROS_DOMAIN_ID {domain}: to watch the run, msg-agents live --domain {domain}")

    def begin(self, record: RunRecord, checkpoints: Path | None, observer: RunObserver | None = None) -> None:
        """Follow the run: its processes have been started. Without ``checkpoints`` its errors are not followed."""
        self._begun = True
        if not self.display.begin(record.experiment):
            return  # lines do not show errors
        if observer is not None:
            self._observer, self._made_observer = observer, False
        elif checkpoints is None:
            self._note = "errors are not shown: the states are not kept (--restarts 0), or not on this host"
        else:
            self._observer = RunObserver(record, checkpoints)

    def started(self, processes: Mapping[str, Process]) -> None:
        """See View."""
        newest = [processes.get(agent_node_name(agent)) for agent in range(self._experiment.agents)]
        for agent, (old, new) in enumerate(zip(self._processes, newest, strict=True)):
            if old is not None and old is not new:
                self._replaced.add(agent)
        self._processes = newest

    def ends_at(self, step: int) -> None:
        """See View."""
        self._last_step = step
        self._source.ends_at(step)

    def _ended(self) -> set[int]:
        """Agents whose process has ended before its last step, or had to be replaced."""
        last, replaced, self._replaced = self._last_step, self._replaced, set()
        return replaced.union(
            agent
            for agent, (process, step) in enumerate(zip(self._processes, self._steps, strict=False))
            if process is not None and step < last and process.poll() is not None
        )

    def look(self, steps: Sequence[int], *, force: bool = False) -> None:
        """Show the newest step of every agent (-1: none; empty before the start), every ``REFRESH`` s or if forced."""
        self.display.check()
        self._steps = steps
        observer = self._observer
        if observer is not None:
            observer.look(min(steps, default=-1))
        now = time.monotonic()
        if now - self._shown < REFRESH and not force:
            return
        self._shown = now
        report, note = (observer.report, observer.note) if observer else (None, None)
        if observer and self._source.silent():
            report = observer.beside(steps)
        pids = {i: process.pid for i, process in enumerate(self._processes) if process is not None}
        snapshot = self._source.snapshot(steps, report, note or self._note, self._ended(), pids)
        self.display.draw(snapshot, self._experiment)
        if not self.display.panel and now - self._printed >= LINES and snapshot.reached >= 0:
            self._printed = now
            self._console.print(plain_line(snapshot, self._experiment), soft_wrap=True, highlight=False, markup=False)

    def end(self) -> None:
        """Show the last numbers, and stop following the run."""
        if self._observer is not None:
            self._observer.look(min(self._steps, default=-1))
            if self._made_observer:
                self._observer.end()
            self.look(self._steps, force=True)
            self._observer = None
