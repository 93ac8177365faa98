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

"""Stopping and continuing by a shell: Ctrl-Z, ``fg``, ``bg``."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self


class JobControl:
    """Calls ``before`` when Ctrl-Z is to stop the process, and ``after`` when it continues, as a context.

    Both are called by ``check``, not in a signal handler, which might come in the middle of drawing. There is no call
    before SIGSTOP, which no process can catch. ``after`` is called in the foreground and in the background.
    """

    def __init__(self, *, before: Callable[[], None], after: Callable[[], None]) -> None:
        self._before, self._after = before, after
        self._handlers: dict[signal.Signals, Any] = {}
        self._asked = self._resumed = self._continued = False

    def __enter__(self) -> Self:
        self._handlers[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._go_on)
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # else it is ignored or handled on purpose
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._ask)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
