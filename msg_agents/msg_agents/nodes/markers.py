# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The graph and the agents' states as markers, for RViz and Foxglove."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from geometry_msgs.msg import Point, Pose, Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from msg_agents.nodes.ros import every, until_shutdown
from msg_agents.nodes.watch_process import Watcher
from msg_analysis.common.text import agent_name
from msg_analysis.errors import InputError
from msg_analysis.messages import topics
from msg_analysis.messages.messages import AgentState

SPACING = 1.0  # m between neighbours on the circle
AGENT_SIZE, EDGE_WIDTH, TEXT_SIZE = 0.4, 0.05, 0.35  # m
MOST_NAMES = 100  # agents up to which each one is labelled with its number
FULL_COLOUR = 2.0  # distance from the middle with full colour, in root mean squares of all distances
FADING = 0.02  # weight of the newest picture in that mean square
SILENT_TIME = 3.0  # s without a newer state, once the run has ended or has no publishers
Colour = tuple[float, float, float]
LOW, MIDDLE, HIGH = (0.13, 0.40, 0.67), (0.97, 0.97, 0.97), (0.70, 0.09, 0.17)


def circle(agents: int) -> list[tuple[float, float]]:
    """Positions (x, y) of the agents [m] on a circle, clockwise from the top, neighbours ``SPACING`` apart."""
    radius = SPACING / (2 * math.sin(math.pi / agents)) if agents > 1 else 0.0
    angles = [math.pi / 2 - 2 * math.pi * i / agents for i in range(agents)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def colour(value: float) -> Colour:
    """From blue (-1 and less) over white (0) to red (1 and more)."""
    end, part = (HIGH, value) if value > 0 else (LOW, -value)
    part = min(part, 1.0)
    red, green, blue = (middle + part * (full - middle) for middle, full in zip(MIDDLE, end, strict=True))
    return red, green, blue


class Markers(Watcher):
    """Draws the newest state of every agent, and the links of the step that led to it; ``replica`` counts from 0."""

    ack_timeout = 2.0

    def __init__(self, *, rate: float, replica: int, frame: str, on_note: Callable[[str], None]) -> None:
        super().__init__("markers", topics.MARKERS, on_note=on_note)
        self._rate, self._replica, self._frame = rate, replica, frame
        self._newest: list[bytes | None] = []  # raw messages by agent: most are never decoded
        self._places: list[tuple[float, float]] = []
        self._links: list[list[list[int]]] = []  # neighbours, by mode and agent, all from 0
        self._square = 0.0  # mean square of the distance from the middle
        self._drawn: list[int] = []  # steps of the last picture
        self._moved = time.monotonic()

    def follow(self) -> None:
        """See Watcher; InputError if there is no such replica."""
        assert self.record is not None
        experiment = self.record.experiment
        if self._replica >= experiment.run.replicas:
            raise InputError(f"--replica: {self._replica + 1}: expected a number from 1 to {experiment.run.replicas}")
        agents = experiment.agents
        self._newest, self._places = [None] * agents, circle(agents)
        for graph in experiment.graph_list:
            neighbours: list[list[int]] = [[] for _ in range(agents)]
            for source, target, _ in graph.arcs:
                neighbours[target - 1].append(source - 1)
            self._links.append(neighbours)
        self._subscribe_to_states(topics.STATE, topics.PASSIVE_NEWEST, whole=False)
        self._moved = time.monotonic()
        every(self, 1.0 / self._rate, self._draw)

    def _take(self, agent: int, step: int, mode: int, state: bytes, message: bytes) -> None:  # noqa: ARG002
        self._newest[agent] = message

    def _draw(self) -> None:
        assert self.record is not None
        states = [None if data is None else AgentState.decode(data) for data in self._newest]
        steps = [-1 if state is None else state.step for state in states]
        if steps != self._drawn:
            self._drawn, self._moved = steps, time.monotonic()
            with until_shutdown(self):
                self._writer.publish(self._picture(states))
        quiet = time.monotonic() - self._moved > SILENT_TIME
        self._finish_if_over(all_there=min(steps) >= self.last_step, quiet=quiet)

    def _picture(self, states: Sequence[AgentState | None]) -> MarkerArray:
        markers = [self._agents(states), self._edges(states), self._title(states)]
        if len(states) <= MOST_NAMES:
            markers += [self._name(agent) for agent in range(len(states))]
        return MarkerArray(markers=markers)

    def _marker(self, namespace: str, kind: int, size: float, number: int = 0) -> Marker:
        marker = Marker(ns=namespace, id=number, type=kind, action=Marker.ADD, scale=Vector3(x=size, y=size, z=size))
        marker.header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._frame)
        marker.pose.orientation.w = 1.0
        marker.color = ColorRGBA(r=0.5, g=0.5, b=0.5, a=1.0)
        return marker

    def _agents(self, states: Sequence[AgentState | None]) -> Marker:
        """A sphere for each agent with a state, coloured by its distance from the mean (or the reference)."""
        assert self.record is not None
        values = [None if state is None else float(state.state[self._replica]) for state in states]
        known = [value for value in values if value is not None]
        experiment = self.record.experiment
        middle = experiment.reference if experiment.spec.leaders else sum(known) / max(1, len(known))
        square = sum((value - middle) ** 2 for value in known) / max(1, len(known))
        self._square += (square - self._square) * (FADING if self._square else 1.0)
        full = FULL_COLOUR * math.sqrt(self._square) or 1.0
        marker = self._marker("agents", Marker.SPHERE_LIST, AGENT_SIZE)
        for place, value in zip(self._places, values, strict=True):
            if value is not None:
                red, green, blue = colour((value - middle) / full)
                marker.points.append(Point(x=place[0], y=place[1]))
                marker.colors.append(ColorRGBA(r=red, g=green, b=blue, a=1.0))
        return marker

    def _edges(self, states: Sequence[AgentState | None]) -> Marker:
        """A line for each pair of which one used the other in the step that led to its state."""
        links = {
            (min(agent, other), max(agent, other))
            for agent, state in enumerate(states)
            if state is not None and 1 <= state.mode <= len(self._links)
            for other in self._links[state.mode - 1][agent]
        }
        marker = self._marker("links", Marker.LINE_LIST, EDGE_WIDTH)
        for link in sorted(links):
            marker.points += [Point(x=self._places[agent][0], y=self._places[agent][1]) for agent in link]
        if not links:  # RViz rejects a list of lines without points
            marker.action = Marker.DELETE
        return marker

    def _title(self, states: Sequence[AgentState | None]) -> Marker:
        """Step of the slowest agent, its time, and its graph."""
        assert self.record is not None
        experiment = self.record.experiment
        last = min((state for state in states if state is not None), key=lambda state: state.step, default=None)
        marker = self._marker("title", Marker.TEXT_VIEW_FACING, TEXT_SIZE)
        lowest = min(y for _, y in self._places)
        marker.pose = _at(0.0, lowest - 2 * TEXT_SIZE)
        if last is not None:
            graph = experiment.graph_list[last.mode - 1].name if 1 <= last.mode <= len(self._links) else ""
            marker.text = f"{experiment.name}  step {last.step}  t = {last.step * experiment.step_length:g}  {graph}"
        return marker

    def _name(self, agent: int) -> Marker:
        """The name or number of an agent, outside the circle."""
        marker = self._marker("names", Marker.TEXT_VIEW_FACING, TEXT_SIZE, agent)
        x, y = self._places[agent]
        away = 1 + AGENT_SIZE / max(math.hypot(x, y), AGENT_SIZE)
        marker.pose = _at(x * away, y * away)
        marker.text = agent_name(agent + 1, self.record.experiment.names if self.record else None)
        return marker


def _at(x: float, y: float) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y, pose.orientation.w = x, y, 1.0
    return pose
