"""What is installed to be run: the command line, and the nodes as executables of the ROS 2 package.

Each node is the command of that name of ``msg-agents``: ``ros2 run msg_agents agent --ros-args -p run:=... ...``.
"""

from __future__ import annotations

import os
import sys

INTERRUPTED = 130


def msg_agents() -> None:
    """The command line."""
    _run()


def agent() -> None:
    """``msg-agents agent``."""
    _run("agent")


def switcher() -> None:
    """``msg-agents switcher``."""
    _run("switcher")


def recorder() -> None:
    """``msg-agents recorder``."""
    _run("recorder")


def player() -> None:
    """``msg-agents play``."""
    _run("play")


def live() -> None:
    """``msg-agents live``."""
    _run("live")


def markers() -> None:
    """``msg-agents markers``."""
    _run("markers")


def _run(*command: str) -> None:
    try:
        from msg_agents.cli import main

        main([*command, *sys.argv[1:]], prog_name="msg-agents")
    except KeyboardInterrupt:  # what is being imported cannot be asked to see to it
        code: object = INTERRUPTED
    except SystemExit as end:
        code = end.code
    else:
        code = 0
    if "rclpy" not in sys.modules or not isinstance(code, int):
        sys.exit(code)  # type: ignore[arg-type]
    # All has been given to whom it is due. Fast DDS has threads of its own, which may hold up an interpreter that ends.
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            code = code or 1  # what could not be written was wanted
    os._exit(code)
