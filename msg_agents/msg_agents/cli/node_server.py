# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""``python -m msg_agents.cli.node_server SOCKET``: imports what nodes need, and forks them."""

from __future__ import annotations

import gc
import importlib
import os
import socket
import sys
from pathlib import Path

MODULES = (
    "importlib.readers",  # by the recorder: the definitions of messages
    "msg_agents.cli.main",
    "msg_agents.nodes.agent_group",
    "msg_agents.nodes.process",
    "msg_agents.nodes.recorder",
    "msg_agents.nodes.switcher",
    "numpy.ma",  # by the recorder: ``numpy.unique``
    "numpy.random",
    "rclpy.experimental.events_executor",
    "setproctitle",
)  # what the processes of nodes import, at the latest when they need it

NODES = ("agent", "recorder", "switcher")  # commands that take a run record


def main() -> None:
    """Import all, and serve."""
    prepare()
    from msg_agents.run.fork_server import serve

    serve(socket.socket(fileno=int(sys.argv[1])), run_command, _read_record)


def prepare() -> None:
    """Import all that nodes need."""
    gc.disable()  # until this process serves; nothing that is imported goes again: a tenth of the time
    os.environ["SPT_NOENV"] = "1"  # titles must leave the environment readable: by it, processes of a run are found
    from msg_agents.environment import tolerate_warnings

    tolerate_warnings()
    for name in MODULES:
        importlib.import_module(name)
    from setproctitle import getproctitle

    from msg_agents.nodes.ros import load_type_support
    from msg_analysis.messages.topics import DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES

    load_type_support((DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES))
    getproctitle()  # it finds the place of titles only as long as the environment has not been changed


def _read_record(arguments: list[str]) -> None:
    """Read the run record of a node once for all that are forked: each would take a fifth of its start for it."""
    from msg_agents.cli.nodes import read_record_ahead

    command, *rest = arguments
    if command in NODES:
        read_record_ahead(Path(rest[0]))


def run_command(arguments: list[str]) -> None:
    """Run a command of ``msg-agents`` in a forked process."""
    import numpy as np
    from setproctitle import setproctitle

    from msg_agents.cli.main import main as command
    from msg_agents.nodes.ros import use_middleware
    from msg_agents.run.fork_server import LONGEST_TITLE, TRIAL

    # In ``ps``, and in the names of log files of ROS.
    title = os.fsencode(f"msg-agents {' '.join(arguments)}")
    setproctitle(title[:LONGEST_TITLE].decode(errors="ignore"))
    if arguments == [TRIAL]:
        use_middleware()
        return
    np.random.seed()  # laws of agents may draw from it: not the same numbers in every process
    sys.argv = ["msg-agents", *arguments]
    command(arguments, prog_name="msg-agents")


if __name__ == "__main__":
    main()
