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

"""The states of the agents of a process on their way to the recorder: few messages with many states each.

Processes that hear most of a network read them, too: see ``batch_links``.
"""

from __future__ import annotations

import time

from rclpy.publisher import Publisher

from msg_agents.discovery.profiles import has_profile_for
from msg_agents.nodes.network_node import NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_agents.processes.process_plan import RECORDER
from msg_analysis.wire.state_batches import encode_batch
from msg_analysis.wire.topics import Topic

BATCH_SIZE, SMALL_BATCH_SIZE = 60_000, 2**13
"""Bytes after which a batch is sent. Before the agents wait for a recorder that has stopped, the middleware keeps 680
batches for it by our profiles for one machine, and 5,000 by others: 40 MB in either case. One fits into a datagram."""

BATCH_TIME = 0.1  # s of wall time after which a batch is sent with the next state, however small it is
SEND_PERIOD = 0.5  # s of wall time after which it is sent in any case


class StateBatches:
    """Collects the messages of a kind of states (``topic``: STATES or TRUTHS), and sends them from ``node``."""

    def __init__(self, node: NetworkNode, topic: Topic) -> None:
        self._node = node
        self.publisher: Publisher = node.publisher_of(topic)
        self._messages: list[bytes] = []
        self._size, self._due = 0, 0.0
        self._found = False
        bounded = has_profile_for(self.publisher.topic_name)
        self._full = BATCH_SIZE if bounded else SMALL_BATCH_SIZE
        every(node, SEND_PERIOD, self.send)

    def add(self, message: bytes) -> None:
        """Send a message, later and with others. Hot path."""
        if not self._messages:
            self._due = time.monotonic() + BATCH_TIME
        self._messages.append(message)
        self._size += len(message)
        if self._size >= self._full or time.monotonic() >= self._due:
            self.send()

    def send(self) -> None:
        """Send what is there now."""
        if self._messages:
            batch = encode_batch(self._node.run, self._messages)
            self._messages.clear()
            self._size = 0
            self._node.publish(self.publisher, batch)

    def missing_nodes(self) -> list[str]:
        """The recorder, until it has been discovered."""
        self._found = self._found or self._node.has_readers(self.publisher, [RECORDER])
        return [] if self._found else [RECORDER]
