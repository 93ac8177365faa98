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

"""Processes forked by another one, which has imported everything: the side of the process that asks for them.

Every forked process is a child of the process that asked for it, which waits for it as for any other: the fork server
may end, or be killed, at any time.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Protocol, Self

LONGEST_TITLE = 200  # bytes; ROS names a log file by the title, and a longer name than 255 cannot be written
LONGEST = 1 << 16  # bytes of a message
MOST_DESCRIPTORS = 250  # that come with a message; Linux: 253
ALL_FORKED = b"all"  # what the server says after the numbers of the processes that it has forked
PATIENCE = 60.0  # s for an answer; the first comes after all imports
PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER = 36, 37  # of linux/prctl.h


class Process(Protocol):
    """A started process: what ``subprocess.Popen`` and ``ForkedProcess`` share."""

    @property
    def pid(self) -> int:
        """Its number."""

    def poll(self) -> int | None:
        """Its exit code, or minus the signal that killed it; None while it runs."""

    def wait(self) -> int:
        """The same, once it has ended."""

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended."""


class ForkedProcess:
    """A child of this process that was not made by ``subprocess``."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """Its exit code, or minus the signal that killed it; None while it runs."""
        self._reap(os.WNOHANG)
        return self._code

    def wait(self) -> int:
        """The same, once it has ended."""
        while self._code is None:
            self._reap(0)
        return self._code

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, sig)

    def _reap(self, options: int) -> None:
        if self._code is None:
            try:
                pid, status = os.waitpid(self.pid, options)
            except ChildProcessError:  # this program ignores SIGCHLD, and nobody knows any more: as in Popen
                self._code = 0
            else:
                self._code = os.waitstatus_to_exitcode(status) if pid else None


Request = tuple[Mapping[str, Any], Sequence[int]]
"""What a forked process is to do, and the descriptors of which it gets copies."""


def start_server(
    command: Sequence[str], environment: Mapping[str, str], control: socket.socket, output: IO[bytes] | int
) -> subprocess.Popen[bytes]:
    """Start the process of a fork server, which gets the number of its socket, and room for titles, as arguments."""
    return subprocess.Popen(
        [*command, str(control.fileno()), " " * LONGEST_TITLE],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env=dict(environment),
        pass_fds=[control.fileno()],
        start_new_session=True,
    )


class ForkServer:
    """The fork server, as seen by the process that uses it: a context, at whose end it is gone.

    It imports while its user goes on; the first ``fork`` waits for that. It leaves no process behind but those that it
    has forked. Where the system cannot do it, or the server cannot start, nothing is forked.
    """

    def __init__(
        self,
        command: Sequence[str],  # see ``start_server``
        environment: Mapping[str, str],
        log: Path | None = None,  # of what the server itself prints
    ) -> None:
        self._command = command
        self._environment = environment
        self._log = log or Path(os.devnull)
        self._control: socket.socket | None = None
        self._process: Process | None = None

    def __enter__(self) -> Self:
        self._adopted = adopt_orphans(adopt=True)
        if self._adopted is None:
            return self
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.settimeout(PATIENCE)
        with theirs, self._log.open("ab") as output:
            self._process = self._start(theirs, output)
        return self

    def _start(self, control: socket.socket, output: IO[bytes]) -> Process:
        return start_server(self._command, self._environment, control, output)

    @property
    def pid(self) -> int | None:
        """Its number; None if it was never started."""
        return None if self._process is None else self._process.pid

    def fork(self, requests: Sequence[Request]) -> list[ForkedProcess]:
        """Fork a process for each request. Fewer come back if the server ends, or cannot do it: it is then gone."""
        forked: list[ForkedProcess] = []
        for message, descriptors in _messages(requests):
            if self._control is None or len(message) > LONGEST:
                break
            try:
                socket.send_fds(self._control, [message], descriptors)
                while (answer := self._control.recv(LONGEST)) != ALL_FORKED:
                    forked.append(ForkedProcess(int(answer)))
            except (OSError, ValueError):  # no answer, or it has ended
                self.stop()
        return forked

    def stop(self) -> None:
        """End the fork server; what it has forked goes on."""
        if self._process is not None and self._control is not None:
            self._control.close()
            self._control = None
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if self._adopted is False:
            adopt_orphans(adopt=False)
        with contextlib.suppress(OSError):
            if self._log.is_file() and not self._log.stat().st_size:
                self._log.unlink()


def _messages(requests: Sequence[Request]) -> Iterator[tuple[bytes, list[int]]]:
    """As few messages as the limits allow; each lists the requests with the places of their descriptors."""
    texts: list[str] = []
    together: list[int] = []
    for request, descriptors in requests:
        new = [number for number in dict.fromkeys(descriptors) if number not in together]
        length = sum(map(len, texts)) + len(json.dumps(request))
        if texts and (len(together) + len(new) > MOST_DESCRIPTORS or length > LONGEST // 2):
            yield f"[{','.join(texts)}]".encode(), together
            texts, together = [], []
            new = list(dict.fromkeys(descriptors))
        together = together + new
        texts.append(json.dumps([request, [together.index(number) for number in descriptors]]))
    if texts:
        yield f"[{','.join(texts)}]".encode(), together


def adopt_orphans(*, adopt: bool) -> bool | None:
    """Whether this process becomes the parent of processes below it whose own parent has ended: set it.

    Returns what was set before; None where the system has no such setting.
    """
    if sys.platform != "linux":
        return None
    try:
        prctl = ctypes.CDLL(None).prctl
    except (OSError, AttributeError):
        return None
    before = ctypes.c_int()
    if prctl(PR_GET_CHILD_SUBREAPER, ctypes.byref(before), 0, 0, 0) or prctl(PR_SET_CHILD_SUBREAPER, adopt, 0, 0, 0):
        return None
    return bool(before.value)
