"""``python -m msg_agents.cli.node_server SOCKET``: imports all that nodes need and forks their processes."""

from __future__ import annotations

import importlib
import os
import socket
import sys
from typing import Any

MODULES = (
    "msg_agents.nodes.agents.agent_group",
    "msg_agents.nodes.node_process",
    "msg_agents.nodes.recorder",
    "msg_agents.nodes.switcher",
    "numpy.random",
    "rclpy.experimental.events_executor",
)
"""What the processes of nodes import, at the latest when they need it."""


def main() -> None:
    """Serve; in a forked process, run its command."""
    os.environ["SPT_NOENV"] = "1"  # titles must leave the environment readable: by it, processes of a run are found
    import numpy as np
    from setproctitle import setproctitle

    from msg_agents.cli.main import main as command
    from msg_agents.processes.environment import tolerate_warnings
    from msg_agents.processes.fork_server import LONGEST_TITLE, begin_node, serve

    def run(request: dict[str, Any], descriptors: list[int]) -> None:
        arguments = begin_node(request, descriptors)
        title = os.fsencode(f"msg-agents {' '.join(arguments)}")
        setproctitle(title[:LONGEST_TITLE].decode(errors="ignore"))
        np.random.seed()  # laws of agents may draw from it: not the same numbers in every process
        sys.argv = ["msg-agents", *arguments]
        command(arguments, prog_name="msg-agents")

    tolerate_warnings()
    _import_all()
    serve(socket.socket(fileno=int(sys.argv[1])), run)


def _import_all() -> None:
    for name in MODULES:
        importlib.import_module(name)
    from msg_agents.nodes.ros.lean_node import load_type_support
    from msg_analysis.wire.topics import DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES

    load_type_support((DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES))


if __name__ == "__main__":
    main()
