"""View of a run while it goes on: a panel on a terminal, lines elsewhere, a page for browsers on request."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from msg_agents.terminal.job_control import JobControl
from msg_agents.watching.run_observer import Observer
from msg_agents.watching.snapshot import Clockwork, moment_document, setting
from msg_agents.watching.terminal_panel import plain_line, show
from msg_agents.watching.view import View
from msg_analysis.common.notes import print_note

if TYPE_CHECKING:
    from msg_agents.watching.web_server import Web
    from msg_analysis.model.experiment.experiment import Experiment
    from msg_analysis.model.run.record import RunRecord

REFRESH = 0.25  # s between two updates
LINES = 10.0  # s between two lines where there is no terminal


class RunView(View):
    """Shows a run in all these ways; a context."""

    def __init__(self, experiment: Experiment, web: Web | None = None) -> None:
        from rich.console import Console
        from rich.live import Live

        self._experiment, self._web = experiment, web
        self._console = Console(stderr=True)
        self._terminal = self._console.is_terminal
        # No thread: ``look`` refreshes it.
        self._live = Live(console=self._console, auto_refresh=False, transient=True, vertical_overflow="crop")
        self._jobs = JobControl(before=self._live.stop, after=lambda: self._live.start(refresh=True))
        self._clockwork = Clockwork(experiment)
        self._observer: Observer | None = None
        self._note: str | None = None
        self._shown, self._told = 0.0, time.monotonic()
        self._steps: Sequence[int] = ()

    def __enter__(self) -> Self:
        if self._terminal:
            self._live.start()
            self._jobs.__enter__()
            self.look((), force=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
        if self._terminal:
            self._jobs.__exit__(kind, error, trace)
            self._live.stop()

    def note(self, line: str) -> None:
        """Print a note, above the panel."""
        print_note(line, self._console)

    def begin(self, record: RunRecord, checkpoints: Path | None) -> None:
        """Follow the run: its processes have been started. Without ``checkpoints`` its errors are not followed."""
        if self._web is not None:
            self._web.begin(setting(record.experiment))
        if not self._terminal and self._web is None:
            return  # lines do not show errors
        if checkpoints is None:
            self._note = "errors are not followed here: the states are not kept (--restarts 0), or not on this host"
        else:
            self._observer = Observer(record, checkpoints)

    def look(self, steps: Sequence[int], *, force: bool = False) -> None:
        """Show the newest step of every agent (-1: none; empty before the start), every ``REFRESH`` s or if forced."""
        if self._terminal:
            self._jobs.check()
        self._steps = steps
        if self._observer is not None:
            self._observer.look(min(steps, default=-1))
        now = time.monotonic()
        if now - self._shown < REFRESH and not force:
            return
        self._shown = now
        observer = self._observer
        moment = self._clockwork.moment(
            steps, observer.report if observer else None, (observer.note if observer else None) or self._note
        )
        if self._terminal:
            size = self._console.size
            self._live.update(show(moment, self._experiment, width=size.width, height=size.height), refresh=True)
        elif now - self._told >= LINES and moment.reached >= 0:
            self._told = now
            self._console.print(plain_line(moment, self._experiment), soft_wrap=True, highlight=False, markup=False)
        if self._web is not None:
            self._web.show(moment_document(moment))

    def end(self) -> None:
        """Show the last numbers, and stop following the run."""
        if self._observer is not None:
            self._observer.look(min(self._steps, default=-1))
            self._observer.end()
            self.look(self._steps, force=True)
            self._observer = None

    def say(self, words: dict[str, Any]) -> None:
        """Tell the page how the run ended."""
        if self._web is not None:
            self._web.end(words)
