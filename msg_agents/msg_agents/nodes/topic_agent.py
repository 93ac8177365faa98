# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What stands in a run for a robot that knows nothing of it: its state is the newest number on a topic of the robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from std_msgs.msg import Float64

from msg_agents.nodes.external_agent import ExternalAgent
from msg_agents.nodes.ros import DueTimer, foreign_message_class
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.log_map import LogMap
from msg_analysis.bags.message_fields import parse_path
from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.model.graph_path import holding_periods

HEARD = "agent_{}/heard/agent_{}"  # topic on which a robot is told what it hears of another agent


class TopicAgent(ExternalAgent):
    """Takes the state of a robot from a topic that the map names, and tells the robot what it hears of its neighbours.

    A robot needs no package of ours, no key and no start: it publishes a number in messages of any type, and may read
    ``std_msgs/Float64`` on ``agent_<i>/heard/agent_<j>``, in each step in which the graph has that link. What it hears
    first says that the run begins: until then it stays at x(0).
    """

    def __init__(self, record: str | Path, agent: int, mapped: LogMap, *, readers: Sequence[str]) -> None:
        super().__init__(record, agent, readers=readers)
        run, names = self.experiment.run, self.experiment.names
        if run.pace != "realtime" or run.replicas != 1:
            raise InputError(
                f"run: pace {run.pace}, replicas {run.replicas}: expected realtime and 1: robots wait for nobody"
            )
        source = mapped.sources(self.experiment.agents, names)[agent - 1]
        if source.topic is None or source.field is None:
            raise InputError(f"agents.{agent}: expected `topic` and `field`: correct the map")
        self._topic, self._path, self._unit = source.topic, parse_path(source.field), mapped.units.state
        self._newest = math.nan
        self._node: Node | None = None
        self._subscription: Subscription | None = None
        self._publishers: dict[int, Publisher] = {}

    def connected(self, node: Node) -> None:
        """Make the topics for the robot."""
        for j in self._record.model.listens()[self.number - 1].nonzero()[0].tolist():
            topic = HEARD.format(self.number, j + 1)
            self._publishers[j + 1] = node.create_publisher(Float64, topic, qos_profile_sensor_data)
        self._node = node

    def missing(self) -> list[str]:
        """The topic, until it is there; its type is that of its publishers."""
        assert self._node is not None
        if self._subscription is None:
            types = dict(self._node.get_topic_names_and_types()).get(self._node.resolve_topic_name(self._topic))
            if not types:
                return [self._topic]
            self._subscription = self._node.create_subscription(
                foreign_message_class(types[0]), self._topic, self._take, qos_profile_sensor_data
            )
        return []

    def started(self, first: int) -> None:
        """The robot hears of the states x(0) one period before the first step, which is when its own step begins."""
        run, experiment = self.experiment.run, self.experiment
        assert self._node is not None
        mode = next(holding_periods(experiment, self._record.model.initial)).mode
        start = self._record.start[:, 0]

        def begin() -> None:
            for j in self._record.model.neighbours(mode, self.number - 1).tolist():
                self._publishers[j + 1].publish(Float64(data=float(start[j]) * self._unit))

        self._timer = DueTimer(self._node, begin)
        self._timer.set(first - round(experiment.step_length / run.speed * SECOND))

    def _take(self, message: Any) -> None:
        try:
            value = message
            for part in self._path:
                value = value[part] if isinstance(part, int) else getattr(value, part)
            found = float(value) / self._unit
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            assert self._node is not None
            self._node.get_logger().warning(f"{self._topic}: {error}: expected a number in this field", once=True)
            return
        if math.isfinite(found):
            self._newest = found

    def step(self, k: int, graph: Graph, own: FloatArray, heard: Mapping[int, FloatArray]) -> float | FloatArray:
        """See ExternalAgent: x(0) until the robot has published a value."""
        del k, graph
        for j, value in heard.items():
            self._publishers[j].publish(Float64(data=float(value[0]) * self._unit))
        return own if math.isnan(self._newest) else self._newest
