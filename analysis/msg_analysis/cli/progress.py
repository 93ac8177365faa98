"""Progress of long work on stderr: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

_LINE_PERIOD = 10.0  # s between two lines where there is no terminal


class _Progress:
    """How far something is, to be used with ``with``."""

    def __init__(self, title: str, *, time_left: bool) -> None:
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
    """How far a sweep is, to be used with ``with``.

    Parameters
    ----------
    title
        what is being worked on
    """

    def __init__(self, title: str) -> None:
        super().__init__(title, time_left=True)

    def checked(self, done: int, total: int) -> None:
        """So many of the points have been checked.

        Parameters
        ----------
        done
            how many
        total
            of how many
        """
        self.done(done, total, 0)

    def done(self, done: int, total: int, failed: int) -> None:
        """So many points are done, and so many of these failed; see ``Watch`` of ``msg_analysis.sweep.conduct``.

        Parameters
        ----------
        done
            how many
        total
            of how many
        failed
            how many have no result
        """
        without = f"{failed} without a result" if failed else ""
        self._show(self._title, done, total, without, without)


class SolveProgress(_Progress):
    """How far a search is: a ``Watch`` of ``msg_analysis.theory.leaders.search``, to be used with ``with``.

    Parameters
    ----------
    title
        what is being worked on
    """

    def __init__(self, title: str) -> None:
        super().__init__(title, time_left=False)

    def __call__(self, stage: str, done: int, total: int, best: float) -> None:
        """Show a new state; see ``Watch``."""
        found = f"{best:.6g}"
        self._show(f"{self._title}: {stage}", done, total, f"least system error {found}", f"E {found}")
