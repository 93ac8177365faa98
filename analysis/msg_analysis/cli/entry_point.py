# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Installed entry point: the command line; and how a program treats garbage."""

from __future__ import annotations

import atexit
import gc
import importlib
import resource
import sys
from typing import Any

OBJECTS_BETWEEN_COLLECTIONS = 20_000  # Python's 700 are for smaller programs
LEAST_ADDRESSES = 400_000 << 10  # bytes of `ulimit -v`; the libraries alone take some 350,000 KB


def collect_garbage_seldom() -> None:
    """Before the imports of a program: all that they make stays, and Python would look through it again and again."""
    gc.set_threshold(OBJECTS_BETWEEN_COLLECTIONS, *gc.get_threshold()[1:])


def command_line(module: str) -> Any:
    """The commands of a module. What their imports lack is one error; Ctrl-C meanwhile ends the program in order."""
    collect_garbage_seldom()
    try:
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESSES:
            # Not by trying: the libraries of linear algebra wait for memory without end.
            raise MemoryError
        return importlib.import_module(module).main
    except KeyboardInterrupt:  # the command group handles it only after these imports
        from msg_analysis.errors import INTERRUPTED

        sys.exit(INTERRUPTED)
    except Exception as error:
        from msg_analysis.errors import ExitCode, lack

        if (words := lack(error)) is None:
            raise
        print(f"error: {words}", file=sys.stderr)
        sys.exit(ExitCode.BAD_INPUT)


def msg_analysis() -> None:
    """The command line ``msg-analysis``."""
    atexit.register(gc.freeze)  # what is left at the end goes with the process
    command_line("msg_analysis.cli.main")(prog_name="msg-analysis")
