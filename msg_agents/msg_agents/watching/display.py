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

"""Where snapshots are drawn: a panel on a terminal, a page for browsers on request."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from msg_agents.terminal.job_control import JobControl
from msg_agents.watching.snapshot import Snapshot, run_description, snapshot_document
from msg_agents.watching.terminal_panel import panel_of

if TYPE_CHECKING:
    from rich.console import Console

    from msg_agents.watching.web_server import WebServer
    from msg_analysis.model.experiment.experiment import ValidExperiment


class Display:
    """Draws snapshots, as a context; ``panel``: whether on ``console``. It stays there unless it is ``transient``."""

    def __init__(self, console: Console, web: WebServer | None, *, panel: bool, transient: bool) -> None:
        from rich.live import Live

        self.panel = panel
        self._console, self._web = console, web
        self._document: dict[str, Any] | None = None  # the newest on the page
        # No thread: ``draw`` refreshes it.
        self._live = Live(console=console, auto_refresh=False, transient=transient, vertical_overflow="crop")
        self._jobs = JobControl(before=self._live.stop, after=lambda: self._live.start(refresh=True))

    def __enter__(self) -> Self:
        if self.panel:
            self._live.start()
            self._jobs.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.panel:
            self._jobs.__exit__(kind, error, trace)
            self._live.stop()

    @property
    def wanted(self) -> bool:
        """Whether anything is drawn."""
        return self.panel or self._web is not None

    def begin(self, experiment: ValidExperiment) -> None:
        """Give the page what does not change in a run."""
        if self._web is not None:
            self._web.begin(run_description(experiment))

    def check(self) -> None:
        """Stop if Ctrl-Z was typed; to be called often."""
        if self.panel:
            self._jobs.check()

    def draw(self, snapshot: Snapshot, experiment: ValidExperiment) -> None:
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
