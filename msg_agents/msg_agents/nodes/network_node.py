"""What all nodes of a network have in common."""

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
FAREWELL = 4.0  # s for readers to acknowledge what was last; more than the 3 s between two heartbeats of Fast DDS
NOT_AN_AGENT = 0  # in Progress: the recorder or the switcher
OTHER_RUN, UNDECODABLE = "other run", "undecodable"
UNKNOWN_AGENT, OTHER_AGENT = "unknown agent", "of another agent than its topic"
WRONG_LENGTH, OTHER_LAYOUT = "wrong length", "not in the layout of the agents"
OUT_OF_RANGE = "step out of range"
RECORDED = "recorded already"
REPEATS = {Refusal.OLD, Refusal.KNOWN, RECORDED}


def state_topic(agent: int) -> str:
    """Topic of an agent's states (index from 0).

    Parameters
    ----------
    agent
        index from 0
    """
    return f"{agent_name(agent)}/state"


def truth_topic(agent: int) -> str:
    """Topic of an agent's states as they are, where it publishes them with noise (index from 0).

    Parameters
    ----------
    agent
        index from 0
    """
    return f"{agent_name(agent)}/truth"


def why_not(data: bytes, record: RunRecord, agent: int, length: int) -> str:
    """What is wrong with a message that the readers of a topic could not take.

    Parameters
    ----------
    data
        CDR bytes
    record
        of the run that the readers belong to
    agent
        whose topic it is (index from 0)
    length
        of the states there
    """
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
    """A node of a run.

    Parameters
    ----------
    name
        of the node
    record
        of the run; the run id is the mark of every message that belongs to it

    Raises
    ------
    InputError
        its name was changed by arguments of ROS 2: by their names the nodes of a run find each other
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
        """Count a message that is no part of this run; say so the first time on this topic for this reason.

        What is here already is only counted: agents send again what one of them may have missed.

        Parameters
        ----------
        reason
            a few words
        topic
            that it came on
        """
        if reason in REPEATS:
            self.repeated += 1
            return
        self.refused[topic, reason] += 1
        if self.refused[topic, reason] == 1:
            self.get_logger().warning(f"refused a message on {topic}: {reason} (further ones are only counted)")

    def health(self) -> Health:
        """How this node is, asked about once a second."""
        raise NotImplementedError

    def found(self) -> bool:
        """Whether all nodes have been found that should read what this node publishes. Asked again and again."""
        return True

    def awaited(self) -> list[str]:
        """Names of those who have not been found yet."""
        return []

    def companions(self) -> list[str]:
        """Names of those without whom the run cannot go on. Whom agents hear would be too many to ask after."""
        return [SWITCHER]

    def awaited_clock(self) -> list[str]:
        """Who should tell the time and has not been found."""
        if not self.get_parameter("use_sim_time").value or self.count_publishers(CLOCK_TOPIC):
            return []
        return [f"a publisher of {CLOCK_TOPIC}"]

    def namesakes(self) -> list[str]:
        """Names of nodes of this run that more than one node bears."""
        here = self.get_namespace()
        count = Counter(name for name, namespace in self.get_node_names_and_namespaces() if namespace == here)
        names = [*map(agent_name, range(self.record.experiment.agents)), SWITCHER, RECORDER]
        return [name for name in names if count[name] > 1]

    def clash(self, names: Iterable[str], seconds: float) -> InputError:
        """The error of a node that has not been alone with these names for some time.

        Parameters
        ----------
        names
            of nodes that somebody else has too
        seconds
            for which that has been so [s]
        """
        return InputError(
            f"after {seconds:.0f} s there was still more than one {', '.join(names)} in the same ROS_DOMAIN_ID "
            f"({os.environ.get('ROS_DOMAIN_ID', '0')}): is this run, or another one, under way there? End it, or "
            "choose another domain"
        )

    def begin(self) -> None:
        """Everyone has been found: start."""

    def finish(self, *, complete: bool, deadline: float) -> None:
        """The process is about to end: the node has done its part, or (not complete) was interrupted.

        Parameters
        ----------
        complete
            whether it has done its part
        deadline
            until when it may wait for others, by the monotonic clock [s]
        """

    def fail(self, error: Exception) -> None:
        """End the process with an error.

        Parameters
        ----------
        error
            that the process is to end with
        """
        if not self.done.done():
            self.done.set_exception(error)

    def leave_at_end(self, nodes: Iterable[NetworkNode] | None = None) -> None:
        """Be done, with the other nodes of the process, when the switcher says that everybody is.

        Whoever leaves earlier may take with it what others still need: unread messages, or the acknowledgements that
        they wait for.

        Parameters
        ----------
        nodes
            of this process; None: this one alone
        """
        self._leaving = [self] if nodes is None else list(nodes)
        self.create_subscription(ProgressMsg, END_TOPIC, self._receive_end, LATCHED, raw=True)

    def _receive_end(self, data: bytes) -> None:
        if self.decode_progress(data, END_TOPIC):
            for node in self._leaving:
                if not node.done.done():
                    node.done.set_result(None)

    def decode_progress(self, data: bytes, topic: str) -> Progress | None:
        """A Progress message of this run; None (and counted) if it is no such thing.

        Parameters
        ----------
        data
            CDR bytes
        topic
            that it came on
        """
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
        """A Progress message: number of the agent from 1 (or NOT_AN_AGENT), and step.

        Parameters
        ----------
        agent
            number from 1, or NOT_AN_AGENT
        step
            k
        """
        return Progress(self._step_clock.nanoseconds(step), self.run, agent, step).encode()

    def has_readers(self, publisher: Publisher, expected: Sequence[str]) -> bool:
        """Whether all the expected nodes read a topic of ours.

        Parameters
        ----------
        publisher
            of this node
        expected
            names of nodes
        """
        # Names come out of a look at every endpoint of the network: not before they can all be there.
        return publisher.get_subscription_count() >= len(expected) and not self.missing_readers(publisher, expected)

    def has_guests(self, publisher: Publisher) -> bool:
        """Whether somebody who does not belong to the run wants all of a topic of ours.

        Parameters
        ----------
        publisher
            of this node
        """
        own = {RECORDER, *map(agent_name, range(self.record.experiment.agents))}
        return any(
            reader.node_name not in own and reader.qos_profile.reliability == ReliabilityPolicy.RELIABLE
            for reader in self.get_subscriptions_info_by_topic(publisher.topic_name)
        )

    def missing_readers(self, publisher: Publisher, expected: Sequence[str]) -> list[str]:
        """Names of the expected nodes that do not read a topic of ours yet.

        Parameters
        ----------
        publisher
            of this node
        expected
            names of nodes
        """
        readers = self.get_subscriptions_info_by_topic(publisher.topic_name)
        found = {reader.node_name for reader in readers}
        missing = [name for name in expected if name not in found]
        # Strangers who ask for less than is offered are matched too: all must be, for ours to be among them. Those who
        # ask for history of a topic that keeps none never will be.
        latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        matching = sum(latched or r.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL for r in readers)
        if not missing and publisher.get_subscription_count() < matching:
            return ["(matching)"]
        return missing
