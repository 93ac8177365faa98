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

"""A writer: one publisher for each try."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import UInt64

from msg_agents.doctor.qos.connection import Connection
from msg_agents.nodes.qos.requests import introduce, requested_profile
from msg_agents.nodes.ros.rclpy_error import RCLError

POLL = 0.002  # s


class Writer:
    """Publishes numbers on several topics, in turn."""

    def __init__(self, node: Node, connection: Connection, introduction: int | None) -> None:
        self._node = node
        self._connection = connection
        self._introduction = introduction
        self._publishers: list[Publisher] = []
        self._before: list[int] = []  # readers of each topic, before others join
        self._sent: list[dict[int, int]] = []  # time [ns] by number

    def idle(self) -> None:
        """Wait for a request."""
        self._connection.waits(None)

    def handle(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is requested; the answer."""
        match request["command"]:
            case "create":
                profile = requested_profile(request)
                self._publishers = [self._node.create_publisher(UInt64, topic, profile) for topic in request["topics"]]
                self._sent = [{} for _ in self._publishers]
                self._before = [0 for _ in self._publishers]
                if self._introduction is not None:
                    introduce(self._node, self._introduction, request["topics"][0])
                    self._introduction = None
            case "await_readers":
                return {"discovered": self._await_readers(request["count"], request["seconds"])}
            case "publish":
                self._publish(range(*request["numbers"]), request["period"])
            case "report":
                return {"sent": [[list(sent), list(sent.values())] for sent in self._sent]}
            case "close":
                for publisher in self._publishers:
                    self._node.destroy_publisher(publisher)
                self._publishers = []
        return {}

    def _await_readers(self, count: int, seconds: float) -> list[bool]:
        """Whether each publisher has discovered so many more readers than before."""
        # A killed reader is still counted until the middleware notices its end, after seconds or at once.
        began = time.monotonic()
        while True:
            found = self._counts()
            more = [new >= old + count for new, old in zip(found, self._before, strict=True)]
            if all(more) or time.monotonic() - began > seconds:
                return more
            self._before = [min(pair) for pair in zip(found, self._before, strict=True)]
            time.sleep(POLL)

    def _counts(self) -> list[int]:
        return [publisher.get_subscription_count() for publisher in self._publishers]

    def _publish(self, numbers: range, period: float) -> None:
        """``period``: seconds between two messages of a topic; 0: as fast as possible."""
        due = time.monotonic()
        for number in numbers:
            for publisher, sent in zip(self._publishers, self._sent, strict=True):
                now = time.monotonic_ns()
                try:
                    publisher.publish(UInt64(data=number))
                except RCLError:  # the middleware did not take it in time
                    continue
                sent[number] = now
            due += period
            if (left := due - time.monotonic()) > 0:
                time.sleep(left)
            else:
                due = time.monotonic()  # no hurry after a delay
        self._before = self._counts()
