"""Single keys from the terminal, which is left as it was found."""

from __future__ import annotations

import contextlib
import os
import re
import select
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
    Around a stop, call ``let_go`` and ``listen``.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._saved: list[Any] = []  # how the terminal was; nothing while it is as it was
        self._ours: list[Any] = []  # how we set it
        with contextlib.suppress(ValueError, OSError, AttributeError):  # no stdin, or not a file
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor):
                self._descriptor = descriptor

    @property
    def available(self) -> bool:
        """Whether there is a terminal to type at."""
        return self._descriptor is not None

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.let_go()

    def listen(self) -> None:
        """Have the terminal give single keys, where it is ours; again after others may have changed it."""
        if self._descriptor is None or not self._in_front():
            return
        with contextlib.suppress(termios.error):
            found = termios.tcgetattr(self._descriptor)
            if self._saved and found == self._ours:  # nobody has changed it: what was saved is still what was there
                return
            self._saved = found
            tty.setcbreak(self._descriptor, termios.TCSADRAIN)
            self._ours = termios.tcgetattr(self._descriptor)

    def let_go(self) -> None:
        """Leave the terminal as it was."""
        if self._saved and self._in_front():
            assert self._descriptor is not None
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._saved)
        self._saved = []

    def wait(self, seconds: float) -> list[str]:
        """What was typed: ``space``, ``step`` (right arrow, s, enter), ``up``, ``down``; at once, or at the end.

        Parameters
        ----------
        seconds
            to wait if nothing was typed [s]
        """
        if not self._saved:
            self.listen()  # it may have been started in the background
        if self._descriptor is None or not self._saved or not self._in_front():
            if seconds > 0:
                time.sleep(seconds)
            return []
        if not select.select([self._descriptor], [], [], max(0.0, seconds))[0]:
            return []
        typed = b""
        with contextlib.suppress(OSError):
            typed = os.read(self._descriptor, 1024)
        if not typed:  # the terminal has gone
            self._descriptor, self._saved = None, []
        return [_NAMES[key] for key in _KEYS.findall(typed) if key in _NAMES]

    def _in_front(self) -> bool:
        """Whether the terminal is ours: otherwise the system would stop whoever reads from it or changes it."""
        with contextlib.suppress(OSError):
            return self._descriptor is not None and os.tcgetpgrp(self._descriptor) == os.getpgrp()
        return False
