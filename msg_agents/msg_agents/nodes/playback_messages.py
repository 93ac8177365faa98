# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Messages of a bag for the player: types and readers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_agents.environment import discovery_scope
from msg_agents.nodes.ros import message_class
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


SETTLED = 0.8  # s without a change in the readers, after which discovery counts as finished
SETTLE_LIMIT = 5.0  # s after which it counts as finished in any case
NOTE_DELAY = 2.0  # s after which a note says what is missing
LONGEST_POLL = 1.0  # s; a longer gap between two looks counts as this much: the process was stopped


class RequiredReaders:
    """The readers of a player's topics. Latched topics are not waited for, unless all are latched."""

    def __init__(
        self,
        node: Node,
        writers: Mapping[str, Publisher],
        latched: Iterable[str],  # keys of ``writers``
        *,
        subscribers: int,  # readers that every awaited topic must have
        readers: Sequence[str],  # names of nodes that must read every awaited topic
        timeout: float,  # s
    ) -> None:
        self._node, self._subscribers, self._readers, self._timeout = node, subscribers, readers, timeout
        self._writers = list(writers.values())
        self._awaited = [writers[name] for name in sorted(writers.keys() - set(latched) or writers.keys())]

    def wait(self, pause: Callable[[], None], on_note: Callable[[str], None]) -> None:
        """Wait for the required readers, and in any case until no more readers are being discovered.

        ``pause`` takes some time between two looks. InputError: required readers are missing after the timeout.
        """
        looked = time.monotonic()
        waited = changed = 0.0
        counts: list[int] = []
        noted = False
        while True:
            now = time.monotonic()
            waited, looked = waited + min(now - looked, LONGEST_POLL), now
            missing = self._missing()
            before, counts = counts, [each.get_subscription_count() for each in self._writers]
            if counts != before:
                changed = waited
            if not missing and (waited > changed + SETTLED or waited > SETTLE_LIMIT):
                break
            if missing and waited > self._timeout:
                raise InputError(
                    f"after {self._timeout:g} s {'; '.join(missing)}. Are they running {discovery_scope()}?"
                )
            if missing and not noted and waited > NOTE_DELAY:
                noted = True
                on_note(f"waiting for readers, {self._timeout:g} s at most: {'; '.join(missing)}")
            pause()
        others = [each.topic_name for each in self._writers if self._node.count_publishers(each.topic_name) > 1]
        if others:
            on_note(f"other nodes publish as well: {', '.join(others)}")

    def _missing(self) -> list[str]:
        """Unmet requirements in words."""
        few, without = [], dict[str, list[str]]()
        for writer in self._awaited:
            count = writer.get_subscription_count()
            if count < self._subscribers:
                few.append(f"{writer.topic_name} ({count})")
            if self._readers:
                infos = self._node.get_subscriptions_info_by_topic(writer.topic_name)
                here = {info.node_name for info in infos}
                here |= {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
                for reader in self._readers:
                    if reader not in here or count < 1:
                        without.setdefault(reader, []).append(writer.topic_name)
        lines = [f"fewer than {self._subscribers} read {', '.join(few)}"] if few else []
        return lines + [f"{reader} does not read {', '.join(topics)}" for reader, topics in without.items()]
