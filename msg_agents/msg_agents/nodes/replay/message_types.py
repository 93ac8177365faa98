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

"""Message types of a bag's topics, as they are installed here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_agents.nodes.ros.lean_node import message_class
from msg_analysis.bags.playback import BagTopic
from msg_analysis.errors import InputError


def message_classes(topics: Iterable[BagTopic], *, all_wanted: bool, on_note: Callable[[str], None]) -> dict[str, Any]:
    """Message classes by topic name, without the topics that cannot be played; a note names those.

    InputError: none can be played, or not all where ``all_wanted`` says that the user chose these topics.
    """
    found, unplayable = {}, []
    for topic in topics:
        if topic.encoding != "cdr":
            unplayable.append(f"{topic.name} (the encoding of its messages is {topic.encoding or 'unknown'}, not cdr)")
            continue
        try:
            found[topic.name] = message_class(topic.type_name)
        except (ImportError, AttributeError, ValueError):
            unplayable.append(f"{topic.name} (the type {topic.type_name or '?'} is not installed here)")
    if unplayable and (all_wanted or not found):
        raise InputError(
            f"cannot be played: {', '.join(unplayable)}: install the type, or leave the topic out with --exclude"
        )
    for line in unplayable:
        on_note(f"not played: {line}")
    return found


def check_definitions(node: Node, writers: Mapping[str, Publisher], topics: Mapping[str, BagTopic]) -> None:
    """InputError if a topic was recorded with another definition of its type: its bytes mean something else."""
    for name, publisher in writers.items():
        recorded = topics[name].type_hash
        ours = {
            str(info.topic_type_hash)
            for info in node.get_publishers_info_by_topic(publisher.topic_name)
            if info.node_name == node.get_name()
        }
        if recorded and ours and recorded not in ours:
            raise InputError(
                f"topic {name}: was recorded with another definition of {topics[name].type_name} ({recorded}) than the "
                f"installed one ({ours.pop()}): install that version, or leave the topic out with --exclude"
            )
