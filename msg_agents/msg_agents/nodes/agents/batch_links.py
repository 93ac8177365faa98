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

"""States between processes that hear most of a network: in the batches for the recorder, not on a topic per agent."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from msg_agents.discovery.rtps import PREFIX_SIZE
from msg_agents.nodes.network_node import NetworkNode
from msg_agents.processes.process_plan import RECORDER
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.receiving import fault_of, state_frame, why_refused
from msg_analysis.wire.refusals import Refusal
from msg_analysis.wire.state_batches import decode_batch
from msg_analysis.wire.topics import STATE, STATES, agent_name

ONLY_TOPICS = "MSG_AGENTS_ONLY_TOPICS"  # variable that turns this off where it is set, for comparison
FEWEST = 16
"""Agents of other processes that a process must hear to read batches: below, it reads a topic of each, which is seen in
the ROS graph, and costs little."""

FRESH = 0.02  # s for which what was found out about other processes is not looked up again


@dataclass(frozen=True, slots=True)
class Listener:
    """An agent of this process that hears one of another process."""

    hear: Callable[[int, int, int, bytes, bytes], str | None]  # see ``Agent.hear``
    refuse: Callable[[str, str], None]  # see ``NetworkNode.refuse``


def hears_most(far: int, others: int) -> bool:
    """Whether a process that hears ``far`` of ``others`` agents in other processes is to read the batches of all.

    It then reads at most twice as many states as it needs, in as many messages as there are processes.
    """
    return far >= FEWEST and 2 * far > others and ONLY_TOPICS not in os.environ


class BatchLinks:
    """Of one process, on the node ``host``: whom it hears by batches, and who hears it by the batches it publishes.

    Processes are told apart by the GUIDs of their endpoints, since other nodes do not say which agents they run with.
    """

    def __init__(self, host: NetworkNode, publisher: Publisher, agents: Iterable[int]) -> None:
        self._host = host
        self._publisher = publisher
        self._others = [i for i in range(host.record.experiment.agents) if i not in set(agents)]
        self._names = [STATE.of(agent) for agent in range(host.record.experiment.agents)]
        self._frame = state_frame(host.record, whole=False)
        self._graphs = len(host.record.experiment.graph_list)
        self._listeners: Mapping[int, Sequence[Listener]] = {}
        self._subscription: Subscription | None = None
        self.heard = False  # whether agents of other processes have ever been found to hear this one by batches
        self._reached: frozenset[str] = frozenset()
        self._looked = -FRESH

    def listen(self, listeners: Mapping[int, Sequence[Listener]]) -> bool:
        """Hear these agents (indices from 0) by batches, if that pays; otherwise False."""
        if not hears_most(len(listeners), len(self._others)):
            return False
        self._listeners = listeners
        self._subscription = self._host.subscribe(STATES, self._receive)
        return True

    def reached(self) -> frozenset[str]:
        """Names of the agents of other processes whose process reads the batches of this one."""
        now = time.monotonic()
        if len(self._others) >= FEWEST and now >= self._looked + FRESH:
            self._looked = now
            self._reached = self._find_reached()
            self.heard = self.heard or bool(self._reached)
        return self._reached

    def _find_reached(self) -> frozenset[str]:
        readers = self._host.get_subscriptions_info_by_topic(self._publisher.topic_name)
        processes = {bytes(r.endpoint_gid[:PREFIX_SIZE]) for r in readers if r.node_name != RECORDER}
        if not processes or self._host.missing_readers(self._publisher, []):  # they have not been matched yet
            return frozenset()
        return frozenset(agent_name(i) for i in self._others if self._runs_in(i, processes))

    def hears_all(self) -> bool:
        """Whether all processes that are to be heard by batches, if any, have been discovered."""
        if self._subscription is None:
            return True
        writers = self._host.get_publishers_info_by_topic(self._publisher.topic_name)
        processes = {bytes(w.endpoint_gid[:PREFIX_SIZE]) for w in writers}
        matched = self._subscription.get_publisher_count() >= len(writers)
        return matched and all(self._runs_in(i, processes) for i in self._listeners)

    def _runs_in(self, agent: int, processes: set[bytes]) -> bool:
        """Whether an agent has been discovered, in these processes only: a killed one may still be known."""
        writers = self._host.get_publishers_info_by_topic(self._host.resolve_topic_name(self._names[agent]))
        own = {bytes(w.endpoint_gid[:PREFIX_SIZE]) for w in writers if w.node_name == agent_name(agent)}
        return bool(own) and own <= processes

    def _receive(self, data: bytes) -> None:
        try:
            run, sizes, messages = decode_batch(data)
        except CdrError:
            self._host.refuse(Refusal.UNDECODABLE, STATES.name)
            return
        if run != self._host.run:
            self._host.refuse(Refusal.OTHER_RUN, STATES.name)
            return
        start = 0
        for size in sizes.tolist():
            self._take(messages[start : start + size])
            start += size

    def _take(self, message: bytes) -> None:
        """A state. Hot path."""
        found = self._frame.unwrap(message)
        if found is None or not 1 <= found[0] <= len(self._names):
            self._host.refuse(why_refused(message, self._host.record, None, self._frame), STATES.name)
            return
        number, step, mode, state = found
        listeners = self._listeners.get(number - 1)
        if not listeners:  # of this process, or of no interest to it
            return
        topic = self._names[number - 1]
        fault = fault_of(step, mode, state, self._graphs)
        for listener in listeners:
            reason = fault or listener.hear(number - 1, step, mode, state, message)
            if reason:
                listener.refuse(reason, topic)
