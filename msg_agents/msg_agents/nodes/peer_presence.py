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
"""Ends a process when nodes without which its run cannot go on have left the network, and says so when it leaves."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.duration import Duration

from msg_agents.nodes.network_node import NOT_AN_AGENT, NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_agents.processes.process_plan import RECORDER, SWITCHER
from msg_analysis.errors import InputError
from msg_analysis.wire import topics
from msg_analysis.wire.topics import agent_name

CHECK_PERIOD = 1.0  # s between two checks
FAREWELL = 2.0  # s that the others have to acknowledge that this process leaves


class PeersLostError(InputError):
    """Nodes without which the run cannot go on left before its end."""


class PeerPresence:
    """Ends the process of some nodes when one of the required peers of the first has been gone for ``patience`` s.

    A peer is gone when it has left the network or its lease has ended; ``patience`` allows for a restart. One that has
    said that it leaves does not come back. (RTPS says that once, best effort, so it is not enough.)
    """

    # On one machine the supervisor ends all processes when one is lost; across hosts nothing else does.

    def __init__(self, nodes: Sequence[NetworkNode], patience: float) -> None:
        self._nodes, self._node, self._patience = nodes, nodes[0], patience
        self._since: dict[str, float] = {}  # monotonic time [s] since which a peer is gone, by name
        self._left: set[str] = set()  # names that have said that they leave
        self._returning: list[NetworkNode] = []  # nodes of this process that have to make good what was missed
        self._publisher = self._node.publisher_of(topics.LEAVE)
        self._node.subscribe(topics.LEAVE, self._receive)

    def begin(self) -> None:
        """Check from now on: all nodes have been discovered."""
        every(self._node, CHECK_PERIOD, self._check)

    def leave(self) -> None:
        """Say that this process leaves before the end of the run."""
        numbers = {node.number for node in self._nodes}
        for number in numbers:
            self._node.publish(self._publisher, self._node.progress(topics.LEAVE, number, 0))
        self._publisher.wait_for_all_acked(Duration(seconds=FAREWELL))

    def _receive(self, data: bytes) -> None:
        message = self._node.decode_progress(data, topics.LEAVE)
        if message is not None:
            of_home = message.agent == NOT_AN_AGENT  # where one of them is, the other is, too
            self._left |= {SWITCHER, RECORDER} if of_home else {agent_name(message.agent - 1)}
            self._check()

    def _check(self) -> None:
        required = self._node.required_peers()
        if left := [name for name in required if name in self._left]:
            self._fail(left, "")
            return
        now = time.monotonic()
        gone = self._node.undiscovered(required)
        if gone:
            self._introduce_again()
        if self._since.keys() - gone:
            self._returning = list(self._nodes)
        self._since = {name: self._since.get(name, now) for name in gone}
        self._returning = [node for node in self._returning if not node.rejoin()]
        if now - min(self._since.values(), default=now) > self._patience:
            self._fail(list(self._since), f" and did not return within {self._patience:g} s")

    def _introduce_again(self) -> None:
        """Make ROS tell the others the names of our nodes: who had given us up does not ask for them.

        It tells them with every new endpoint; to a reader that it takes for a known one, DDS repeats nothing.
        """
        self._node.destroy_publisher(self._node.publisher_of(topics.LEAVE))

    def _fail(self, names: Sequence[str], more: str) -> None:
        self._node.fail(
            PeersLostError(
                f"{', '.join(names)} left the network before the end of the run{more}: see the messages on the host "
                "that runs it"
            )
        )
