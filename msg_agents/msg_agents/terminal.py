# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The terminal: interruption, job control, keys."""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

from msg_analysis.errors import killed_by

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def _can_handle() -> bool:
    """Whether this thread can set handlers of signals; in others, as of asyncio, signals are the main thread's."""
    return threading.current_thread() is threading.main_thread()


def exit_on_signals() -> None:
    """Let SIGTERM and SIGHUP raise SystemExit from now on, as Ctrl-C raises KeyboardInterrupt."""

    def end(number: int, _: object) -> None:
        raise SystemExit(killed_by(number))

    for number in SIGNALS[1:]:
        if not _under_nohup(number):
            signal.signal(number, end)


def _under_nohup(number: signal.Signals) -> bool:
    # Scripts ignore SIGINT for what they start in the background, and then end that by ``kill -INT``.
    return number != signal.SIGINT and signal.getsignal(number) is signal.SIG_IGN


def raise_for(number: int | None) -> None:
    """Raise KeyboardInterrupt for Ctrl-C, SystemExit for another signal; nothing for None."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    if number is not None:
        raise SystemExit(killed_by(number))


class Interruption:
    """Keeps the first signal until somebody asks for it: from ``keep`` to ``end``, or as a context."""

    # An exception that a handler raises is lost in a generator that is being closed, or in a callback of an executor.
    def __init__(self) -> None:
        self.caught: int | None = None  # number of the first signal
        self._handlers: dict[signal.Signals, Any] = {}

    def keep(self) -> None:
        """Keep signals from now on."""
        for number in SIGNALS:
            if number not in self._handlers and not _under_nohup(number) and _can_handle():
                self._handlers[number] = signal.signal(number, self._catch)

    def end(self) -> None:
        """Keep no more signals."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    def __enter__(self) -> Self:
        self.keep()
        return self

    def __exit__(self, *_: object) -> None:
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


class JobControl:
    """Calls ``before`` when Ctrl-Z is to stop the process, and ``after`` when it continues, as a context."""

    # Both are called by ``check``, not in a signal handler, which might come in the middle of drawing.
    def __init__(self, *, before: Callable[[], None], after: Callable[[], None]) -> None:
        self._before, self._after = before, after
        self._handlers: dict[signal.Signals, Any] = {}
        self._asked = self._resumed = self._continued = False

    def __enter__(self) -> Self:
        self._handlers[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._go_on)
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # else it is ignored or handled on purpose
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop if Ctrl-Z was typed; call ``after`` if the process has continued. To be called often."""
        if self._asked:
            self._asked = False
            self._before()
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            signal.raise_signal(signal.SIGTSTP)  # stops here; one sent by kill may reach another thread, later
            signal.signal(signal.SIGTSTP, self._ask)
            self._resumed = True  # even if the system did not stop it: under setsid no shell could continue it
        if self._resumed:
            self._resumed = False
            self._after()

    def continued(self) -> bool:
        """Whether the process has been stopped and continued since the last call."""
        was, self._continued = self._continued, False
        return was

    def _ask(self, *_: int | FrameType | None) -> None:
        self._asked = True

    def _go_on(self, *_: int | FrameType | None) -> None:
        self._continued = self._resumed = True


_KEYS = re.compile(rb"\x1b[\[O][A-D]|[^\x1b]", re.DOTALL)
_NAMES = {b" ": "space", b"s": "step", b"\n": "enter", b"\x7f": "back", b"\b": "back"} | {
    b"\x1b" + kind + letter: name
    for kind in (b"[", b"O")
    for letter, name in ((b"A", "up"), (b"B", "down"), (b"C", "forward"))
}
_NAMES |= {digit.encode(): digit for digit in "0123456789."}


class Keyboard:
    """Keys typed at the terminal, one by one and without echo, as a context; none where stdin is not a terminal."""

    # The system stops background processes that use the terminal. Call ``let_go`` before a stop, ``listen`` after it.
    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._saved: list[Any] = []  # original settings; empty while they are in force
        self._ours: list[Any] = []  # our settings
        with contextlib.suppress(ValueError, OSError, AttributeError):  # no stdin, or not a file
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor):
                self._descriptor = descriptor

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        self.let_go()

    def listen(self) -> None:
        """Switch the terminal to single keys if we are in the foreground, also after others have changed it."""
        if self._descriptor is None or not self._in_front():
            return
        with contextlib.suppress(termios.error):
            found = termios.tcgetattr(self._descriptor)
            if self._saved and found == self._ours:  # unchanged: what was saved is still the original
                return
            self._saved = found
            tty.setcbreak(self._descriptor, termios.TCSADRAIN)
            self._ours = termios.tcgetattr(self._descriptor)

    def let_go(self) -> None:
        """Restore the settings of the terminal, if we are in the foreground."""
        if self._saved and self._in_front():
            assert self._descriptor is not None
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._saved)
        self._saved = []

    def wait(self, seconds: float) -> list[str]:
        """Wait at most so many seconds for keys, until any is typed: their names, without those that have none."""
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
        with contextlib.suppress(OSError):
            return self._descriptor is not None and os.tcgetpgrp(self._descriptor) == os.getpgrp()
        return False
