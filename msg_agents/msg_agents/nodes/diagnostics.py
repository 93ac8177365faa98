# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Health of the nodes, on /diagnostics for any ROS 2 monitor and in the status file of the process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from msg_agents.nodes.ros import LeanNode, every, until_shutdown
from msg_agents.run.result import write_status
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.topics import DIAGNOSTICS

DIAGNOSTICS_PERIOD = 1.0  # s
CLOCK_BOUND = "clock ahead of the switcher's by at most [ms]"  # a value of agents in real time


@dataclass(slots=True)
class Health:
    """The health of a node."""

    message: str  # one line
    waiting: bool = False  # cannot continue, or cannot keep up, at present
    values: dict[str, str] = field(default_factory=dict)

    def to_status(self, node: Node, refused: Mapping[tuple[str, str], int], repeated: int) -> DiagnosticStatus:
        """The diagnostic message about a node; ``refused`` counts messages by (topic, reason).

        Refused messages are a warning: other nodes publish on the topics of the run.
        """
        warn = self.waiting or bool(refused)
        counts = {f"refused on {topic}: {reason}": str(count) for (topic, reason), count in refused.items()}
        values = self.values | counts
        if repeated:
            values[Refusal.REPEATED] = str(repeated)
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if warn else DiagnosticStatus.OK,
            name=f"{node.get_fully_qualified_name().lstrip('/')}: network",
            message=self.message,
            hardware_id="",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


class HealthReporter:
    """Publishes the health of all nodes of a process once a second, and keeps its status file.

    The nodes need a method ``health() -> Health`` and the counters ``refused`` and ``repeated``.
    """

    def __init__(self, nodes: Sequence[LeanNode], account: Path | None = None) -> None:
        self._nodes = nodes
        self._account = account
        self._waiting: dict[str, str] = {}
        self._publisher = nodes[0].publisher_of(DIAGNOSTICS)
        every(nodes[0], DIAGNOSTICS_PERIOD, self._report)

    def _report(self) -> None:
        healths = [(node, node.health()) for node in self._nodes]
        array = DiagnosticArray(
            status=[health.to_status(node, node.refused, node.repeated) for node, health in healths]
        )
        array.header.stamp = self._nodes[0].get_clock().now().to_msg()
        with until_shutdown(self._nodes[0]):
            self._publisher.publish(array)
        self._waiting = {node.get_name(): health.message if health.waiting else "" for node, health in healths}
        self.write_status_file()

    def write_status_file(self) -> None:
        """Write the status file atomically, if there is one."""
        if self._account is not None:
            refused = [(node.get_name(), *what, count) for node in self._nodes for what, count in node.refused.items()]
            write_status(self._account, refused, self._waiting)
