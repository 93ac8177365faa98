"""Installed entry points: the command line, and the nodes as executables of the ROS 2 package.

Each node is the command of that name of ``msg-agents``: ``ros2 run msg_agents agent --ros-args -p run:=... ...``.
"""

from __future__ import annotations

import sys


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
        from msg_agents.cli.main import main
    except KeyboardInterrupt:  # the command group handles it only after these imports
        from msg_analysis.common.exit_codes import INTERRUPTED

        sys.exit(INTERRUPTED)
    main([*command, *sys.argv[1:]], prog_name="msg-agents")
