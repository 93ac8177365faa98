"""A process that has imported everything and forks the processes of a network, so that each starts sooner.

Every forked process is a child of the process that asked for it, which waits for it as for any other: the fork server
may end, or be killed, at any time.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import gc
import json
import os
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Protocol, Self

PROGRAM = "msg_agents.cli.node_server"  # calls ``serve``
LONGEST_TITLE = 200  # bytes; ROS names a log file by the title, and a longer name than 255 cannot be written
LONGEST = 1 << 16  # bytes of a request
MOST_DESCRIPTORS = 8  # that come with a request
PATIENCE = 60.0  # s for an answer; the first comes after all imports
PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER = 36, 37  # of linux/prctl.h
CANNOT_FLUSH = 120  # Python's exit code where the last of stdout or stderr cannot be written
_ending_at_once = False  # see ``ends_at_once``


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


class ForkServerError(Exception):
    """The fork server cannot be used, or not any more: start the process in another way."""


class ForkedProcess:
    """A child of this process that the fork server has made."""

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


class ForkServer:
    """The fork server, as seen by the process that uses it: a context, at whose end it is gone.

    It imports while its user goes on; the first ``fork`` waits for that. It leaves no process behind but those that it
    has forked. Where the system cannot do it, or the server cannot start, every ``fork`` fails.
    """

    def __init__(self, environment: Mapping[str, str], log: Path) -> None:
        self._environment = environment
        self._log = log
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._adopted = adopt_orphans(adopt=True)
        if self._adopted is None:
            return self
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.settimeout(PATIENCE)
        with theirs, self._log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", PROGRAM, str(theirs.fileno()), " " * LONGEST_TITLE],  # room for titles
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(self._environment),
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        return self

    @property
    def pid(self) -> int | None:
        """Its number; None if it was never started."""
        return None if self._process is None else self._process.pid

    def fork(
        self,
        arguments: Sequence[str],
        descriptors: Mapping[str, int],  # by options, which get the numbers that they have in the new process
        output: int,  # descriptor for what it prints
        core: int | None,  # to which it keeps
    ) -> ForkedProcess:
        """Fork a process, in a session of its own, that runs the command with these arguments.

        ForkServerError: it could not be done.
        """
        request = json.dumps({"arguments": arguments, "options": list(descriptors), "core": core}).encode()
        if self._control is None or len(request) > LONGEST:
            raise ForkServerError
        try:
            socket.send_fds(self._control, [request], [output, *descriptors.values()])
            pid = int(self._control.recv(LONGEST) or b"0")
        except OSError:
            pid = 0
        if not pid:
            self._stop()
            raise ForkServerError
        return ForkedProcess(pid)

    def _stop(self) -> None:
        if self._process is not None and self._control is not None:
            self._control.close()
            self._control = None
            self._process.kill()
            self._process.wait()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        if self._adopted is False:
            adopt_orphans(adopt=False)
        with contextlib.suppress(OSError):
            if not self._log.stat().st_size:
                self._log.unlink()


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


def serve(control: socket.socket, run: Callable[[Any, list[int]], object]) -> NoReturn:
    """Fork a process for each request from the other side, and end when that does.

    The forked process does ``run`` with the request and the descriptors that came with it.
    """
    gc.collect()
    gc.freeze()  # the collector writes to the objects that it looks at, and their memory would be copied
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, LONGEST, MOST_DESCRIPTORS)
        if not message:
            os._exit(0)
        pid = _fork_orphan()
        if pid is None:
            control.close()
            run_and_end(functools.partial(run, json.loads(message), descriptors))
        for descriptor in descriptors:
            os.close(descriptor)
        control.send(str(pid).encode())


def _fork_orphan() -> int | None:
    """Fork a process that is a child of our parent: its number, 0 if that failed; in itself, None."""
    ours, theirs = socket.socketpair()
    with warnings.catch_warnings(), ours, theirs:
        # Python 3.12 warns of threads, whose locks might be held. Here, only the library of a tracer (LTTng) has any.
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            between = os.fork()
        except OSError:
            return 0
        if between:
            theirs.close()
            os.waitpid(between, 0)  # now the process has its new parent
            return int(ours.recv(LONGEST) or b"0")
        try:
            pid = os.fork()
        except OSError:
            os._exit(1)
        if pid:
            theirs.send(str(pid).encode())
            os._exit(0)
        return None


def run_and_end(run: Callable[[], object]) -> NoReturn:
    """Run it, and end this forked process as Python would, except that memory and C libraries are left as they are."""
    # Python would free all that was imported before the fork, and the system would copy it for that: a third of the CPU
    # time of a short run. Exit handlers of C libraries do not expect a fork either: a tracer's (LTTng) stops its
    # threads, which a forked process does not have, and crashes now and then.
    global _ending_at_once
    _ending_at_once = True
    code = 0
    try:
        run()
    except SystemExit as end:
        if isinstance(end.code, int):
            code = end.code
        elif end.code is not None:
            print(end.code, file=sys.stderr)
            code = 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    gc.collect()  # what the command has left, such as nodes of ROS, which say that they go
    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads, as multiprocessing does it
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            code = CANNOT_FLUSH
    os._exit(code & 0xFF)


def ends_at_once() -> bool:
    """Whether this process was forked, and so will end without taking its memory down: see ``run_and_end``."""
    return _ending_at_once


def begin_node(request: dict[str, Any], descriptors: list[int]) -> list[str]:
    """Make a forked process one of its own; the arguments of its command."""
    output, *others = descriptors
    os.setsid()
    for stream in (sys.stdout, sys.stderr):
        os.dup2(output, stream.fileno())
    os.close(output)
    if request["core"] is not None:
        with contextlib.suppress(OSError):  # the core has been taken from us
            os.sched_setaffinity(0, {request["core"]})
    for option, descriptor in zip(request["options"], others, strict=True):
        request["arguments"] += [option, str(descriptor)]
    arguments: list[str] = request["arguments"]
    return arguments
