"""Being stopped and continued by a shell: Ctrl-Z, ``fg``, ``bg``."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self


class JobControl:
    """Puts things in order before the process is stopped by Ctrl-Z, and after it goes on, as a context.

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
        self._continued = self._standing = False

    def __enter__(self) -> Self:
        self._handlers[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._go_on)
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # otherwise somebody wants Ctrl-Z to be ignored
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def continued(self) -> bool:
        """Whether the process has been stopped, and gone on, since this was asked last."""
        was, self._continued = self._continued, False
        return was

    def _stop(self, *_: int | FrameType | None) -> None:
        self._before()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        self._standing = True
        signal.raise_signal(signal.SIGTSTP)  # here it stands: of one sent by kill, another thread may hear, and later
        self._be_ready()
        if self._standing:  # no shell could make it go on again (setsid), so the system did not stop it
            self._standing = False
            self._after()

    def _go_on(self, *_: int | FrameType | None) -> None:
        self._continued, self._standing = True, False
        self._be_ready()  # first: the next Ctrl-Z may come at any time
        self._after()

    def _be_ready(self) -> None:
        if signal.SIGTSTP in self._handlers:
            signal.signal(signal.SIGTSTP, self._stop)
