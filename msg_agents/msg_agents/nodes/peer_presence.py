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

"""Ends a process when nodes without which its run cannot go on have left the network."""

from __future__ import annotations

import time

from msg_agents.nodes.network_node import NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_analysis.errors import InputError

CHECK_PERIOD = 1.0  # s between two checks


class PeersLostError(InputError):
    """Nodes without which the run cannot go on left before its end."""


class PeerPresence:
    """Ends the process of a node when one of its required peers has been gone for longer than ``patience`` s.

    A peer is gone when it has left the network or its lease has ended; ``patience`` allows for a restart. On one
    machine the supervisor ends all processes when one is lost; across hosts nothing else does.
    """

    def __init__(self, node: NetworkNode, patience: float) -> None:
        self._node, self._patience = node, patience
        self._since: dict[str, float] = {}  # monotonic time [s] since which a peer is gone, by name
        every(node, CHECK_PERIOD, self._check)

    def _check(self) -> None:
        now = time.monotonic()
        gone = self._node.undiscovered(self._node.required_peers())
        self._since = {name: self._since.get(name, now) for name in gone}
        if now - min(self._since.values(), default=now) > self._patience:
            self._node.fail(
                PeersLostError(
                    f"{', '.join(self._since)} left the network before the end of the run and did not return "
                    f"within {self._patience:g} s: see the messages on the host that runs it"
                )
            )
