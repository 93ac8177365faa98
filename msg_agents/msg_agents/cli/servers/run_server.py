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

"""``python -m msg_agents.cli.servers.run_server SOCKET``: imports all that a run and its nodes need, and forks runs.

A worker of a sweep starts it (``msg_analysis.sweep.jobs.network_run``): a network is then running in a fraction of the
time.
"""

from __future__ import annotations

import importlib
import os
import socket
import sys
from typing import Any

from msg_analysis.cli.entry_point import collect_garbage_seldom

MODULES = (
    "msg_agents.running.runner",
    "msg_agents.watching.run_view",
    "msg_analysis.cli.progress",
    "msg_analysis.inference.verdict.compare",
)
"""What a run and its verdict import, at the latest when they need it."""


def main() -> None:
    """Import all, and serve."""
    from msg_agents.cli.servers.node_server import prepare
    from msg_agents.processes.fork_server import serve

    collect_garbage_seldom()
    prepare()
    for name in MODULES:
        importlib.import_module(name)
    serve(socket.socket(fileno=int(sys.argv[1])), _run)


def _run(request: dict[str, Any], descriptors: list[int]) -> None:
    """In a forked process: run the command."""
    from msg_agents.cli.servers.node_server import run_command, serve_waiting
    from msg_agents.processes.fork_server import await_adoption, leave_one_waiting
    from msg_analysis.sweep.jobs.end_with_parent import end_with_parent

    os.setsid()
    await_adoption()
    end_with_parent(request["parent"])
    stdout, stderr, *kept = descriptors
    for source, target in ((stdout, sys.stdout), (stderr, sys.stderr)):
        os.dup2(source, target.fileno())
        os.close(source)
    leave_one_waiting(serve_waiting, kept)
    run_command(request["arguments"])


if __name__ == "__main__":
    main()
