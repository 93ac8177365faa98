"""Progress of long work on stderr: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import time
from types import TracebackType

_LINE_PERIOD = 10.0  # s between two lines where there is no terminal


class SweepProgress:
    """How far a sweep is, to be used with ``with``.

    Parameters
    ----------
    title
        what is being worked on
    """

    def __init__(self, title: str) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        console = Console(stderr=True, highlight=False, markup=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[failed]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._console = console
        self._title = title
        self._task = self._bar.add_task(title, total=None, failed="")
        self._told = time.monotonic()

    def __enter__(self) -> SweepProgress:
        self._bar.start()
        return self

    def checked(self, done: int, total: int) -> None:
        """So many of the points have been checked."""
        self.done(done, total, 0)

    def done(self, done: int, total: int, failed: int) -> None:
        """So many points are done, and so many of these failed; see ``Watch`` of ``msg_analysis.sweep.conduct``."""
        without = f"{failed} without a result" if failed else ""
        self._bar.update(self._task, completed=done, total=total, failed=without)
        if not self._console.is_terminal and time.monotonic() - self._told >= _LINE_PERIOD:
            self._told = time.monotonic()
            self._console.print(f"{self._title}: {done} of {total}{', ' if without else ''}{without}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


class SolveProgress:
    """How far a search is: a ``Watch`` of ``msg_analysis.theory.leader_search``, to be used with ``with``.

    Parameters
    ----------
    title
        what is being worked on
    """

    def __init__(self, title: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True, highlight=False, markup=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[best]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._console = console
        self._title = title
        self._task = self._bar.add_task(title, total=None, best="")
        self._told = time.monotonic()

    def __enter__(self) -> SolveProgress:
        self._bar.start()
        return self

    def __call__(self, stage: str, done: int, total: int, best: float) -> None:
        """Show a new state; see ``Watch``."""
        text = f"{self._title}: {stage}"
        self._bar.update(self._task, completed=done, total=total, description=text, best=f"E {best:.6g}")
        if not self._console.is_terminal and time.monotonic() - self._told >= _LINE_PERIOD:
            self._told = time.monotonic()
            self._console.print(f"{text}: {done} of {total}, least system error {best:.6g}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
