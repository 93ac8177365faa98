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
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from msg_agents.watching.display import Display
from msg_agents.watching.run_observer import RunObserver
from msg_agents.watching.snapshot import SnapshotSource
from msg_agents.watching.terminal_panel import plain_line
from msg_agents.watching.view import View
from msg_analysis.common.text.notes import print_note

if TYPE_CHECKING:
    from msg_agents.watching.web_server import WebServer
    from msg_analysis.model.experiment.experiment import ValidExperiment
    from msg_analysis.model.run.record import RunRecord

REFRESH = 0.25  # s between two updates
LINES = 10.0  # s between two lines where there is no terminal


class RunView(View):
    """Shows a run in all these ways; a context."""

    def __init__(self, experiment: ValidExperiment, web: WebServer | None = None) -> None:
        from msg_analysis.common.text.safe_console import SafeConsole

        self._experiment = experiment
        self._console = SafeConsole(stderr=True)
        self.display = Display(self._console, web, panel=self._console.is_terminal, transient=True)
        self._source = SnapshotSource(experiment)
        self._observer: RunObserver | None = None
        self._note: str | None = None
        self._shown, self._told = 0.0, time.monotonic()
        self._steps: Sequence[int] = ()

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
        """Print a note, above the panel."""
        print_note(line, self._console)

    def begin(self, record: RunRecord, checkpoints: Path | None) -> None:
        """Follow the run: its processes have been started. Without ``checkpoints`` its errors are not followed."""
        self.display.begin(record.experiment)
        if not self.display.wanted:
            return  # lines do not show errors
        if checkpoints is None:
            self._note = "errors are not shown: the states are not kept (--restarts 0), or not on this host"
        else:
            self._observer = RunObserver(record, checkpoints)

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
        snapshot = self._source.snapshot(steps, report, note or self._note)
        self.display.draw(snapshot, self._experiment)
        if not self.display.panel and now - self._told >= LINES and snapshot.reached >= 0:
            self._told = now
            self._console.print(plain_line(snapshot, self._experiment), soft_wrap=True, highlight=False, markup=False)

    def end(self) -> None:
        """Show the last numbers, and stop following the run."""
        if self._observer is not None:
            self._observer.look(min(self._steps, default=-1))
            self._observer.end()
            self.look(self._steps, force=True)
            self._observer = None
