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

"""One process: a node, and the requests of the command."""

from __future__ import annotations

from typing import Any, Protocol

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from msg_agents.doctor.qos.connection import Connection
from msg_agents.nodes.qos.reader import Reader
from msg_agents.nodes.qos.writer import Writer


class Part(Protocol):
    """What a writer and a reader have in common."""

    def handle(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is requested; the answer."""

    def idle(self) -> None:
        """Return when a request is there, and do until then what is to be done all the time."""


def serve_requests(role: str, name: str, connection: Connection, introduction: int | None) -> None:
    """Handle requests until one says ``leave``, or the other side has gone.

    ``introduction``: see ``write_introduction``; None: the processes look for each other.
    """
    rclpy.init(args=[], signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node(
        name,
        enable_rosout=False,
        start_parameter_services=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )
    make: type[Writer | Reader] = Writer if role == "writer" else Reader
    part: Part = make(node, connection, introduction)
    while True:
        part.idle()
        request = connection.receive()
        if request is None or request["command"] == "leave":
            break
        if request["command"] == "identify":
            connection.send({"middleware": rclpy.get_rmw_implementation_identifier()})
        else:
            connection.send(part.handle(request))
    node.destroy_node()
    rclpy.try_shutdown()
