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

"""Waits for the readers of a player's topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_agents.processes.environment import discovery_scope
from msg_analysis.errors import InputError

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
