"""What all nodes of a network have in common: topics, reasons for refusing messages, the base class."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence

from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.task import Future
from rclpy.time_source import CLOCK_TOPIC

from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.ros.lean_node import QuietNode
from msg_agents.nodes.ros.qos import LATCHED
from msg_agents.processes.process_plan import RECORDER, SWITCHER, agent_name
from msg_agents.stepping.synchronizer import Refusal
from msg_analysis.errors import InputError
from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.messages import AgentState, Progress

EXPERIMENT_TOPIC = "experiment"
GRAPH_TOPIC = "graph"
PROGRESS_TOPIC = "progress"
END_TOPIC = "end"
EPOCH_TOPIC = "epoch"
RESEND_TOPIC = "resend"
FAREWELL = 4.0  # s for readers to acknowledge the last messages; more than Fast DDS's default heartbeat period, 3 s
NOT_AN_AGENT = 0  # in Progress: the recorder or the switcher
OTHER_RUN, UNDECODABLE = "other run", "undecodable"
UNKNOWN_AGENT, OTHER_AGENT = "unknown agent", "of another agent than its topic"
WRONG_LENGTH, OTHER_LAYOUT = "wrong length", "not in the layout of the agents"
OUT_OF_RANGE = "step out of range"
RECORDED = "recorded already"
REPEATS = {Refusal.OLD, Refusal.KNOWN, RECORDED}


def state_topic(agent: int) -> str:
    """Topic of an agent's states (index from 0)."""
    return f"{agent_name(agent)}/state"


def truth_topic(agent: int) -> str:
    """Topic of an agent's true states (index from 0), if others hear a noisy state or only a part of it."""
    return f"{agent_name(agent)}/truth"


def why_not(data: bytes, record: RunRecord, agent: int, length: int) -> str:
    """Why the readers of an agent's topic (index from 0) cannot take a message; ``length``: of the states there."""
    try:
        message = AgentState.decode(data)
    except CdrError:
        return UNDECODABLE
    if message.run != record.run.bytes:
        return OTHER_RUN
    if not 1 <= message.agent <= record.experiment.agents:
        return UNKNOWN_AGENT
    if message.agent != agent + 1:
        return OTHER_AGENT
    return WRONG_LENGTH if len(message.state) != length else OTHER_LAYOUT


class NetworkNode(QuietNode):
    """A node of a run; ``record.run`` marks every message of the run. ``done`` ends the node, with an error or without.

    InputError: arguments of ROS 2 changed its name, by which the nodes of a run find each other.
    """

    def __init__(self, name: str, *, record: RunRecord) -> None:
        super().__init__(name)
        if self.get_name() != name:
            raise InputError(
                f"--ros-args: __node:={self.get_name()}: the nodes of a run know each other by their names, and this "
                f"one is {name}: leave the name alone (give none in a launch file) and choose a namespace, __ns:=/..."
            )
        self.record = record
        self.run = record.run.bytes
        self._step_clock = StepClock(record.experiment.step_length)
        self.done: Future = Future()
        self.refused: Counter[tuple[str, str]] = Counter()  # by topic and reason
        self.repeated = 0
        self._leaving: list[NetworkNode] = [self]

    def refuse(self, reason: str, topic: str) -> None:
        """Count a message that is not part of this run, and warn at the first one per topic and reason.

        Repeated messages are only counted: agents send again what a restarted one may have missed.
        """
        if reason in REPEATS:
            self.repeated += 1
            return
        self.refused[topic, reason] += 1
        if self.refused[topic, reason] == 1:
            self.get_logger().warning(f"refused a message on {topic}: {reason} (further ones are only counted)")

    def health(self) -> Health:
        """State of this node; called about once a second."""
        raise NotImplementedError

    def found(self) -> bool:
        """Whether all nodes that should read what this node publishes have been discovered; polled."""
        return True

    def awaited(self) -> list[str]:
        """Names of the nodes that have not been discovered yet."""
        return []

    def companions(self) -> list[str]:
        """Names of the nodes without which the run cannot go on; the peers of an agent would be too many to check."""
        return [SWITCHER]

    def awaited_clock(self) -> list[str]:
        """The publisher of ``/clock``, if one is needed and has not been discovered."""
        if not self.get_parameter("use_sim_time").value or self.count_publishers(CLOCK_TOPIC):
            return []
        return [f"a publisher of {CLOCK_TOPIC}"]

    def namesakes(self) -> list[str]:
        """Names of this run that more than one node has."""
        here = self.get_namespace()
        count = Counter(name for name, namespace in self.get_node_names_and_namespaces() if namespace == here)
        names = [*map(agent_name, range(self.record.experiment.agents)), SWITCHER, RECORDER]
        return [name for name in names if count[name] > 1]

    def clash(self, names: Iterable[str], seconds: float) -> InputError:
        """The error after several nodes have had the same name for so many seconds."""
        return InputError(
            f"after {seconds:.0f} s there was still more than one {', '.join(names)} in the same ROS_DOMAIN_ID "
            f"({os.environ.get('ROS_DOMAIN_ID', '0')}): is this run, or another one, under way there? End it, or "
            "choose another domain"
        )

    def begin(self) -> None:
        """Start: all nodes have been discovered."""

    def finish(self, *, complete: bool, deadline: float) -> None:
        """The process is about to end; ``complete``: the node has done its part (False: it was interrupted).

        It may wait for other nodes until ``deadline`` [s of the monotonic clock].
        """

    def fail(self, error: Exception) -> None:
        """End the process with an error."""
        if not self.done.done():
            self.done.set_exception(error)

    def leave_at_end(self, nodes: Iterable[NetworkNode] | None = None) -> None:
        """End these nodes of the process (default: this one) when the switcher announces the end of the run.

        A node that leaves earlier may take with it what others need: unread messages, or acknowledgements.
        """
        self._leaving = [self] if nodes is None else list(nodes)
        self.create_subscription(ProgressMsg, END_TOPIC, self._receive_end, LATCHED, raw=True)

    def _receive_end(self, data: bytes) -> None:
        if self.decode_progress(data, END_TOPIC):
            for node in self._leaving:
                if not node.done.done():
                    node.done.set_result(None)

    def decode_progress(self, data: bytes, topic: str) -> Progress | None:
        """A Progress message of this run; None, and counted, if the bytes are not one."""
        try:
            progress = Progress.decode(data)
        except CdrError:
            self.refuse(UNDECODABLE, topic)
            return None
        if progress.run != self.run:
            self.refuse(OTHER_RUN, topic)
            return None
        if progress.agent > self.record.experiment.agents:
            self.refuse(UNKNOWN_AGENT, topic)
            return None
        return progress

    def progress(self, agent: int, step: int) -> bytes:
        """Bytes of a Progress message; ``agent``: number from 1, or NOT_AN_AGENT."""
        return Progress(self._step_clock.nanoseconds(step), self.run, agent, step).encode()

    def has_readers(self, publisher: Publisher, expected: Sequence[str]) -> bool:
        """Whether all the expected nodes read a topic of this node."""
        # Reading the names inspects every endpoint of the network: only once enough readers are there.
        return publisher.get_subscription_count() >= len(expected) and not self.missing_readers(publisher, expected)

    def has_guests(self, publisher: Publisher) -> bool:
        """Whether a node that is not part of the run reads a topic of this node reliably."""
        own = {RECORDER, *map(agent_name, range(self.record.experiment.agents))}
        return any(
            reader.node_name not in own and reader.qos_profile.reliability == ReliabilityPolicy.RELIABLE
            for reader in self.get_subscriptions_info_by_topic(publisher.topic_name)
        )

    def missing_readers(self, publisher: Publisher, expected: Sequence[str]) -> list[str]:
        """Names of the expected nodes that do not read a topic of this node yet."""
        readers = self.get_subscriptions_info_by_topic(publisher.topic_name)
        found = {reader.node_name for reader in readers}
        missing = [name for name in expected if name not in found]
        # Other readers are matched too: all must be, so that ours are among them. Readers that ask for history of a
        # topic that keeps none are never matched.
        latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        matching = sum(latched or r.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL for r in readers)
        if not missing and publisher.get_subscription_count() < matching:
            return ["(matching)"]
        return missing
