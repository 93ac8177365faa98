"""Being stopped and continued by a shell: Ctrl-Z, ``fg``, ``bg``."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self


class JobControl:
    """Puts things in order before the process is stopped by Ctrl-Z, and after it goes on, as a context.

    It does so when asked to ``check``, not in the handler: that might come in the middle of drawing, of which both are.

    Parameters
    ----------
    before
        called before it stops; not for SIGSTOP, of which no process hears
    after
        called when it goes on, in the foreground or in the background
    """

    def __init__(self, *, before: Callable[[], None], after: Callable[[], None]) -> None:
        self._before, self._after = before, after
        self._handlers: dict[signal.Signals, Any] = {}
        self._asked = self._resumed = self._continued = False

    def __enter__(self) -> Self:
        self._handlers[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._go_on)
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # otherwise somebody wants Ctrl-Z to be ignored
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._ask)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop, if that was asked for; put things in order, if the process has gone on. To be called often."""
        if self._asked:
            self._asked = False
            self._before()
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            signal.raise_signal(signal.SIGTSTP)  # here it stands: of one sent by kill, another thread may hear, later
            signal.signal(signal.SIGTSTP, self._ask)
            self._resumed = True  # also where the system did not stop it, since no shell could make it go on (setsid)
        if self._resumed:
            self._resumed = False
            self._after()

    def continued(self) -> bool:
        """Whether the process has been stopped, and gone on, since this was asked last."""
        was, self._continued = self._continued, False
        return was

    def _ask(self, *_: int | FrameType | None) -> None:
        self._asked = True

    def _go_on(self, *_: int | FrameType | None) -> None:
        self._continued = self._resumed = True
