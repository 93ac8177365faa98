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

"""``python -m msg_agents.nodes.qos.server SOCKET``: imports all that writers and readers need and forks them."""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
from typing import Any


def main() -> None:
    """Import all, and serve."""
    gc.disable()
    os.environ["SPT_NOENV"] = "1"  # titles must leave the environment readable
    from msg_agents.processes.environment import tolerate_warnings

    tolerate_warnings()
    from rclpy.type_support import check_for_type_support
    from setproctitle import getproctitle
    from std_msgs.msg import UInt64

    from msg_agents.nodes.qos import reader, worker, writer  # noqa: F401
    from msg_agents.processes.fork_server import serve

    check_for_type_support(UInt64)
    getproctitle()  # it finds the place of titles only as long as the environment has not been changed
    serve(socket.socket(fileno=int(sys.argv[1])), run)


def run(request: dict[str, Any], descriptors: list[int]) -> None:
    """In a forked process: become a writer or a reader, until the other side closes the connection."""
    from setproctitle import setproctitle

    from msg_agents.doctor.qos.connection import Connection
    from msg_agents.nodes.qos.worker import serve_requests
    from msg_agents.processes.fork_server import await_adoption
    from msg_analysis.sweep.jobs.end_with_parent import end_with_parent

    os.setsid()
    await_adoption()
    end_with_parent(request["parent"], signal.SIGKILL)  # it ends stopped processes, too
    setproctitle(f"msg-agents doctor --qos: {request['name']}")
    end, *introduction = descriptors
    connection = Connection(socket.socket(fileno=end))
    serve_requests(request["role"], request["name"], connection, introduction[0] if introduction else None)


if __name__ == "__main__":
    main()
