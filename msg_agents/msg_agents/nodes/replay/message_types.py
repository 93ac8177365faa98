"""Message types of the topics of a bag, as they are installed here."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_analysis.bags.playback import BagTopic
from msg_analysis.errors import InputError


def message_class(type_name: str) -> Any:
    """Class of a message type, ``package/msg/Name``.

    Parameters
    ----------
    type_name
        such as std_msgs/msg/String

    Raises
    ------
    ImportError, AttributeError, ValueError
        there is none of this name here
    """
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def message_classes(topics: Iterable[BagTopic], *, all_wanted: bool, on_note: Callable[[str], None]) -> dict[str, Any]:
    """Message classes of the topics that can be played, by name.

    Parameters
    ----------
    topics
        of the bag
    all_wanted
        whether somebody asked for just these, so that none may be left out
    on_note
        told which are left out

    Raises
    ------
    InputError
        one cannot be played that must be, or none can
    """
    found, unplayable = {}, []
    for topic in topics:
        if topic.encoding != "cdr":
            unplayable.append(f"{topic.name} (its messages are {topic.encoding or 'of no known encoding'}, not cdr)")
            continue
        try:
            found[topic.name] = message_class(topic.type_name)
        except (ImportError, AttributeError, ValueError):
            unplayable.append(f"{topic.name} (the type {topic.type_name or '?'} is not installed here)")
    if unplayable and (all_wanted or not found):
        raise InputError(f"cannot be played: {', '.join(unplayable)}: install it, or leave it out with --exclude")
    for line in unplayable:
        on_note(f"not played: {line}")
    return found


def check_definitions(node: Node, writers: Mapping[str, Publisher], topics: Mapping[str, BagTopic]) -> None:
    """Recorded bytes mean something else under another definition of a type of that name.

    Parameters
    ----------
    node
        that publishes
    writers
        its publishers, by name of the topic in the bag
    topics
        of the bag, by name

    Raises
    ------
    InputError
        a topic was recorded with another definition
    """
    for name, publisher in writers.items():
        recorded = topics[name].type_hash
        ours = {
            str(info.topic_type_hash)
            for info in node.get_publishers_info_by_topic(publisher.topic_name)
            if info.node_name == node.get_name()
        }
        if recorded and ours and recorded not in ours:
            raise InputError(
                f"topic {name}: was recorded with another definition of {topics[name].type_name} than is "
                f"installed here ({recorded}, here {ours.pop()}): install that version, or leave it out with "
                "--exclude"
            )
