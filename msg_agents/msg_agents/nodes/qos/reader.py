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

"""A reader: one subscription for each try."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import UInt64

from msg_agents.doctor.qos.connection import Connection
from msg_agents.nodes.qos.requests import introduce, requested_profile

PAUSE = 0.005  # s for a message, before it is looked whether a request is there
CHECK = 0.05  # s between two looks whether all has come, while messages come


class Reader:
    """Takes what comes on several topics, and notes when."""

    def __init__(self, node: Node, connection: Connection, introduction: int | None) -> None:
        self._node = node
        self._connection = connection
        self._introduction = introduction
        self._wait_set: Any = None  # what executors of rclpy wait with
        self._subscriptions: list[Subscription] = []
        self._numbers: list[list[int]] = []
        self._times: list[list[int]] = []
        self._period = 0.0  # s between two messages that are taken from one topic; 0: as they come
        self._newest = 0.0  # time of the newest message

    def idle(self) -> None:
        """Take messages until a request is there."""
        while not self._connection.waits(0 if self._subscriptions else None):
            self._take()

    def handle(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is requested; the answer."""
        match request["command"]:
            case "join":
                self._join(request)
                return {"discovered": self._await_writer(request["seconds"])}
            case "pace":
                self._period = request["period"]
            case "await":
                self._await_messages(range(*request["must"]), range(*request["may"]), request)
            case "linger":
                self._take_until(lambda: False, request["seconds"])
            case "report":
                return {"received": [list(pair) for pair in zip(self._numbers, self._times, strict=True)]}
        return {}

    def _join(self, request: dict[str, Any]) -> None:
        profile = requested_profile(request)
        self._numbers = [[] for _ in request["topics"]]
        self._times = [[] for _ in request["topics"]]
        self._subscriptions = [
            self._node.create_subscription(UInt64, topic, lambda _: None, profile) for topic in request["topics"]
        ]
        self._wait_set = rclpy_implementation.WaitSet(
            len(self._subscriptions), 0, 0, 0, 0, 0, self._node.context.handle
        )
        if self._introduction is not None:
            introduce(self._node, self._introduction, request["topics"][0])
            self._introduction = None

    def _await_writer(self, seconds: float) -> list[bool]:
        def counts() -> list[bool]:
            return [subscription.get_publisher_count() > 0 for subscription in self._subscriptions]

        self._take_until(lambda: all(counts()), seconds)
        return counts()

    def _await_messages(self, must: range, may: range, request: dict[str, Any]) -> None:
        """Until all that must come has come, and nothing more comes that may."""

        def complete() -> bool:
            sets = [set(numbers) for numbers in self._numbers]
            if all(there.issuperset(may) for there in sets):
                return True
            quiet = time.monotonic() - max(self._newest, began) > request["quiet"]
            return quiet and all(there.issuperset(must) for there in sets)

        began = time.monotonic()
        self._take_until(complete, request["seconds"])

    def _take_until(self, condition: Callable[[], bool], seconds: float) -> None:
        """Take messages until the condition is true, for so long at most."""
        began = looked = time.monotonic()
        while (now := time.monotonic()) - began < seconds:
            if not self._take() or now - looked > CHECK:
                looked = now
                if condition():
                    return

    def _take(self) -> bool:
        """Wait a little for messages and take those that are there; whether there were any."""
        if self._period:
            time.sleep(self._period)
        else:
            self._wait_set.clear_entities()
            for subscription in self._subscriptions:
                self._wait_set.add_subscription(subscription.handle)
            self._wait_set.wait(int(PAUSE * 1e9))
        some = False
        for subscription, numbers, times in zip(self._subscriptions, self._numbers, self._times, strict=True):
            while (found := subscription.handle.take_message(UInt64, False)) is not None:
                numbers.append(found[0].data)
                times.append(time.monotonic_ns())
                some = True
                if self._period:
                    break
        if some:
            self._newest = time.monotonic()
        return some
