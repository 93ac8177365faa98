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

"""Single keys from the terminal, whose settings are restored afterwards."""

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
_NAMES = {b" ": "space", b"s": "step", b"\n": "enter", b"\x7f": "back", b"\b": "back"} | {
    b"\x1b" + kind + letter: name
    for kind in (b"[", b"O")
    for letter, name in ((b"A", "up"), (b"B", "down"), (b"C", "forward"))
}
_NAMES |= {digit.encode(): digit for digit in "0123456789."}


class Keyboard:
    """Keys typed at the terminal, one by one and without echo, as a context; none where stdin is not a terminal.

    Ctrl-C and Ctrl-Z work as usual. In the background the process does not touch the terminal. Call ``let_go`` before a
    stop and ``listen`` after it.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._saved: list[Any] = []  # original settings; empty while they are in force
        self._ours: list[Any] = []  # our settings
        with contextlib.suppress(ValueError, OSError, AttributeError):  # no stdin, or not a file
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor):
                self._descriptor = descriptor

    @property
    def available(self) -> bool:
        """Whether stdin is a terminal."""
        return self._descriptor is not None

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        """Wait at most so many seconds for keys: ``space``, ``step``, ``enter``, ``back``, arrows, digits, a point.

        ``step`` is s, ``back`` backspace; the arrows are ``forward``, ``up``, ``down``. Others are left out. Returns as
        soon as anything is typed.
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
        """Whether we are in the foreground: the system stops background processes that use the terminal."""
        with contextlib.suppress(OSError):
            return self._descriptor is not None and os.tcgetpgrp(self._descriptor) == os.getpgrp()
        return False
