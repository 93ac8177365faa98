"""What a node says of itself on /diagnostics, as any ROS 2 monitor shows it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from msg_agents.timers import every

DIAGNOSTICS_TOPIC = "/diagnostics"
PERIOD = 1.0  # s
PATIENCE = 5.0  # s


@dataclass(slots=True)
class Health:
    """How a node is.

    Attributes
    ----------
    message : one line
    waiting : whether it cannot go on, or not keep up, for the time being
    values : facts, by name
    """

    message: str
    waiting: bool = False
    values: dict[str, str] = field(default_factory=dict)

    def to_status(self, node: Node, refused: Mapping[str, int], repeated: int) -> DiagnosticStatus:
        """The message. Refused messages are a warning: somebody else is on our topics."""
        warn = self.waiting or bool(refused)
        values = self.values | {f"refused: {reason}": str(count) for reason, count in refused.items()}
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
    nodes : at least one; with a method ``health() -> Health`` and counters ``refused`` and ``repeated``
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._nodes = nodes
        self._publisher = nodes[0].create_publisher(DiagnosticArray, DIAGNOSTICS_TOPIC, 10)
        every(nodes[0], PERIOD, self._report)

    def _report(self) -> None:
        array = DiagnosticArray(
            status=[node.health().to_status(node, node.refused, node.repeated) for node in self._nodes]
        )
        array.header.stamp = self._nodes[0].get_clock().now().to_msg()
        self._publisher.publish(array)


class Pace:
    """Looks at a step counter now and then.

    Attributes
    ----------
    rate : steps per second between the last two looks
    stalled : s for which there has been no step; 0.0 if there was one since the last look
    """

    def __init__(self) -> None:
        self._step, self._time = 0, time.monotonic()
        self._patience = PATIENCE
        self.rate = self.stalled = 0.0

    def look(self, step: int) -> bool:
        """Whether it is time to complain: after ``PATIENCE`` s without a step, and then ever more rarely."""
        now = time.monotonic()
        elapsed, made = now - self._time, step - self._step
        self._step, self._time = step, now
        self.rate = made / elapsed if elapsed > 0.0 else 0.0
        if made:
            self.stalled, self._patience = 0.0, PATIENCE
            return False
        self.stalled += elapsed
        if self.stalled < self._patience:
            return False
        self._patience = 2.0 * self.stalled
        return True
