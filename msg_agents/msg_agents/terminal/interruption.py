"""Being asked to end by a signal: Ctrl-C, ``kill``, the end of the terminal."""

from __future__ import annotations

import signal
from types import TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Keeps signals until they are asked for, as a context.

    An exception that a handler raises comes up wherever the process is, and is lost where nothing can be raised: in a
    generator that is being closed, for example, or in a callback of an executor. SIGHUP stays ignored where ``nohup``
    has it so. SIGINT does not: a script that starts us in the background has it ignored, and then ends us by
    ``kill -INT``.

    Attributes
    ----------
    caught
        number of the first signal that came; None: none
    """

    def __init__(self) -> None:
        self.caught: int | None = None
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
        """End if a signal has asked for it.

        Raises
        ------
        KeyboardInterrupt
            by Ctrl-C
        SystemExit
            by another signal
        """
        if self.caught == signal.SIGINT:
            raise KeyboardInterrupt
        if self.caught is not None:
            raise SystemExit(128 + self.caught)

    def _catch(self, number: int, _: object) -> None:
        self.caught = self.caught or number
