"""What a node says of itself on /diagnostics, as any ROS 2 monitor shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from msg_agents.nodes.ros.timers import every
from msg_agents.processes.status_file import write_account

DIAGNOSTICS_TOPIC = "/diagnostics"
PERIOD = 1.0  # s


@dataclass(slots=True)
class Health:
    """How a node is.

    Attributes
    ----------
    message
        one line
    waiting
        whether it cannot go on, or not keep up, for the time being
    values
        facts, by name
    """

    message: str
    waiting: bool = False
    values: dict[str, str] = field(default_factory=dict)

    def to_status(self, node: Node, refused: Mapping[tuple[str, str], int], repeated: int) -> DiagnosticStatus:
        """The message. Refused messages are a warning: somebody else is on our topics.

        Parameters
        ----------
        node
            that it is about
        refused
            number of messages by topic and reason
        repeated
            messages that came again
        """
        warn = self.waiting or bool(refused)
        counts = {f"refused on {topic}: {reason}": str(count) for (topic, reason), count in refused.items()}
        values = self.values | counts
        if repeated:
            values["received again"] = str(repeated)
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if warn else DiagnosticStatus.OK,
            name=f"{node.get_fully_qualified_name().lstrip('/')}: network",
            message=self.message,
            hardware_id="",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


class Reporter:
    """Publishes the health of all nodes of a process once a second; whether one gets on is judged between two reports.

    Parameters
    ----------
    nodes
        at least one; with a method ``health() -> Health`` and counters ``refused`` and ``repeated``
    account
        file for whoever started the process: what its nodes have refused, and what they wait for
    """

    def __init__(self, nodes: Sequence[Node], account: Path | None = None) -> None:
        self._nodes = nodes
        self._account = account
        self._waiting: dict[str, str] = {}
        self._publisher = nodes[0].create_publisher(DiagnosticArray, DIAGNOSTICS_TOPIC, 10)
        every(nodes[0], PERIOD, self._report)

    def _report(self) -> None:
        healths = [(node, node.health()) for node in self._nodes]
        array = DiagnosticArray(
            status=[health.to_status(node, node.refused, node.repeated) for node, health in healths]
        )
        array.header.stamp = self._nodes[0].get_clock().now().to_msg()
        self._publisher.publish(array)
        self._waiting = {node.get_name(): health.message if health.waiting else "" for node, health in healths}
        self.keep_account()

    def keep_account(self) -> None:
        """Write the account, whole or not at all."""
        if self._account is not None:
            refused = [(node.get_name(), *what, count) for node in self._nodes for what, count in node.refused.items()]
            write_account(self._account, refused, self._waiting)
