"""Orderly handling of the signals that end a process: Ctrl-C, ``kill``, the end of the terminal."""

from __future__ import annotations

import signal
from types import TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Keeps the first signal until ``check``, as a context.

    An exception that a handler raises appears wherever the process is, and is lost where nothing can be raised, such as
    in a generator that is being closed or in a callback of an executor. SIGHUP stays ignored under ``nohup``.
    SIGINT does not: scripts ignore it for what they start in the background, and then end that by ``kill -INT``.
    """

    def __init__(self) -> None:
        self.caught: int | None = None  # number of the first signal
        self._handlers: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                self._handlers[number] = signal.signal(number, self._catch)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt after Ctrl-C, SystemExit after another signal."""
        if self.caught == signal.SIGINT:
            raise KeyboardInterrupt
        if self.caught is not None:
            raise SystemExit(128 + self.caught)

    def _catch(self, number: int, _: object) -> None:
        self.caught = self.caught or number
