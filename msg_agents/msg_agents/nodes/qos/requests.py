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

"""What writers and readers do with their requests: quality of service, and how they are introduced to each other."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from msg_agents.discovery.introducer import write_introduction
from msg_agents.discovery.rtps import PREFIX_SIZE
from msg_agents.nodes.ros.qos import ros_profile
from msg_analysis.wire.topics import Qos


def requested_profile(request: dict[str, Any]) -> QoSProfile:
    """The profile that a request names by the fields of ``Qos``."""
    return ros_profile(Qos(**request["qos"]))


def introduce(node: Node, descriptor: int, topic: str) -> None:
    """Tell the introducer that this process has all its endpoints, one of them on this topic."""
    endpoints = [*node.get_publishers_info_by_topic(topic), *node.get_subscriptions_info_by_topic(topic)]
    own = [bytes(each.endpoint_gid[:PREFIX_SIZE]) for each in endpoints if each.node_name == node.get_name()]
    write_introduction(descriptor, node.get_name(), own[0] if own else b"")
