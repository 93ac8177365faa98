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

"""Requests and answers, one JSON object per line, between the command and a process that publishes or reads."""

from __future__ import annotations

import json
import select
import socket
from typing import Any


class Connection:
    """One end. Each request gets one answer, and there is no other request before it."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._lines = end.makefile("rb")

    def send(self, document: dict[str, Any]) -> None:
        """Send one; OSError if the other end has gone."""
        self._socket.sendall(json.dumps(document).encode() + b"\n")

    def receive(self) -> dict[str, Any] | None:
        """Wait for the next one; None if the other end has gone."""
        line = self._lines.readline()
        return json.loads(line) if line.endswith(b"\n") else None

    def waits(self, seconds: float | None) -> bool:
        """Whether something comes within this time (None: however long it takes)."""
        return bool(select.select([self._socket], [], [], seconds)[0])

    def close(self) -> None:
        """Close this end."""
        self._lines.close()
        self._socket.close()
