# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What all nodes of a network have in common: messages of their run, discovery, health, presence of their peers."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.node import NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.task import Future

from msg_agents.environment import discovery_scope
from msg_agents.nodes.ros import LeanNode, every, until_shutdown
from msg_agents.process_layout import RECORDER, SWITCHER
from msg_agents.run.result import write_report
from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.errors import InputError
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal, RunRules, sign
from msg_analysis.messages.messages import ActiveGraph, Progress
from msg_analysis.messages.topics import Topic, agent_node_name
from msg_analysis.model.run_record import RunRecord

DIAGNOSTICS_PERIOD = 1.0  # s
CLOCK_BOUND = "clock ahead of the switcher's by at most [ms]"  # a value of agents in real time
ACK_TIMEOUT = 4.0  # s for readers to acknowledge the last messages; more than Fast DDS's default heartbeat period, 3 s
BARE = "_CREATED_BY_BARE_DDS_APP_"  # name of the node of a reader whose participant has no known nodes
NOT_AN_AGENT = 0  # in Progress: the recorder or the switcher
Message = TypeVar("Message", ActiveGraph, Progress)
CHECK_PERIOD = 1.0  # s between two checks
SHUTDOWN_TIMEOUT = 2.0  # s that the others have to acknowledge that this process leaves


@dataclass(slots=True)
class Health:
    """The health of a node."""

    message: str  # one line
    waiting: bool = False  # cannot continue, or cannot keep up, at present
    values: dict[str, str] = field(default_factory=dict)

    def to_status(self, node: NetworkNode) -> DiagnosticStatus:
        """The diagnostic message about a node."""
        counts = {f"refused on {topic}: {reason}": str(count) for (topic, reason), count in node.refused.items()}
        values = self.values | counts
        if node.repeated:
            values[Refusal.REPEATED] = str(node.repeated)
        return DiagnosticStatus(  # refused messages are a warning: other nodes publish on the topics of the run
            level=DiagnosticStatus.WARN if self.waiting or node.refused else DiagnosticStatus.OK,
            name=f"{node.get_fully_qualified_name().lstrip('/')}: network",
            message=self.message,
            hardware_id="",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


class NetworkNode(LeanNode):
    """A node of a run, whose id is in every message. ``done`` ends the node, with an error or without."""

    def __init__(self, name: str, *, record: RunRecord) -> None:
        super().__init__(name)
        if self.get_name() != name:
            raise InputError(
                f"--ros-args: __node:={self.get_name()}: expected {name}, because the nodes of a run find each other "
                "by name: give no name (none in a launch file either), or choose a namespace instead, __ns:=/..."
            )
        self.record = record
        self.run = record.run.bytes
        self._step_clock = StepClock(record.experiment.step_length)
        self.done: Future = Future()
        self.refused: Counter[tuple[str, str]] = Counter()  # by topic and reason
        self.repeated = 0

    def refuse(self, reason: str, topic: str) -> None:
        """Count a message that is not part of this run, and warn at the first one per topic and reason."""
        if reason == Refusal.REPEATED:  # only counted: agents send again what a restarted one may have missed
            self.repeated += 1
            return
        self.refused[topic, reason] += 1
        if self.refused[topic, reason] == 1:
            self.get_logger().warning(f"refused a message on {topic}: {reason} (further ones are only counted)")

    @property
    def number(self) -> int:
        """In messages: that of its agent, from 1."""
        return NOT_AN_AGENT

    def rejoin(self) -> bool:
        """Make good what others may have missed while the network was cut; False: not possible yet, ask again."""
        return True

    def health(self) -> Health:
        """State of this node; called about once a second."""
        raise NotImplementedError

    def discovered_all(self) -> bool:
        """Whether all nodes that should read what this node publishes have been discovered; polled."""
        return not self.missing_nodes()

    @property
    def resumed(self) -> bool:
        """Whether it takes the place of a killed one, for which the others wait."""
        return False

    def missing_nodes(self) -> list[str]:
        """Names of the nodes that have not been discovered yet."""
        return []

    def required_peers(self) -> list[str]:
        """Names of the nodes without which the run cannot go on; the peers of an agent would be too many to check."""
        return [SWITCHER]

    def missing_clock(self) -> list[str]:
        """The publisher of ``/clock``, if one is needed and has not been discovered."""
        if not self.get_parameter("use_sim_time").value or self.count_publishers(topics.CLOCK.name):
            return []
        return [f"a publisher of {topics.CLOCK.name}"]

    def names_in_namespace(self) -> Counter[str]:
        """How many nodes have each name, in the namespace of the run; other runs may share the domain."""
        here = self.get_namespace()
        return Counter(name for name, namespace in self.get_node_names_and_namespaces() if namespace == here)

    def _own_names(self) -> list[str]:
        return [*map(agent_node_name, range(self.record.experiment.agents)), SWITCHER, RECORDER]

    def duplicate_names(self) -> list[str]:
        """Names of this run that more than one node has."""
        count = self.names_in_namespace()
        return [name for name in self._own_names() if count[name] > 1]

    def undiscovered(self, expected: Iterable[str]) -> list[str]:
        """Those of the expected nodes that are not there: nodes of the run in its namespace, others in any."""
        # Recorders such as that of ``ros2 bag record`` are always in the namespace /.
        here, everywhere = self.names_in_namespace(), set(self.get_node_names())
        own = set(self._own_names())
        return [name for name in expected if name not in (here if name in own else everywhere)]

    def duplicate_name_error(self, names: Iterable[str], seconds: float) -> InputError:
        """The error after several nodes have had the same name for so many seconds."""
        return InputError(
            f"after {seconds:.0f} s more than one node was still called {', '.join(names)}, {discovery_scope()}: end "
            "the other process, or choose another domain"
        )

    def begin(self) -> None:
        """Start: all nodes have been discovered."""

    def finish(self, *, complete: bool, deadline: float) -> None:
        """The process is about to end, its part ``complete`` or not; it may wait until ``deadline`` [s, monotonic]."""

    def fail(self, error: Exception) -> None:
        """End the process with an error."""
        if not self.done.done():
            self.done.set_exception(error)

    def compare_record(self) -> None:
        """Fail where the switcher has another record of this run: each would wait for what the other never sends."""

        def receive(data: bytes) -> None:
            message = self.decode_progress(data, topics.RECORD)
            if message and message.stamp != self.record.digest:
                words = f"{self.get_name()} has another run record than the switcher, both of run {self.record.run}"
                self.fail(InputError(f"{words}: give all nodes the same file, and the same version of this software"))

        self.subscribe(topics.RECORD, receive)

    def finish_at_end(self, nodes: Iterable[NetworkNode] | None = None) -> None:
        """End these nodes of the process (default: this one) when the switcher announces the end of the run."""
        # With a node that ends earlier, unread messages or acknowledgements that others need would be lost.
        ending = [self] if nodes is None else list(nodes)

        def receive(data: bytes) -> None:
            if self.decode_progress(data, topics.END):
                for node in ending:
                    if not node.done.done():
                        node.done.set_result(None)

        self.subscribe(topics.END, receive)

    @cached_property
    def rules(self) -> RunRules:
        """Which messages belong to the run."""
        return RunRules(self.record)

    def decode_progress(self, data: bytes, topic: Topic) -> Progress | None:
        """A message of this run, on one of its topics; None, and counted, if the bytes are not one."""
        return self.accepted(self.rules.progress(data, topic), topic)

    def accepted(self, found: Message | str, topic: Topic) -> Message | None:
        """What ``rules`` give for a message; None, and counted, if it is the reason of a refusal."""
        if isinstance(found, str):
            self.refuse(found, topic.name)
            return None
        return found

    def progress(self, topic: Topic, agent: int, step: int, stamp: int | None = None) -> bytes:
        """Bytes of a Progress message; ``agent``: number from 1, or NOT_AN_AGENT; ``stamp`` [ns]: None: of the step."""
        time = self._step_clock.nanoseconds(step) if stamp is None else stamp
        return sign(Progress(time, self.run, agent, step), topic, self.record.key).encode()

    def has_readers(self, publisher: Publisher, expected: Sequence[str]) -> bool:
        """Whether all the expected nodes read a topic of this node."""
        # Reading the names inspects every endpoint of the network: only once enough readers are there.
        return publisher.get_subscription_count() >= len(expected) and not self.missing_readers(publisher, expected)

    def has_other_readers(self, publisher: Publisher, *, reliable: bool = True) -> bool:
        """Whether a node that is not part of the run reads a topic of this node, reliably or with best effort."""
        own = {RECORDER, *map(agent_node_name, range(self.record.experiment.agents))}
        return any(
            reader.node_name not in own and (reader.qos_profile.reliability == ReliabilityPolicy.RELIABLE) == reliable
            for reader in self.get_subscriptions_info_by_topic(publisher.topic_name)
        )

    def _announced_reader(self, name: str, topic: str) -> bool:
        """Whether a node of this name has announced a reader of a topic that is known."""
        # From Fast DDS 3 on, readers of Cyclone DDS have no node: it does not repeat to which participant each belongs.
        for node, namespace in self.get_node_names_and_namespaces():
            if node == name:
                with contextlib.suppress(NodeNameNonExistentError):  # it has just left
                    if topic in dict(self.get_subscriber_names_and_types_by_node(name, namespace)):
                        return True
        return False

    def missing_readers(self, publisher: Publisher, expected: Sequence[str]) -> list[str]:
        """Names of the expected nodes that do not read a topic of this node yet."""
        readers = self.get_subscriptions_info_by_topic(publisher.topic_name)
        found = {reader.node_name for reader in readers}
        missing = [name for name in expected if name not in found]
        if missing and BARE in found:
            missing = [name for name in missing if not self._announced_reader(name, publisher.topic_name)]
        # Other readers are matched too: all must be, so that ours are among them. Readers that ask for history of a
        # topic that keeps none are never matched.
        latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        matching = sum(latched or r.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL for r in readers)
        if not missing and publisher.get_subscription_count() < matching:
            return ["(matching)"]
        return missing


class HealthReporter:
    """Publishes the health of all nodes of a process once a second, and writes its status file, if it has one."""

    def __init__(self, nodes: Sequence[NetworkNode], status_file: Path | None) -> None:
        self._nodes = nodes
        self._status_file = status_file
        self._waiting: dict[str, str] = {}
        self._publisher = nodes[0].publisher_of(topics.DIAGNOSTICS)
        every(nodes[0], DIAGNOSTICS_PERIOD, self._report)

    def _report(self) -> None:
        healths = [(node, node.health()) for node in self._nodes]
        array = DiagnosticArray(status=[health.to_status(node) for node, health in healths])
        array.header.stamp = self._nodes[0].get_clock().now().to_msg()
        with until_shutdown(self._nodes[0]):
            self._publisher.publish(array)
        self._waiting = {node.get_name(): health.message if health.waiting else "" for node, health in healths}
        self.write_status_file()

    def write_status_file(self) -> None:
        """Write the status file atomically, if there is one."""
        if self._status_file is not None:
            refused = [(node.get_name(), *what, count) for node in self._nodes for what, count in node.refused.items()]
            write_report(self._status_file, {"refused": refused, "waiting": self._waiting})


class PeersLostError(InputError):
    """Nodes without which the run cannot go on left before its end."""


class PeerPresence:
    """Ends the process of some nodes when one of the required peers of the first has been gone for ``timeout`` s."""

    # On one machine the supervisor ends all processes when one is lost; across hosts nothing else does. A peer is gone
    # when it has left the network or its lease has ended; the timeout allows for a restart. One that has said that it
    # leaves does not come back. (RTPS says that once, best effort, so it is not enough.)
    def __init__(self, nodes: Sequence[NetworkNode], timeout: float) -> None:
        self._nodes, self._node, self._timeout = nodes, nodes[0], timeout
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
        for number in {node.number for node in self._nodes}:
            self._node.publish(self._publisher, self._node.progress(topics.LEAVE, number, 0))
        self._publisher.wait_for_all_acked(Duration(seconds=SHUTDOWN_TIMEOUT))

    def _receive(self, data: bytes) -> None:
        message = self._node.decode_progress(data, topics.LEAVE)
        if message is not None:
            central = message.agent == NOT_AN_AGENT  # where one of them is, the other is, too
            self._left |= {SWITCHER, RECORDER} if central else {agent_node_name(message.agent - 1)}
            self._check()

    def _check(self) -> None:
        required = self._node.required_peers()
        if left := [name for name in required if name in self._left]:
            self._fail(left, "")
            return
        now = time.monotonic()
        gone = self._node.undiscovered(required)
        if gone:
            # Make ROS send the others the names of our nodes, as with every new endpoint: a node whose lease for us had
            # ended does not ask for them, and to a reader that it takes for a known one, DDS repeats nothing.
            self._node.destroy_publisher(self._node.publisher_of(topics.LEAVE))
        if self._since.keys() - gone:
            self._returning = list(self._nodes)
        self._since = {name: self._since.get(name, now) for name in gone}
        self._returning = [node for node in self._returning if not node.rejoin()]
        if now - min(self._since.values(), default=now) > self._timeout:
            self._fail(list(self._since), f" and did not return within {self._timeout:g} s")

    def _fail(self, names: Sequence[str], more: str) -> None:
        words = f"{', '.join(names)} left the network before the end of the run{more}"
        self._node.fail(PeersLostError(f"{words}: see the messages on the host that runs it"))
