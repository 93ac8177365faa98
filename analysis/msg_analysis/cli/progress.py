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

"""Progress of long work on stderr: a bar on a terminal, otherwise a line every ten seconds at most."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

from msg_analysis.common.text.number_words import duration_text

if TYPE_CHECKING:
    from rich.progress import Task
    from rich.text import Text

_LINE_PERIOD = 10.0  # s between two lines where there is no terminal
_SHORT = 2.0  # s of work of which nothing is shown
_REFRESH = 0.1  # s between two updates of a bar


class _Progress:
    """Progress display, a context manager."""

    def __init__(self, title: str, *, time_left: bool) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            ProgressColumn,
            TextColumn,
            TimeElapsedColumn,
        )
        from rich.text import Text

        from msg_analysis.common.text.safe_console import SafeConsole

        times = self._times

        class TimesColumn(ProgressColumn):
            def render(self, _: Task) -> Text:
                return Text(times())

        console = SafeConsole(stderr=True, highlight=False, markup=False)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimesColumn() if time_left else TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._console = console
        self._title = title
        self._task = self._bar.add_task(title, total=None, words="")
        self._time_left = time_left
        self._begun = self._told = time.monotonic()
        self._first: int | None = None  # done when the work began, by an earlier call for example
        self._newest = (0, 0, self._begun)  # done, of how many, when
        self._shown = 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def _times(self) -> str:
        """The time so far, and what is left at the mean speed so far, once it is known."""
        now = time.monotonic()
        text = f"{duration_text(now - self._begun)} so far"
        done, total, when = self._newest
        new = done - (self._first or 0)
        if new <= 0 or done >= total:
            return text
        left = (total - done) * (when - self._begun) / new - (now - when)
        return f"{text}, {duration_text(math.ceil(max(left, 0.0)))} left"

    def _show(self, title: str, done: int, total: int, words: str, in_short: str) -> None:
        if self._first is None:
            self._first = done
        self._newest = done, total, time.monotonic()
        self._bar.update(self._task, completed=done, total=total, description=title, words=in_short)
        if not self._console.is_terminal and time.monotonic() - self._told >= _LINE_PERIOD:
            self._told = time.monotonic()
            self._console.print(self._line(title, done, total, words))

    def _line(self, title: str, done: int, total: int, words: str) -> str:
        return ", ".join(filter(None, (f"{title}: {done} of {total}", words, self._times() if self._time_left else "")))

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


class WorkProgress(_Progress):
    """How far long work is, in percent: a ``common.long_work.Watch``, and a context manager; nothing in short work."""

    def __init__(self) -> None:
        super().__init__("", time_left=False)

    def __enter__(self) -> Self:
        return self

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show what is being done, and how much of it is done."""
        now = time.monotonic()
        if now - self._begun < _SHORT or now - self._shown < _REFRESH:
            return
        self._shown = now
        self._bar.start()
        self._show(what, 100 * done // max(total, 1), 100, "%", "%")

    def _line(self, title: str, done: int, total: int, words: str) -> str:  # noqa: ARG002  always of 100
        return f"{title}: {done} {words}"
