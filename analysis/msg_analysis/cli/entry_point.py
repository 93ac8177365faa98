# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Installed entry point: the command line; and how a program treats garbage."""

from __future__ import annotations

import atexit
import gc
import sys

OBJECTS_BETWEEN_COLLECTIONS = 20_000  # Python's 700 are for smaller programs


def collect_garbage_seldom() -> None:
    """Before the imports of a program: all that they make stays, and Python would look through it again and again."""
    gc.set_threshold(OBJECTS_BETWEEN_COLLECTIONS, *gc.get_threshold()[1:])


def msg_analysis() -> None:
    """The command line ``msg-analysis``."""
    collect_garbage_seldom()
    atexit.register(gc.freeze)  # what is left at the end goes with the process
    try:
        from msg_analysis.cli.main import main
    except KeyboardInterrupt:  # the command group handles it only after these imports
        from msg_analysis.errors import INTERRUPTED

        sys.exit(INTERRUPTED)
    main(prog_name="msg-analysis")
