# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Installed entry points: the command line, its nodes as executables of the ROS 2 package, the verb of ``ros2``."""

# This module itself loads nothing, so that Ctrl-C during the imports ends the program in order.

from __future__ import annotations

import atexit
import gc
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace


def _run(*command: str) -> None:
    atexit.register(_leave_garbage)
    from msg_analysis.cli.entry_point import command_line  # not above: ros2 loads the verb without it

    main = command_line("msg_agents.cli.main")
    main([*command, *sys.argv[1:]], prog_name="msg-agents")


def _leave_garbage() -> None:
    """What is left at the end goes with the process; but nodes of ROS say that they go, when they are collected."""
    if "rclpy" not in sys.modules:
        gc.freeze()


msg_agents = partial(_run)
agent, switcher, recorder, live, markers, external = (
    partial(_run, command) for command in ("agent", "switcher", "recorder", "live", "markers", "external")
)
player = partial(_run, "play")


class Verb:
    """Networks of agents: the command line msg-agents."""

    # What is above is the line of ``ros2 --help``. ros2cli asks for these two methods, not for a base class of its own,
    # so that nothing is needed where there is no ros2cli.

    def add_arguments(self, parser: ArgumentParser, cli_name: str) -> None:  # noqa: ARG002  as ros2cli calls it
        """Take all that follows, options too, even ``--help``: no character begins an option of the verb itself."""
        parser.prefix_chars = ""
        parser.add_argument("arguments", nargs="...")

    def main(self, *, parser: ArgumentParser, args: Namespace) -> NoReturn:  # noqa: ARG002  as ros2cli calls it
        """Become the command line: its signals, streams and exit code are those of ``ros2``."""
        sys.stdout.flush()
        program = _program()
        os.execv(program[0], [*program, *args.arguments])


def _program() -> list[str]:
    """The installed executable, since its Python may be another one than that of ``ros2``; without one, the module."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        executable = Path(prefix, "lib", "msg_agents", "msg-agents")
        if prefix and os.access(executable, os.X_OK):
            return [str(executable)]
    return [sys.executable, "-P", "-m", "msg_agents"]
