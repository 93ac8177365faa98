"""What all nodes of a network have in common."""

from __future__ import annotations

from collections import Counter

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future

from msg_agents.errors import RCLError
from msg_analysis.model.record import RunRecord

EXPERIMENT_TOPIC = "experiment"
GRAPH_TOPIC = "graph"
PROGRESS_TOPIC = "progress"
ACK_SLICE = 0.5  # s between two looks at whether the process was told to stop


def agent_name(agent: int) -> str:
    """Name of the node, and namespace of the topics, of an agent (index from 0)."""
    return f"agent_{agent + 1}"


def state_topic(agent: int) -> str:
    """Topic of an agent's states (index from 0)."""
    return f"{agent_name(agent)}/state"


class NetworkNode(Node):  # type: ignore[misc]  # rclpy has no type hints that mypy can follow
    """A node of a run.

    Parameters
    ----------
    name : of the node
    record : of the run; the run id is the mark of every message that belongs to it
    """

    def __init__(self, name: str, *, record: RunRecord) -> None:
        # Each node would bring seven parameter services and /rosout: with many nodes they cost more than the network.
        super().__init__(name, start_parameter_services=False, enable_rosout=False)
        self.record = record
        self.run = record.run.bytes
        self.done: Future = Future()
        self.refused: Counter[str] = Counter()

    def refuse(self, reason: str, topic: str) -> None:
        """Count a message that is no part of this run; say so the first time."""
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            self.get_logger().warning(f"refused a message on {topic}: {reason} (further ones are only counted)")

    def publish(self, publisher: Publisher, data: bytes) -> None:
        """Publish serialized bytes, again and again until they go through.

        A reader that does not keep up blocks a reliable keep-all writer; after 100 ms the middleware gives up and
        raises, and the message has not been written.
        """
        while True:
            try:
                publisher.publish(data)
                return
            except RCLError:
                if not self.context.ok():
                    raise

    def awaited(self) -> dict[str, list[str]]:
        """Who has not been found yet: for each topic that this node publishes, the nodes that should read it."""
        return {}

    def begin(self) -> None:
        """Everyone has been found: start."""

    def finish(self, *, complete: bool) -> None:
        """The process is about to end: the node has done its part, or (not complete) was interrupted."""

    def fail(self, error: Exception) -> None:
        """End the process with an error."""
        if not self.done.done():
            self.done.set_exception(error)

    def wait_until_read(self, *publishers: Publisher) -> None:
        """Wait until every reader has everything: what a process has not delivered when it exits is lost."""
        for publisher in publishers:
            while self.context.ok() and not publisher.wait_for_all_acked(Duration(seconds=ACK_SLICE)):
                pass

    def missing_readers(self, publisher: Publisher, expected: list[str]) -> list[str]:
        """Names of the expected nodes that do not read a topic of ours yet."""
        found = {info.node_name for info in self.get_subscriptions_info_by_topic(publisher.topic_name)}
        missing = [name for name in expected if name not in found]
        if not missing and publisher.get_subscription_count() < len(expected):
            return ["(matching)"]
        return missing
