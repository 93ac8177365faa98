# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What stands in a run for a robot that knows nothing of it: its state is the newest number on a topic of the robot."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription

from msg_agents.nodes.external_agent import ExternalAgent
from msg_agents.nodes.ros import DueTimer, foreign_message_class, state_messages
from msg_agents.run.external import NOTHING_ON, robot_source
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.log_map import LogMap
from msg_analysis.bags.message_fields import parse_path
from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.model.graph_path import holding_periods
from msg_analysis.model.run_record import RunRecord

SETTLE = 1.0  # s that a robot has to discover our topics, once we have its own: nothing tells that it has
QUIET = 3.0  # s without a message of the robot, after which that is said
HEARD = "agent_{}/heard/agent_{}"  # topic on which a robot is told what it hears of another agent


class TopicAgent(ExternalAgent):
    """Takes the state of a robot from a topic that the map names, and tells the robot what it hears of its neighbours.

    A robot needs no package of ours, no key and no start: it publishes a number in messages of any type, and may read
    ``std_msgs/Float64``, or what ``hears`` in the map says, on ``agent_<i>/heard/agent_<j>``, in each step in which the
    graph has that link. What it hears first says that the run begins: until then it stays at x(0).
    """

    def __init__(self, record: RunRecord, agent: int, mapped: LogMap, *, readers: Sequence[str]) -> None:
        super().__init__(record, agent, readers=readers)
        source = robot_source(self.experiment, mapped, agent)
        self._topic, self._field, self._unit = str(source.topic), str(source.field), mapped.units.state
        self._path = parse_path(self._field)
        self._hears = source.hears
        self._newest = math.nan
        self._publishers: list[Publisher] = []  # of what it may read
        self._matched, self._found = -1, 0.0  # readers of these, and when the last one was found [s, monotonic]
        self._came = math.inf  # time of the last message [s of the monotonic clock]
        self._node: Node | None = None
        self._subscription: Subscription | None = None
        self._tell: dict[int, Callable[[float], None]] = {}  # by the number of the agent that is heard

    def connected(self, node: Node) -> None:
        """Make the topics for the robot."""
        kind, message = state_messages(node, self._hears, self.experiment.run.frame)

        def publishing(topic: str) -> Callable[[float], None]:
            publisher = node.create_publisher(kind, topic, qos_profile_sensor_data)
            self._publishers.append(publisher)
            return lambda x: publisher.publish(message(x * self._unit))

        for j in self._record.model.listens()[self.number - 1].nonzero()[0].tolist():
            self._tell[j + 1] = publishing(HEARD.format(self.number, j + 1))
        self._node = node

    def missing(self) -> list[str]:
        """The topic, until it is there for long enough; its type is that of its publishers."""
        assert self._node is not None
        if self._subscription is None:
            types = dict(self._node.get_topic_names_and_types()).get(self._node.resolve_topic_name(self._topic))
            if not types:
                return [self._topic]
            kind = foreign_message_class(types[0])
            self._require_number(kind(), types[0])
            self._subscription = self._node.create_subscription(kind, self._topic, self._take, qos_profile_sensor_data)
        readers = sum(publisher.get_subscription_count() for publisher in self._publishers)
        if readers != self._matched:
            self._matched, self._found = readers, time.monotonic()
        return [self._topic] if time.monotonic() < self._found + SETTLE else []

    def _require_number(self, message: Any, kind: str) -> None:
        """InputError if messages of this type cannot have a number in the field; entries of lists may come later."""
        try:
            float(self._value(message))
        except IndexError:
            return
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise InputError(
                f"{self._topic}: messages are {kind} and have no number {self._field}: correct the map"
            ) from error

    def _value(self, message: Any) -> Any:
        for part in self._path:
            message = message[part] if isinstance(part, int) else getattr(message, part)
        return message

    def started(self, first: int) -> None:
        """The robot hears of the states x(0) one period before the first step, which is when its own step begins."""
        run, experiment = self.experiment.run, self.experiment
        assert self._node is not None
        mode = next(holding_periods(experiment, self._record.model.initial)).mode
        start = self._record.start[:, 0]

        def begin() -> None:
            for j in self._record.model.neighbours(mode, self.number - 1).tolist():
                self._tell[j + 1](float(start[j]))

        self._timer = DueTimer(self._node, begin)
        self._timer.set(first - round(experiment.step_length / run.speed * SECOND))
        self._came = time.monotonic()

    def waiting_for(self) -> str | None:
        """See ExternalAgent."""
        quiet = time.monotonic() - self._came
        return f"{NOTHING_ON} {self._topic} for {quiet:.1f} s: its state stays" if quiet > QUIET else None

    def _take(self, message: Any) -> None:
        self._came = time.monotonic()
        try:
            found = float(self._value(message)) / self._unit
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
            self._tell[j](float(value[0]))
        return own if math.isnan(self._newest) else self._newest
