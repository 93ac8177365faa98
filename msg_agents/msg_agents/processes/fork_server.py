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

"""A process that has imported everything and forks others: nodes for a network, or runs for a sweep.

What asks for them is in ``msg_analysis.common.forked_processes``.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NoReturn

from msg_agents.processes.environment import start_environment
from msg_analysis.common.forked_processes import (
    ALL_FORKED,
    LONGEST,
    MOST_DESCRIPTORS,
    ForkedProcess,
    ForkServer,
    Process,
    start_server,
)

PROGRAM = [sys.executable, "-m", "msg_agents.cli.servers.node_server"]  # calls ``serve``
EARLY = "--early"  # argument of a server that is there before its run
TRIAL, NEXT = "try the middleware", "fork server of the next run"  # instead of a command
TRIAL_PATIENCE = 30.0  # s
TRIAL_LOOK = 1e-3  # s between two looks
CANNOT_FLUSH = 120  # Python's exit code where the last of stdout or stderr cannot be written
ADOPTION = 1e-4  # s between two looks whether a forked process has its new parent
READ_LATE = ("AMENT_", "CYCLONEDDS_", "FASTDDS_", "FASTRTPS_", "MSG_AGENTS_", "RCUTILS_", "RMW_", "ROS_")
"""How variables begin that no process reads before it is a node."""
_ending_at_once = False  # see ``ends_at_once``
_forked_by = 0  # see ``await_adoption``


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A fork server that is there before its run."""

    process: Process
    told: socket.socket  # where it will hear of its run
    environment: Mapping[str, str]  # that it has
    directory: Path | None  # in which it is
    owner: int  # process that started it: one that this forks has no part in it

    def serves(self, environment: Mapping[str, str]) -> bool:
        """Whether it is what a new process with this environment would be."""
        lasting, wanted = (
            {name: value for name, value in each.items() if not name.startswith(READ_LATE)}
            for each in (self.environment, environment)
        )
        return lasting == wanted and self.directory == _directory()

    def end(self) -> None:
        """End the process."""
        self.told.close()
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


_waiting: _Waiting | None = None
_several = False  # whether a run leaves a fork server for the next one


def _directory() -> Path | None:
    """The working directory, unless that is gone."""
    try:
        return Path.cwd()
    except OSError:
        return None


@dataclass(frozen=True, slots=True)
class NodeStart:
    """A process that is to be started."""

    arguments: Sequence[str]  # of its command
    descriptors: Mapping[str, int]  # by options, which get the numbers that they have in the new process
    output: int  # descriptor for what it prints
    core: int | None  # to which it keeps


class NodeServer(ForkServer):
    """The fork server of a network, as seen by the process that runs it."""

    def __init__(self, environment: Mapping[str, str], log: Path) -> None:
        super().__init__(PROGRAM, environment, log)
        self._directory = _directory()  # in which its process is

    def fork_nodes(self, nodes: Sequence[NodeStart]) -> list[ForkedProcess]:
        """Fork processes, each in a session of its own; see ``fork``."""
        return self.fork(
            [
                (
                    {"arguments": node.arguments, "options": list(node.descriptors), "core": node.core},
                    [node.output, *node.descriptors.values()],
                )
                for node in nodes
            ]
        )

    def has_middleware(self) -> bool:
        """Whether a forked process could use ROS 2: see ``middleware_check``."""
        with Path(os.devnull).open("wb") as nothing:
            trials = self.fork_nodes([NodeStart([TRIAL], {}, nothing.fileno(), None)])
        deadline = time.monotonic() + TRIAL_PATIENCE
        for trial in trials:  # one, or none if nothing can be forked
            try:
                while trial.poll() is None and time.monotonic() < deadline:
                    time.sleep(TRIAL_LOOK)
            finally:
                trial.send_signal(signal.SIGKILL)  # it hangs, or this process is interrupted
        return [trial.wait() for trial in trials] == [0]

    def _start(self, control: socket.socket, output: IO[bytes]) -> Process:
        return _wake(self._environment, control, output) or super()._start(control, output)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if _several and kind is None and _waiting is None:
            self._leave_next()
        super().__exit__(kind, error, trace)

    def _leave_next(self) -> None:
        """Fork the fork server of the next run: it has imported everything."""
        global _waiting
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, Path(os.devnull).open("wb") as nothing:
            forked = self.fork_nodes([NodeStart([NEXT], {EARLY: theirs.fileno()}, nothing.fileno(), None)])
        if forked:
            _waiting = _Waiting(forked[0], ours, self._environment, self._directory, os.getpid())
        else:
            ours.close()


@contextlib.contextmanager
def early_server() -> Iterator[None]:
    """Start the fork server of a run that is made within: it imports while this process goes on.

    Nothing is done if one is waiting already.
    """
    global _waiting
    if _waiting is not None or sys.platform != "linux":
        yield
        return
    environment = start_environment()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        server = start_server([*PROGRAM, EARLY], environment, theirs, subprocess.DEVNULL)
    _waiting = _Waiting(server, ours, environment, _directory(), os.getpid())
    try:
        yield
    finally:
        _end_waiting()  # no network was run, or the next one is not


@contextlib.contextmanager
def prepared() -> Iterator[None]:
    """Make the runs within start sooner: a process that has imported everything waits for each of them.

    It starts at once, and is there for the next run when one has ended without an exception. It is gone at the end of
    the context. Where the system cannot fork such processes, nothing is done.
    """
    global _several
    before, _several = _several, True
    try:
        with early_server():
            yield
    finally:
        _several = before
        if not before:
            _end_waiting()  # of the last run; early_server had nothing to do if one was waiting already


def _end_waiting() -> None:
    """End the fork server whose run will not be."""
    global _waiting
    left, _waiting = _waiting, None
    if left is not None:
        left.end()


def leave_one_waiting(serve_nodes: Callable[[socket.socket], NoReturn], unneeded: Iterable[int]) -> None:
    """Fork a process that becomes the fork server of the run that this process will make, if it has imported all.

    To be called before there are threads. ``unneeded``: descriptors that are not for that process.
    """
    global _waiting
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        pid = os.fork()
    except OSError:  # the fork server will start as without this function
        ours.close()
        theirs.close()
        return
    if pid:
        theirs.close()
        _waiting = _Waiting(ForkedProcess(pid), ours, dict(os.environ), _directory(), os.getpid())
        return
    ours.close()
    for descriptor in unneeded:
        os.close(descriptor)
    serve_nodes(await_run(theirs))


def await_run(early: socket.socket) -> socket.socket:
    """In a process that was there before its run: take that one's environment and log; the socket to serve at."""
    with early:
        message, descriptors, _, _ = socket.recv_fds(early, LONGEST, MOST_DESCRIPTORS)
    if not message:  # no network is run
        os._exit(0)
    control, output = descriptors
    if os.getsid(0) != os.getpid():
        os.setsid()
    environment = json.loads(message)
    for name in environment["removed"]:
        os.environ.pop(name, None)
    os.environ.update(environment["changed"])
    print_to(output)
    return socket.socket(fileno=control)


def _wake(environment: Mapping[str, str], control: socket.socket, output: IO[bytes]) -> Process | None:
    """Make the waiting process the fork server; None if there is none, or a new one would be another."""
    global _waiting
    if _waiting is None or _waiting.owner != os.getpid():
        return None
    waiting, _waiting = _waiting, None
    before = waiting.environment
    changed = {name: value for name, value in environment.items() if before.get(name) != value}
    message = json.dumps({"changed": changed, "removed": list(before.keys() - environment.keys())}).encode()
    if len(message) <= LONGEST and (not _several or waiting.serves(environment)):
        with contextlib.suppress(OSError), waiting.told:  # it has been killed
            socket.send_fds(waiting.told, [message], [control.fileno(), output.fileno()])
            return waiting.process
    waiting.end()
    return None


def serve(
    control: socket.socket,
    run: Callable[[Any, list[int]], object],
    read_ahead: Callable[[Any], object] = lambda _: None,
) -> NoReturn:
    """Fork processes as the other side requests it, and end when that does.

    A forked process does ``run`` with its request and its descriptors. It is a child of our parent. Before, this
    process does ``read_ahead`` with every request: what that leaves, the forked ones have.
    """
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
            read_ahead(request)
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
    control: socket.socket, requests: list[Any], descriptors: list[int], run: Callable[[Any, list[int]], object]
) -> NoReturn:
    """Fork a process for each request, say its number, and end; exit code 1: that could not be done for all."""
    global _forked_by
    _forked_by = os.getpid()
    for request, places in requests:
        try:
            pid = os.fork()
        except OSError:
            os._exit(1)
        if not pid:
            control.close()
            for descriptor in {*descriptors} - {descriptors[place] for place in places}:
                os.close(descriptor)
            run_and_end(functools.partial(run, request, [descriptors[place] for place in places]))
        control.send(str(pid).encode())
    os._exit(0)


def await_adoption() -> None:
    """Wait until this forked process is a child of the process that asked for it."""
    while os.getppid() == _forked_by:
        time.sleep(ADOPTION)


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


def print_to(output: int) -> None:
    """Make a descriptor, which is closed, stdout and stderr of this process."""
    for stream in (sys.stdout, sys.stderr):
        os.dup2(output, stream.fileno())
    os.close(output)


def begin_node(request: dict[str, Any], descriptors: list[int]) -> list[str]:
    """Make a forked process one of its own; the arguments of its command."""
    output, *others = descriptors
    os.setsid()
    print_to(output)
    if request["core"] is not None:
        with contextlib.suppress(OSError):  # the core has been taken from us
            os.sched_setaffinity(0, {request["core"]})
    for option, descriptor in zip(request["options"], others, strict=True):
        request["arguments"] += [option, str(descriptor)]
    arguments: list[str] = request["arguments"]
    return arguments
