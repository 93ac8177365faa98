# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""``python -m msg_agents.cli.servers.node_server [--early] SOCKET``: imports what nodes need, and forks them.

With ``--early`` it is told of its run later: see ``fork_server.early_server``.
"""

from __future__ import annotations

import gc
import importlib
import os
import socket
import sys
from pathlib import Path
from typing import Any, NoReturn

MODULES = (
    "importlib.readers",  # by the recorder: the definitions of messages
    "msg_agents.cli.main",
    "msg_agents.nodes.agents.agent_group",
    "msg_agents.nodes.node_process",
    "msg_agents.nodes.recorder",
    "msg_agents.nodes.switcher",
    "numpy.ma",  # by the recorder: ``numpy.unique``
    "numpy.random",
    "rclpy.experimental.events_executor",
    "setproctitle",
)
"""What the processes of nodes import, at the latest when they need it."""

NODES = ("agent", "recorder", "switcher")  # commands that take a run record


def main() -> None:
    """Import all, and serve."""
    prepare()
    from msg_agents.processes.fork_server import EARLY, await_run

    early = sys.argv[1] == EARLY
    control = socket.socket(fileno=int(sys.argv[2 if early else 1]))
    serve_nodes(await_run(control) if early else control)


def prepare() -> None:
    """Import all that nodes need."""
    gc.disable()  # until this process serves; nothing that is imported goes again: a tenth of the time
    os.environ["SPT_NOENV"] = "1"  # titles must leave the environment readable: by it, processes of a run are found
    from msg_agents.processes.environment import tolerate_warnings

    tolerate_warnings()
    for name in MODULES:
        importlib.import_module(name)
    from setproctitle import getproctitle

    from msg_agents.nodes.ros.lean_node import load_type_support
    from msg_analysis.wire.topics import DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES

    load_type_support((DIAGNOSTICS, EXPERIMENT, GRAPH, PROGRESS, STATE, STATES))
    getproctitle()  # it finds the place of titles only as long as the environment has not been changed


def serve_nodes(control: socket.socket) -> NoReturn:
    """Fork nodes; in a forked process, run the command of one."""
    from msg_agents.nodes.ros.middleware import use_middleware
    from msg_agents.processes.fork_server import EARLY, NEXT, TRIAL, await_run, begin_node, serve

    def run(request: dict[str, Any], descriptors: list[int]) -> None:
        arguments = begin_node(request, descriptors)
        if arguments == [TRIAL]:
            _show_as(arguments)
            use_middleware()
        elif arguments[:2] == [NEXT, EARLY]:
            serve_waiting(await_run(socket.socket(fileno=int(arguments[2]))))
        else:
            run_command(arguments)

    serve(control, run, _read_record)


def _read_record(request: dict[str, Any]) -> None:
    """Read the run record of a node once for all that are forked: each would take a fifth of its start for it."""
    from msg_agents.cli.nodes import read_record_ahead

    command, *rest = request["arguments"]
    if command in NODES:
        read_record_ahead(Path(rest[0]))


def serve_waiting(control: socket.socket) -> NoReturn:
    """The same in a process that was forked for its network: see ``fork_server.leave_one_waiting``."""
    from setproctitle import setproctitle

    from msg_agents.processes.fork_server import PROGRAM

    setproctitle(" ".join(PROGRAM))
    serve_nodes(control)


def run_command(arguments: list[str]) -> None:
    """Run a command of ``msg-agents`` in a forked process, which ``ps`` then shows by it."""
    import numpy as np

    from msg_agents.cli.main import main as command

    _show_as(arguments)
    np.random.seed()  # laws of agents may draw from it: not the same numbers in every process
    sys.argv = ["msg-agents", *arguments]
    command(arguments, prog_name="msg-agents")


def _show_as(arguments: list[str]) -> None:
    """In ``ps``, and in the names of log files of ROS."""
    from setproctitle import setproctitle

    from msg_analysis.common.forked_processes import LONGEST_TITLE

    title = os.fsencode(f"msg-agents {' '.join(arguments)}")
    setproctitle(title[:LONGEST_TITLE].decode(errors="ignore"))


if __name__ == "__main__":
    main()
