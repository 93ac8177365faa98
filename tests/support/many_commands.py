"""Commands as processes of their own, forked from one that has imported everything: each would take seconds for that.

A test of how a program starts, of its environment for example, executes it instead.
"""

import gc
import importlib
import multiprocessing
import os
import pty
import resource
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from multiprocessing import forkserver, reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from msg_agents.cli.node_server import MODULES
from msg_agents.environment import FOREIGN_VARIABLES
from msg_agents.run.fork_server import PROGRAM
from msg_analysis.common import programs

Job = tuple[str, list[str], str]
PROGRAMS = {"msg-analysis": "msg_analysis.cli.main", "msg-agents": "msg_agents.cli.main"}
FORKING = multiprocessing.get_context("forkserver")
FORKING.set_forkserver_preload(
    [
        *PROGRAMS.values(),
        *MODULES,
        *("msg_agents.nodes.live", "msg_agents.nodes.markers", "msg_agents.nodes.player", "msg_agents.run.runner"),
        *("msg_agents.watch.panel", "msg_analysis.inference.pool", "msg_analysis.report.documents"),
        *("msg_analysis.report.page", "msg_analysis.report.tables", "msg_analysis.report.theory_text"),
        *("networkx", "rich._emoji_codes", "rich.progress"),
        "forked_node_server",
    ]
)
MARK = "MSG_AGENTS_TEST"
"""Variable by which tests find their processes."""
NO_MARK = 32 * "0"  # as long as one
PYTHON_IS_THE_SAME = {"PYTHONUNBUFFERED", "PYTHONSAFEPATH", "PYTHONDONTWRITEBYTECODE"}  # with these, for what is tested
MEMORY = 1 << 30  # bytes
LONGEST = 60  # s of a job


def ensure_running() -> None:
    """Start what forks them: its own environment is that of now, with a mark that ``forked_node_server`` can change."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(MARK, NO_MARK)
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        forkserver.ensure_running()


class ForkedCommand:
    """A running command, with what tests use of ``subprocess.Popen``; its stdout and stderr are pipes of text."""

    # ``terminal``: the streams are this one instead, and ``stdout`` a file; ``first``: what the process does before.

    def __init__(
        self,
        program: str,
        arguments: Sequence[str | Path],
        environment: Mapping[str, str],
        *,
        folder: Path | None = None,
        terminal: str | None = None,
        stdout: str | Path | None = None,
        first: Callable[[], object] | None = None,
    ) -> None:
        self.args = [program, *map(str, arguments)]
        pipes = [FORKING.Pipe(duplex=False) for _ in range(2)]
        streams = ([write for _, write in pipes], terminal, stdout)
        self._process = FORKING.Process(
            target=_become, args=(self.args, dict(environment), folder or Path.cwd(), *streams, first)
        )
        self._process.start()
        self.pid: int = self._process.pid
        self.stdout, self.stderr = (os.fdopen(os.dup(read.fileno())) for read, _ in pipes)
        for ends in pipes:
            for end in ends:
                end.close()

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    poll = returncode.fget

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if (code := self.returncode) is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for the end; what has not been read of both streams."""
        end = None if timeout is None else time.monotonic() + timeout
        texts = {self.stdout: b"", self.stderr: b""}
        with selectors.DefaultSelector() as selector:
            for stream in texts:
                selector.register(stream, selectors.EVENT_READ)
            while selector.get_map():
                ready = selector.select(end and end - time.monotonic())
                if not ready:
                    raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
                for key, _ in ready:
                    texts[key.fileobj] += (new := os.read(key.fd, 65536))
                    if not new:
                        selector.unregister(key.fileobj)
        self.wait(timeout)
        return texts[self.stdout].decode(), texts[self.stderr].decode()

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def starts_as_here(command: Sequence[str], environment: Mapping[str, str]) -> bool:
    """Whether it is a node server that imports what this process would, by what is in its environment."""
    others = {*FOREIGN_VARIABLES, *(name for name in environment if name.startswith("PYTHON"))} - PYTHON_IS_THE_SAME
    return list(command[:3]) == PROGRAM and not any(environment.get(name) for name in others)


class _ForkedServer:
    """With what is used of ``subprocess.Popen``."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], output: int, control: int) -> None:
        descriptors = [reduction.DupFd(number) for number in (output, control)]
        process = FORKING.Process(target=_serve_nodes, args=(command, dict(environment), *descriptors))
        process.start()
        self.pid, self.kill, self.wait = process.pid, process.kill, process.join


def start_program(command: Sequence[str], environment: Mapping[str, str], **options: Any) -> Any:
    """``programs.start``, but node servers of networks that this process itself runs are forked."""
    if not starts_as_here(command, environment):
        return programs.start(command, environment, **options)
    return _ForkedServer(command, environment, options["stdout"].fileno(), *options["pass_fds"])


def _serve_nodes(command: Sequence[str], environment: dict[str, str], output: Any, control: Any) -> None:
    from forked_node_server import become

    become(command, environment, output.detach(), control.detach())


def _become(
    words: list[str],
    environment: dict[str, str],
    folder: Path,
    pipes: list[Connection],
    terminal: str | None,
    stdout: str | Path | None,
    first: Callable[[], object] | None,
) -> None:
    """Turn this process, which has been forked, into one that the program had been executed in."""
    from msg_agents.run.fork_server import run_and_end

    gc.freeze()  # the collector writes to what it looks at, and the memory would be copied
    for number, pipe in enumerate(pipes, start=1):
        os.dup2(pipe.fileno(), number)
        pipe.close()
    if terminal is not None:
        os.setsid()
        opened = os.open(terminal, os.O_RDWR)  # from now on that of this session
        for number in range(3):
            os.dup2(opened, number)
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if stdout is not None:
        os.dup2(os.open(stdout, os.O_RDWR | os.O_CREAT), 1)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  as Python does it at its start
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))
    os.chdir(folder)
    program, *arguments = sys.argv = words
    if first is not None:
        first()
    run_and_end(partial(importlib.import_module(PROGRAMS[program]).main, arguments, prog_name=program))


def outcomes(jobs: Sequence[Job], folder: Path, **environment: str) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of each job, with this folder to work in and additions to the environment."""
    # A job is a program, its arguments, and where it runs: with a stdout that is a "pipe" or a "terminal", or one of
    # ``FILES`` or ``SURROUNDINGS``.
    everything = {**os.environ, "MPLBACKEND": "agg", **environment}
    return [_outcome(program, arguments, kind, everything, folder) for program, arguments, kind in jobs]


def _outcome(
    program: str, arguments: list[str], kind: str, environment: dict[str, str], folder: Path
) -> tuple[int, str, str]:
    shown = bytearray()
    with _terminal(shown) if kind == "terminal" else nullcontext(FILES.get(kind)) as stdout:
        first = SURROUNDINGS.get(kind)
        command = ForkedCommand(program, arguments, environment, folder=folder, stdout=stdout, first=first)
        printed, complaints = command.communicate(LONGEST)
    return command.wait(), printed + shown.decode(), complaints


@contextmanager
def _terminal(shown: bytearray) -> Iterator[str]:
    """Its name; what is shown on it."""

    def read() -> None:
        with suppress(OSError):  # nobody writes to it any more
            while True:
                shown.extend(os.read(master, 65536))

    master, slave = pty.openpty()
    reading = threading.Thread(target=read)
    reading.start()
    try:
        yield os.ttyname(slave)
    finally:
        os.close(slave)
        reading.join()
        os.close(master)


def _ascii() -> None:
    sys.stdout.reconfigure(encoding="ascii", errors="strict")
    sys.stderr.reconfigure(encoding="ascii")


def _closed() -> None:
    os.close(1)
    sys.stdout = None  # as Python has it at its start


def _gone() -> None:
    read, write = os.pipe()
    os.dup2(write, 1)
    os.close(read)
    os.close(write)


def _limit() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # as Python has it at its start
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))


def _memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


FILES = {"full": "/dev/full"}  # as stdout: a full disk
SURROUNDINGS: dict[str, Callable[[], object]] = {
    "ascii": _ascii,  # stdout has few characters
    "closed": _closed,
    "gone": _gone,  # nobody reads the pipe that is stdout
    "limit": _limit,  # files cannot grow beyond a few bytes
    "memory": _memory,  # there is 1 GB
}
