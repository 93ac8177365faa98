"""Our own commands are forked from a process that has imported everything, instead of being executed.

Where it is ``installed``, ``subprocess`` forks ``msg-agents``, ``msg-analysis``, ``dask``, fork servers, the nodes of
tests (``python -P -c CODE``) and the workers of xdist (``python -u -c CODE``), if nothing is asked for but streams, a
directory, a session, a function of this folder that is called first, a network namespace (``ip netns exec``), a
PYTHONPATH to other packages, and variables that are read after the imports. It executes all else as ever. A forked
process is a child of the process that asked, has the title of its command, and its mark can be read in its environment,
as after exec.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib
import importlib.machinery
import io
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from msg_agents.cli.servers.node_server import serve_waiting
from msg_agents.processes.environment import start_environment
from msg_agents.processes.fork_server import leave_one_waiting, serve
from msg_agents.processes.hung_process import show_stacks_when_asked
from msg_analysis.common.forked_processes import ALL_FORKED, LONGEST, adopt_orphans

MARK = "MSG_AGENTS_TEST"
LENGTH_OF_MARK = 32
NODE_SERVER = "msg_agents.cli.servers.node_server"
RUN_SERVER = "msg_agents.cli.servers.run_server"
OF_NODE_SERVER = ["-m", NODE_SERVER]
OF_RUN_SERVER = ["-P", "-m", RUN_SERVER]
OF_NODE = ["-P", "-c"]
OF_WORKER = ["-u", "-c"]  # as execnet starts it
PROGRAMS = {
    "msg-agents": ("msg_agents.cli.entry_points", "msg_agents"),
    "msg-analysis": ("msg_analysis.cli.main", "main"),
    "dask": ("dask.__main__", "main"),
}
PREPARED = (
    "msg_agents.cli.replay",
    "msg_agents.cli.watching",
    "msg_agents.doctor.examination",
    "msg_agents.nodes.replay.player",
    "msg_agents.nodes.watching.live",
    "msg_agents.cli.main",
    "msg_agents.cli.run_result",
    "msg_agents.running.runner",
    "msg_agents.watching.run_view",
    "msg_agents.watching.terminal_panel",
    "msg_analysis.api",
    "msg_analysis.cli.compare",
    "msg_analysis.cli.progress",
    "msg_analysis.cli.runs",
    "msg_analysis.common.text.safe_console",
    "msg_analysis.report.html.report_page",
    "msg_analysis.report.terminal.comparison_text",
    "msg_analysis.twin.check",
    "rich._emoji_codes",
    "rich.progress",
    "scipy.stats",
    "threadpoolctl",
)
READ_LATER = re.compile(
    "(ROS_|RMW_(?!IMPLEMENTATION)|FASTDDS_|FASTRTPS_|MSG_AGENTS_|PYTEST_|PYDANTIC_|KMP_).*|NO_COLOR|COLUMNS|LINES|PYTHON(SAFEPATH|UNBUFFERED)|"
    "(MKL|OMP|OPENBLAS)_NUM_THREADS"
)
"""Names of variables that are read after the imports, or are the same for all that is forked (libraries set KMP_)."""
COMMANDS, NODES = "commands of tests", "nodes of tests"  # what a server forks; the latter ones have less memory to copy
SUPPORT = Path(__file__).parent
CLONE_NEWNET = 0x40000000  # linux/sched.h
LONGEST_TITLE = 2000
FREE = 200  # descriptors from here on are not used

FORK_EXEC: Callable[..., int] | None = getattr(
    subprocess, "_fork_exec", None
)  # where Popen ends; not of the public API


@contextlib.contextmanager
def installed() -> Iterator[None]:
    """Fork meanwhile, where the system can do it."""
    if FORK_EXEC is None or sys.platform != "linux":
        yield
        return
    adopt_orphans(adopt=True)
    subprocess._fork_exec = _forker().fork_exec  # type: ignore[attr-defined]
    try:
        yield
    finally:
        subprocess._fork_exec = FORK_EXEC  # type: ignore[attr-defined]
        adopt_orphans(adopt=False)


def read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """What a forked process must have as its server has it."""
    return {name: value for name, value in environment.items() if not READ_LATER.fullmatch(name)}


def packages_of(environment: Mapping[str, str], path: Sequence[str]) -> list[str]:
    """The folders in PYTHONPATH, if these can be found late: none of their modules is on ``path``."""
    folders = [Path(folder) for folder in environment.get("PYTHONPATH", "").split(os.pathsep) if folder]
    names = {file.name.partition(".")[0] for folder in folders if folder.is_dir() for file in folder.iterdir()}
    known = {"sitecustomize", "usercustomize", *sys.builtin_module_names}  # Python imports the first two at its start
    if any(name in known or importlib.machinery.PathFinder.find_spec(name, path) for name in names):
        return []
    return list(map(str, folders))


def request_of(words: Sequence[str | bytes | os.PathLike[str]], arguments: Sequence[Any]) -> dict[str, Any] | None:
    """What the arguments of ``_fork_exec`` ask for; None if it is not known how to fork that."""
    command = [os.fsdecode(word) for word in words]
    namespace = None
    if command[:3] == ["ip", "netns", "exec"]:
        namespace, command = command[3], command[4:]
    of_ours = Path(command[0]).parent == Path(sys.executable).parent and Path(command[0]).name in PROGRAMS
    close, kept, directory, environment = arguments[2:6]
    new_group, *identity = arguments[16:21]
    first = arguments[21]
    known = first is None or (Path(first.__code__.co_filename).parent == SUPPORT and first.__qualname__.isidentifier())
    unusual = not close or new_group != -1 or identity != [None, None, None, -1] or not known
    of_python = command[1:4] == OF_RUN_SERVER or command[1:3] in (OF_NODE_SERVER, OF_NODE, OF_WORKER)
    if unusual or not (of_ours or (of_python and command[0] == sys.executable)):
        return None
    lines = [f"{name}={value}" for name, value in os.environ.items()] if environment is None else environment
    return {
        "command": command,
        "namespace": namespace,
        "directory": os.fsdecode(directory or Path.cwd()),
        "environment": dict(os.fsdecode(line).split("=", 1) for line in lines),
        "session": arguments[15],
        "first": first and [first.__module__, first.__qualname__],
        "kept": [number for number in kept if number != arguments[13]],
    }


def descriptors_of(request: dict[str, Any], arguments: Sequence[Any]) -> list[int]:
    """Standard input, output and error, and what else is kept."""
    streams = (arguments[6], arguments[9], arguments[11])
    return [own if asked == -1 else asked for own, asked in enumerate(streams)] + request["kept"]


class _Forker:
    """Takes the place of ``_fork_exec`` in a process of the tests: its server starts when it is needed."""

    def __init__(self) -> None:
        self.controls: dict[str, socket.socket] = {}
        self._whole, self._path = dict(os.environ), list(sys.path)  # as they are before any test changes them
        self._environment = read_at_start(self._whole)

    def fork_exec(self, *arguments: Any) -> int:
        request = request_of(arguments[0], arguments)
        if request is None:
            return FORK_EXEC(*arguments)  # type: ignore[misc]
        kind = NODES if request["command"][1:3] == OF_NODE_SERVER else COMMANDS
        if kind not in self.controls:
            self.controls[kind] = self._start(kind)
        control = self.controls[kind]
        request["packages"] = packages_of(request["environment"], self._path)
        at_start = read_at_start(request["environment"])
        if request["packages"]:
            del at_start["PYTHONPATH"]
        descriptors = descriptors_of(request, arguments)
        message = json.dumps([[request, list(range(len(descriptors)))]]).encode()
        if len(message) > LONGEST or at_start != self._environment:
            return FORK_EXEC(*arguments)  # type: ignore[misc]
        socket.send_fds(control, [message], descriptors)
        pid = int(control.recv(LONGEST))
        assert control.recv(LONGEST) == ALL_FORKED
        return pid

    def _start(self, kind: str) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        same = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", MARK: "0" * LENGTH_OF_MARK}
        same["SPT_NOENV"] = "1"  # titles leave the environment readable
        with theirs:
            subprocess.Popen(
                [sys.executable, "-P", __file__, str(theirs.fileno()), " " * LONGEST_TITLE, kind],
                env=self._whole | same,
                pass_fds=[theirs.fileno()],
            )
        return ours


@functools.cache
def _forker() -> _Forker:
    return _Forker()


def use(control: socket.socket) -> None:
    """Fork commands from this server, instead of one that would have to start."""
    _forker().controls[COMMANDS] = control


def run(request: dict[str, Any], descriptors: list[int]) -> None:
    """What a forked process does."""
    if request["namespace"] is not None:
        _enter(request["namespace"])
    become(request, descriptors)()


def become(request: dict[str, Any], descriptors: list[int]) -> Callable[[], None]:
    """Make this process what is asked for; what it is to do then."""
    import numpy as np
    from setproctitle import setproctitle

    command: list[str] = request["command"]
    server = _leave_server(descriptors) if command[1:3] == OF_WORKER else None
    if request["session"]:
        os.setsid()
    os.chdir(request["directory"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:0] = request["packages"]
    _write_mark(request["environment"].get(MARK, ""))
    free = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, FREE) for descriptor in descriptors]
    for descriptor in descriptors:
        os.close(descriptor)
    for source, target in zip(free, [0, 1, 2, *request["kept"]], strict=True):
        os.dup2(source, target)
        os.close(source)
    if request["first"]:
        place, name = request["first"]
        getattr(importlib.import_module(place), name)()
    _open_streams()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    random.seed()
    np.random.seed()
    of_python = [] if command[0] == sys.executable else [sys.executable]
    of_code = command[1:3] in (OF_NODE, OF_WORKER)
    shown = command[:3] if of_code else command  # ROS names a log file by it, where code cannot stand
    setproctitle(" ".join([*of_python, *shown]).rstrip())
    if server is not None:
        importlib.import_module("forked_commands").use(server)  # not this module, which is a program
    if of_code:
        sys.argv = command[2:3] + command[4:]
        sys.modules["__main__"] = module = types.ModuleType("__main__")
        return functools.partial(exec, command[3], module.__dict__)
    if command[1:3] == OF_NODE_SERVER:
        sys.argv = command[2:]
        return importlib.import_module(NODE_SERVER).main  # type: ignore[no-any-return]
    if command[1:4] == OF_RUN_SERVER:
        sys.argv = command[3:]
        return importlib.import_module(RUN_SERVER).main  # type: ignore[no-any-return]
    sys.argv = command
    if command[1:2] in (["run"], ["host"], ["doctor"]):
        os.environ.update(start_environment())  # for what will wait
        leave_one_waiting(serve_waiting, request["kept"])
        os.environ.clear()
        os.environ.update(request["environment"])
    if command[1:2] == ["sweep"]:
        importlib.import_module("forked_workers").install()
    place, name = PROGRAMS[Path(command[0]).name]
    return lambda: sys.exit(getattr(importlib.import_module(place), name)())


def _leave_server(unneeded: list[int]) -> socket.socket:
    """Fork a server for the commands of this worker, which has imported everything and has no threads yet."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if not os.fork():
        for descriptor in [ours.detach(), *unneeded]:
            os.close(descriptor)
        serve(theirs, run, _prepare_for)
    theirs.close()
    return ours


def _prepare_for(request: dict[str, Any]) -> None:
    """Seldom used, so the server imports it when it is."""
    if Path(request["command"][0]).name == "dask" or request["command"][1:2] == ["sweep"]:
        importlib.import_module("forked_workers").prepare()


def _enter(namespace: str) -> None:
    """As ``ip netns exec`` does it, but for what it mounts."""
    with Path("/run/netns", namespace).open() as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")


def _open_streams() -> None:
    """As Python does it at its start."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        raw = io.FileIO(number, mode, closefd=False)
        at_once = mode == "w" and bool(os.environ.get("PYTHONUNBUFFERED"))
        buffered = raw if at_once else io.BufferedReader(raw) if mode == "r" else io.BufferedWriter(raw)
        before = getattr(sys, name)
        stream = io.TextIOWrapper(
            buffered,  # type: ignore[arg-type]  as Python does it
            before.encoding,
            before.errors,
            line_buffering=name == "stderr" or raw.isatty(),
            write_through=at_once,
        )
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _write_mark(mark: str) -> None:
    """Into the environment that others see, which is that of the first process."""
    if len(mark) != LENGTH_OF_MARK:
        return
    start = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[47])
    place = Path("/proc/self/environ").read_bytes().index(f"{MARK}=".encode()) + len(MARK) + 1
    ctypes.memmove(start + place, mark.encode(), LENGTH_OF_MARK)


def _use_libraries() -> None:
    """What they find out at their first use, such as the properties of figures, is then known to all that is forked."""
    from msg_analysis.api import Experiment
    from msg_analysis.report.html.report_page import render

    comparison = Experiment.load("line_ring").simulate(duration=10).compare()
    render(comparison, comparison.trajectory)
    del comparison
    gc.collect()


def main() -> None:
    """The server."""
    from setproctitle import setproctitle

    kind = sys.argv[3]
    setproctitle(kind)  # it finds its place only before the environment is changed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.path.append(str(SUPPORT))
    before = read_at_start(os.environ)
    importlib.import_module(NODE_SERVER).prepare()
    if kind == COMMANDS:
        for name in PREPARED:
            importlib.import_module(name)
        _use_libraries()
    if (after := read_at_start(os.environ)) != before:
        sys.exit(f"libraries have changed variables that are read at a start: {after.items() ^ before.items()}")
    show_stacks_when_asked()
    serve(socket.socket(fileno=int(sys.argv[1])), run, _prepare_for)


if __name__ == "__main__":
    main()
