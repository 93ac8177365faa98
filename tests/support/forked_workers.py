"""The workers of a sweep are forked from the process of the sweep, if that was forked from one that has imported all.

Multiprocessing would execute a server for them, which imports all again; and so does what forks a worker's networks.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import multiprocessing.util
import os
import signal
import subprocess
import weakref
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import forked_commands

from msg_agents.processes.fork_server import run_and_end

NEEDED = (
    "distributed.cli.dask_scheduler",
    "distributed.cli.dask_worker",
    "msg_analysis.report.figures.sweep_figure",
    "msg_analysis.report.html.sweep_page",
    "msg_analysis.sweep.conduct",
)


def prepare() -> None:
    """Import what a sweep and its workers need besides."""
    for name in NEEDED:
        importlib.import_module(name)


def install() -> None:
    """In the process of a sweep, which has only one thread as yet: fork servers of multiprocessing and of networks."""
    multiprocessing.util.spawnv_passfds = _fork  # type: ignore[attr-defined]  not of the public API
    if forked_commands.FORK_EXEC is not None:
        subprocess._fork_exec = _fork_run_server  # type: ignore[attr-defined]


def _fork(_: object, arguments: Sequence[str], kept: Sequence[int]) -> int:
    """Fork a process that does what ``python -c`` would do, with these descriptors and the standard ones."""
    pid = os.fork()
    if not pid:
        _run(arguments[-1], kept)
    return pid


def _fork_run_server(*arguments: Any) -> int:
    """Takes the place of ``_fork_exec``."""
    request = forked_commands.request_of(arguments[0], arguments)
    if request is None or request["command"][1:4] != forked_commands.OF_RUN_SERVER:
        return forked_commands.FORK_EXEC(*arguments)  # type: ignore[misc]
    pid = os.fork()
    if not pid:
        descriptors = list(map(os.dup, forked_commands.descriptors_of(request, arguments)))  # some are the same
        _close_others(descriptors)
        # Packages in PYTHONPATH have been found by this process already.
        run_and_end(functools.partial(_run_server, request | {"packages": []}, descriptors))
    return pid


def _run_server(request: dict[str, Any], descriptors: list[int]) -> None:
    weakref.finalize._registry.clear()  # type: ignore[attr-defined]  what the worker removes at its end is not ours
    forked_commands.become(request, descriptors)()


def _run(code: str, kept: Sequence[int]) -> NoReturn:
    _close_others([0, 1, 2, *kept])
    for number in signal.valid_signals() - {signal.SIGINT}:
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    run_and_end(functools.partial(exec, code, {}))


def _close_others(kept: Iterable[int]) -> None:
    for descriptor in {int(file.name) for file in Path("/proc/self/fd").iterdir()} - {*kept}:
        with contextlib.suppress(OSError):  # that by which they were listed is closed
            os.close(descriptor)
