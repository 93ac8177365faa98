# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Processes of nodes: forked from a fork server, which has imported everything, and ended with their parent."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import fcntl
import functools
import gc
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Self

from msg_analysis.common import programs

PROGRAM = [sys.executable, "-m", "msg_agents.cli.node_server"]  # calls ``serve``
LONGEST_TITLE = 200  # bytes; ROS names a log file by the title, and a longer name than 255 cannot be written
LONGEST = 1 << 16  # bytes of a message
MOST_DESCRIPTORS = 250  # that come with a message; Linux: 253
ALL_FORKED = b"all"  # what the server says after the numbers of the processes that it has forked
ANSWER_TIMEOUT = 60.0  # s; the first answer comes after all imports
TRIAL = "try the middleware"  # instead of a command
TRIAL_TIMEOUT = 30.0  # s
TRIAL_POLL = 1e-3  # s
EXIT_TIMEOUT = 5.0  # s that a process has to end when its parent has ended
SHOW_STACKS = signal.SIGUSR1  # makes a node write what its threads are doing
CANNOT_FLUSH = 120  # Python's exit code where the last of stdout or stderr cannot be written
PR_SET_CHILD_SUBREAPER, PR_GET_CHILD_SUBREAPER = 36, 37  # of linux/prctl.h
_ending_at_once = False  # see ``ends_at_once``


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


def exit_with_pipe(descriptor: int) -> None:
    """End this process when the other end of a pipe closes: its parent has ended."""

    def wait() -> None:
        while os.read(descriptor, 1):
            pass

    _end_after(wait)


def exit_with_lock(folder: Path) -> None:
    """End this process when a folder (``temporary_directory``) is no longer locked, or gone: its parent has ended."""
    from msg_analysis.common.files import lock  # not for --help: it imports yaml

    def wait() -> None:
        with contextlib.suppress(OSError):
            if not lock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH):
                threading.Event().wait()  # nothing tells when the parent ends

    _end_after(wait)


def _end_after(wait: Callable[[], None]) -> None:
    def watch() -> None:
        wait()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(EXIT_TIMEOUT)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="parent").start()


def show_stacks_when_asked() -> None:
    """Let this process, and what it forks, write the stacks of its threads to stderr when it gets SHOW_STACKS."""
    with contextlib.suppress(RuntimeError, io.UnsupportedOperation):  # it has no stderr
        faulthandler.register(SHOW_STACKS)


@dataclass(frozen=True, slots=True)
class NodeStart:
    """A process that is to be started."""

    arguments: Sequence[str]  # of its command
    descriptors: Mapping[str, int]  # by options, which get the numbers that they have in the new process
    output: int  # descriptor for what it prints
    core: int | None  # to which it keeps


class ForkServer:
    """The fork server of a network, as seen by the process that runs it: a context, at whose end the server is gone."""

    # It imports while its user goes on; the first fork waits for that. Every forked process is a child of the process
    # that asked for it: the server may end, or be killed, at any time. Other systems than Linux cannot do it.
    def __init__(self, environment: Mapping[str, str], log: Path) -> None:
        self._environment = environment
        self._log = log  # of what the server itself prints
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._adopted = _adopt_orphans(adopt=True)
        if self._adopted is None:
            return self
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.settimeout(ANSWER_TIMEOUT)
        with theirs, self._log.open("ab") as output:
            self._process = programs.start(
                [*PROGRAM, str(theirs.fileno()), " " * LONGEST_TITLE],  # room for the titles of forked processes
                self._environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        return self

    @property
    def pid(self) -> int | None:
        """Its number; None if it was never started."""
        return None if self._process is None else self._process.pid

    def fork_nodes(self, nodes: Sequence[NodeStart]) -> list[ForkedProcess]:
        """Fork processes, each in a session of its own; fewer if the server ends, or cannot do it: it is then gone."""
        forked: list[ForkedProcess] = []
        for message, descriptors in _messages(nodes):
            if self._control is None or len(message) > LONGEST:
                break
            try:
                socket.send_fds(self._control, [message], descriptors)
                while (answer := self._control.recv(LONGEST)) != ALL_FORKED:
                    forked.append(ForkedProcess(int(answer)))
            except (OSError, ValueError):  # no answer, or it has ended
                self._stop()
        return forked

    def has_middleware(self, timeout: float = TRIAL_TIMEOUT) -> bool:
        """Whether a forked process could use ROS 2: see ``middleware_check``."""
        with Path(os.devnull).open("wb") as nothing:
            trials = self.fork_nodes([NodeStart([TRIAL], {}, nothing.fileno(), None)])
        deadline = time.monotonic() + timeout
        for trial in trials:  # one, or none if nothing can be forked
            try:
                while trial.poll() is None and time.monotonic() < deadline:
                    time.sleep(TRIAL_POLL)
            finally:
                trial.send_signal(signal.SIGKILL)  # it hangs, or this process is interrupted
        return [trial.wait() for trial in trials] == [0]

    def _stop(self) -> None:
        """End the fork server; what it has forked goes on."""
        if self._process is not None and self._control is not None:
            self._control.close()
            self._control = None
            self._process.kill()
            self._process.wait()

    def __exit__(self, *_: object) -> None:
        self._stop()
        if self._adopted is False:
            _adopt_orphans(adopt=False)
        with contextlib.suppress(OSError):
            if self._log.is_file() and not self._log.stat().st_size:
                self._log.unlink()


def _messages(nodes: Sequence[NodeStart]) -> Iterator[tuple[bytes, list[int]]]:
    """As few messages as the limits allow; each lists the requests with the places of their descriptors."""
    texts: list[str] = []
    together: list[int] = []
    for node in nodes:
        request = {"arguments": node.arguments, "options": list(node.descriptors), "core": node.core}
        descriptors = [node.output, *node.descriptors.values()]
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


def _adopt_orphans(*, adopt: bool) -> bool | None:
    """Set whether this process adopts processes below it whose parent has ended; what was set before, None: cannot."""
    before = ctypes.c_int()
    with contextlib.suppress(OSError, AttributeError):
        prctl = ctypes.CDLL(None).prctl  # Linux only
        if not prctl(PR_GET_CHILD_SUBREAPER, ctypes.byref(before), 0, 0, 0):
            return None if prctl(PR_SET_CHILD_SUBREAPER, adopt, 0, 0, 0) else bool(before.value)
    return None


def serve(
    control: socket.socket, run: Callable[[list[str]], object], read_ahead: Callable[[list[str]], object]
) -> NoReturn:
    """Fork processes that ``run`` the arguments of their commands, as the other side asks for them; end with that."""
    gc.freeze()  # the collector writes to the objects that it looks at, and their memory would be copied
    gc.enable()
    # Python 3.12 warns of threads, whose locks might be held. Here, only the library of a tracer (LTTng) has any.
    warnings.filterwarnings("ignore", ".*fork", DeprecationWarning, __name__)
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, LONGEST, MOST_DESCRIPTORS)
        if not message:
            os._exit(0)
        requests = json.loads(message)
        for request, _ in requests:
            read_ahead(request["arguments"])  # what that leaves, the forked ones have
        try:
            between = os.fork()  # the parent of those that it forks, until it ends
        except OSError:
            os._exit(1)
        if not between:
            _fork_each(control, requests, descriptors, run)
        for descriptor in descriptors:
            os.close(descriptor)
        if os.waitpid(between, 0)[1]:
            os._exit(1)
        control.send(ALL_FORKED)


def _fork_each(
    control: socket.socket, requests: list[Any], descriptors: list[int], run: Callable[[list[str]], object]
) -> NoReturn:
    """Fork a process for each request, say its number, and end; exit code 1: that could not be done for all."""
    for request, places in requests:
        try:
            pid = os.fork()
        except OSError:
            os._exit(1)
        if not pid:
            control.close()
            for descriptor in {*descriptors} - {descriptors[place] for place in places}:
                os.close(descriptor)
            run_and_end(functools.partial(_run_node, run, request, [descriptors[place] for place in places]))
        control.send(str(pid).encode())
    os._exit(0)


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
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except (OSError, ValueError):
            code = CANNOT_FLUSH
    os._exit(code & 0xFF)


def ends_at_once() -> bool:
    """Whether this process was forked, and so will end without taking its memory down: see ``run_and_end``."""
    return _ending_at_once


def _run_node(run: Callable[[list[str]], object], request: dict[str, Any], descriptors: list[int]) -> None:
    """Make a forked process one of its own, and run its command."""
    output, *others = descriptors
    os.setsid()
    for stream in (sys.stdout, sys.stderr):
        os.dup2(output, stream.fileno())
    os.close(output)
    if request["core"] is not None:
        with contextlib.suppress(OSError):  # the core has been taken from us
            os.sched_setaffinity(0, {request["core"]})
    arguments: list[str] = request["arguments"]
    for option, descriptor in zip(request["options"], others, strict=True):
        arguments += [option, str(descriptor)]
    run(arguments)
