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

"""Orderly handling of the signals that end a process: Ctrl-C, ``kill``, the end of the terminal."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from msg_analysis.common.exit_codes import killed_by

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def exit_on_signals() -> None:
    """Let SIGTERM and SIGHUP raise SystemExit from now on, as Ctrl-C raises KeyboardInterrupt."""

    def end(number: int, _: object) -> None:
        raise SystemExit(killed_by(number))

    for number in SIGNALS[1:]:
        if not _under_nohup(number):
            signal.signal(number, end)


def _under_nohup(number: signal.Signals) -> bool:
    """Whether the signal stays ignored; SIGINT does not.

    Scripts ignore SIGINT for what they start in the background, and then end that by ``kill -INT``.
    """
    return number != signal.SIGINT and signal.getsignal(number) is signal.SIG_IGN


def raise_for(number: int | None) -> None:
    """Raise KeyboardInterrupt for Ctrl-C, SystemExit for another signal; nothing for None."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    if number is not None:
        raise SystemExit(killed_by(number))


class Interruption:
    """Keeps the first signal until somebody asks for it: from ``keep`` to ``end``, or as a context.

    An exception that a handler raises is lost in a generator that is being closed, or in a callback of an executor.
    """

    def __init__(self) -> None:
        self.caught: int | None = None  # number of the first signal
        self._handlers: dict[signal.Signals, Any] = {}

    def keep(self) -> None:
        """Keep signals from now on."""
        for number in SIGNALS:
            if number not in self._handlers and not _under_nohup(number):
                self._handlers[number] = signal.signal(number, self._catch)

    def end(self) -> None:
        """Keep no more signals."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    def __enter__(self) -> Self:
        self.keep()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    @contextmanager
    def let_through(self) -> Iterator[None]:
        """Let signals raise their exceptions in here, the one that was kept at once."""
        kept = bool(self._handlers)
        self.end()
        try:
            self.check()
            yield
        finally:
            if kept:
                self.keep()

    def take(self) -> int | None:
        """The number of the kept signal, which is then kept no more."""
        number, self.caught = self.caught, None
        return number

    def check(self) -> None:
        """Raise KeyboardInterrupt after Ctrl-C, SystemExit after another signal."""
        raise_for(self.take())

    def _catch(self, number: int, _: object) -> None:
        self.caught = self.caught or number
