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

"""View of a run while it goes on: a panel or lines on stderr, a page for browsers on request."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from msg_agents.processes.fork_server import Process
from msg_agents.watching.display import Display
from msg_agents.watching.run_observer import RunObserver
from msg_agents.watching.snapshot import SnapshotSource
from msg_agents.watching.terminal_panel import plain_line
from msg_agents.watching.view import View
from msg_analysis.common.text.notes import print_note
from msg_analysis.wire.topics import agent_name

if TYPE_CHECKING:
    from msg_agents.watching.web_server import WebServer
    from msg_analysis.model.experiment.experiment import ValidExperiment
    from msg_analysis.model.run.record import RunRecord

REFRESH = 0.25  # s between two updates
LINES = 10.0  # s between two lines where there is no terminal


class RunView(View):
    """Shows a run in all these ways; a context."""

    def __init__(self, experiment: ValidExperiment, web: WebServer | None = None, *, tells_domain: bool = True) -> None:
        from msg_analysis.common.text.safe_console import SafeConsole

        self._experiment, self._tells_domain = experiment, tells_domain
        self._console = SafeConsole(stderr=True)
        self.display = Display(self._console, web, panel=self._console.is_terminal, transient=True)
        self._source = SnapshotSource(experiment)
        self._observer: RunObserver | None = None
        self._made_observer = True  # and has to end it
        self._last_step = experiment.steps
        self._note: str | None = None
        self._begun = False
        self._shown, self._told = 0.0, time.monotonic()
        self._steps: Sequence[int] = ()
        self._processes: list[Process | None] = [None] * experiment.agents  # by agent; those of this host
        self._replaced: set[int] = set()  # agents that have got a new process since the last look

    def __enter__(self) -> Self:
        self.display.__enter__()
        self.look((), force=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
        self.display.__exit__(kind, error, trace)

    def note(self, line: str) -> None:
        """Print a note, above the panel; of a run that has begun, it is an event on the page."""
        print_note(line, self._console)
        if self._begun:
            self._source.happened(line)

    def joined(self, domain: int) -> None:
        """Say where the run is, for whoever wants to watch it."""
        if self._tells_domain or self.display.panel:
            self.note(f"ROS_DOMAIN_ID {domain}: to watch the run, msg-agents live --domain {domain}")

    def begin(self, record: RunRecord, checkpoints: Path | None, observer: RunObserver | None = None) -> None:
        """Follow the run: its processes have been started. Without ``checkpoints`` its errors are not followed."""
        self._begun = True
        self.display.begin(record.experiment)
        if not self.display.wanted:
            return  # lines do not show errors
        if observer is not None:
            self._observer, self._made_observer = observer, False
        elif checkpoints is None:
            self._note = "errors are not shown: the states are not kept (--restarts 0), or not on this host"
        else:
            self._observer = RunObserver(record, checkpoints)

    def started(self, processes: Mapping[str, Process]) -> None:
        """See View."""
        newest = [processes.get(agent_name(agent)) for agent in range(self._experiment.agents)]
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
        snapshot = self._source.snapshot(steps, report, note or self._note, self._ended())
        self.display.draw(snapshot, self._experiment)
        if not self.display.panel and now - self._told >= LINES and snapshot.reached >= 0:
            self._told = now
            self._console.print(plain_line(snapshot, self._experiment), soft_wrap=True, highlight=False, markup=False)

    def end(self) -> None:
        """Show the last numbers, and stop following the run."""
        if self._observer is not None:
            self._observer.look(min(self._steps, default=-1))
            if self._made_observer:
                self._observer.end()
            self.look(self._steps, force=True)
            self._observer = None
