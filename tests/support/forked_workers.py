"""The workers of a sweep are forked from the process of the sweep, if that was forked from one that has imported all.

Multiprocessing would execute a server for them, which imports all again.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import multiprocessing.util
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from msg_agents.processes.fork_server import run_and_end

NEEDED = (
    "distributed",
    "msg_analysis.report.figures.sweep_figure",
    "msg_analysis.report.html.sweep_page",
    "msg_analysis.sweep.conduct",
)


def prepare() -> None:
    """Import what a sweep and its workers need besides."""
    for name in NEEDED:
        importlib.import_module(name)


def install() -> None:
    """In the process of a sweep, which has only one thread as yet: fork the servers of multiprocessing."""
    multiprocessing.util.spawnv_passfds = _fork  # type: ignore[attr-defined]  not of the public API


def _fork(_: object, arguments: Sequence[str], kept: Sequence[int]) -> int:
    """Fork a process that does what ``python -c`` would do, with these descriptors and the standard ones."""
    pid = os.fork()
    if not pid:
        _run(arguments[-1], kept)
    return pid


def _run(code: str, kept: Sequence[int]) -> NoReturn:
    for descriptor in {int(file.name) for file in Path("/proc/self/fd").iterdir()} - {0, 1, 2, *kept}:
        with contextlib.suppress(OSError):  # that by which they were listed is closed
            os.close(descriptor)
    for number in signal.valid_signals() - {signal.SIGINT}:
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    run_and_end(functools.partial(exec, code, {}))
