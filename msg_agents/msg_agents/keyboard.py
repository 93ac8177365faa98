"""Single keys from the terminal, which is left as it was found."""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import sys
import termios
import time
import tty
from types import TracebackType
from typing import Any, Self

_KEYS = re.compile(rb"\x1b[\[O][A-D]|[^\x1b]", re.DOTALL)
_NAMES = {b" ": "space", b"s": "step", b"\n": "step"} | {
    b"\x1b" + kind + letter: name
    for kind in (b"[", b"O")
    for letter, name in ((b"A", "up"), (b"B", "down"), (b"C", "step"))
}


class Keyboard:
    """Keys typed at the terminal, one by one and without echo, as a context; none where stdin is no terminal.

    Ctrl-C and Ctrl-Z do what they always do. While the process is in the background, it does not touch the terminal.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._saved: list[Any] = []
        with contextlib.suppress(ValueError, OSError, AttributeError):  # no stdin, or not a file
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor):
                self._descriptor = descriptor

    @property
    def available(self) -> bool:
        """Whether there is a terminal to type at."""
        return self._descriptor is not None

    def __enter__(self) -> Self:
        if self._descriptor is not None and self._in_front():
            self._listen()
        if self._descriptor is not None:
            self._continued = signal.signal(signal.SIGCONT, self._resume)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._descriptor is not None:
            signal.signal(signal.SIGCONT, self._continued)
            self._restore()

    def wait(self, seconds: float) -> list[str]:
        """What was typed: ``space``, ``step`` (right arrow, s, enter), ``up``, ``down``; at once, or at the end.

        Parameters
        ----------
        seconds : to wait if nothing was
        """
        if not self._saved or not self._in_front():
            if seconds > 0:
                time.sleep(seconds)
            return []
        assert self._descriptor is not None
        if not select.select([self._descriptor], [], [], max(0.0, seconds))[0]:
            return []
        typed = os.read(self._descriptor, 1024)
        if not typed:  # the terminal has gone
            self._saved = []
        return [_NAMES[key] for key in _KEYS.findall(typed) if key in _NAMES]

    def _in_front(self) -> bool:
        """Whether the terminal is ours: otherwise the system would stop whoever reads from it or changes it."""
        with contextlib.suppress(OSError):
            return os.tcgetpgrp(self._descriptor or 0) == os.getpgrp()
        return False

    def _listen(self) -> None:
        assert self._descriptor is not None
        with contextlib.suppress(termios.error):
            self._saved = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor, termios.TCSADRAIN)

    def _resume(self, *_: object) -> None:
        # A shell takes its terminal back from a stopped job, and gives it out anew.
        if self._in_front():
            self._listen()

    def _restore(self) -> None:
        if self._saved and self._in_front():
            assert self._descriptor is not None
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._saved)
        self._saved = []
