"""Progress of long work on stderr: a bar on a terminal, otherwise a line every ten seconds at most."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

_LINE_PERIOD = 10.0  # s between two lines where there is no terminal


class _Progress:
    """Progress display, a context manager."""

    def __init__(self, title: str, *, time_left: bool) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        from msg_analysis.common.text.safe_console import SafeConsole

        console = SafeConsole(stderr=True, highlight=False, markup=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimeElapsedColumn(),
            *((TextColumn("left"), TimeRemainingColumn()) if time_left else ()),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._console = console
        self._title = title
        self._task = self._bar.add_task(title, total=None, words="")
        self._told = time.monotonic()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def _show(self, title: str, done: int, total: int, words: str, in_short: str) -> None:
        self._bar.update(self._task, completed=done, total=total, description=title, words=in_short)
        if not self._console.is_terminal and time.monotonic() - self._told >= _LINE_PERIOD:
            self._told = time.monotonic()
            self._console.print(f"{title}: {done} of {total}{', ' if words else ''}{words}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


class SweepProgress(_Progress):
    """Progress of a sweep, a context manager."""

    def __init__(self, title: str) -> None:
        super().__init__(title, time_left=True)

    def checked(self, done: int, total: int) -> None:
        """Show how many of the points have been checked."""
        self.done(done, total, 0)

    def done(self, done: int, total: int, failed: int) -> None:
        """Show how many points are done, and how many of these failed; a ``SweepProgress`` of ``sweep.conduct``."""
        without = f"{failed} without a result" if failed else ""
        self._show(self._title, done, total, without, without)


class SolveProgress(_Progress):
    """Progress of a search: a ``SearchProgress`` of ``theory.leaders.search``, and a context manager."""

    def __init__(self, title: str) -> None:
        super().__init__(title, time_left=False)

    def __call__(self, stage: str, done: int, total: int, best: float) -> None:
        """Show stage, evaluations done and to do, and the smallest system error so far; see ``SearchProgress``."""
        found = f"{best:.6g}"
        self._show(f"{self._title}: {stage}", done, total, f"smallest system error {found}", f"E {found}")
