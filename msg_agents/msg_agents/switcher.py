"""The switcher node: publishes the experiment and the path of the active graph."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.duration import Duration
from std_msgs.msg import String

from msg_agents.health import Health
from msg_agents.network import RECORDER
from msg_agents.node import (
    END_TOPIC,
    EXPERIMENT_TOPIC,
    GRAPH_TOPIC,
    NOT_AN_AGENT,
    PROGRESS_TOPIC,
    NetworkNode,
    agent_name,
)
from msg_agents.qos import LATCHED
from msg_analysis.bags.cdr import ActiveGraph, encode_string
from msg_analysis.model.path import Sojourn, sojourns
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import StepModel

AHEAD = 1000
"""Sojourns that are published before the slowest agent reaches them. Enough never to be waited for; bounded, so that a
long run keeps little in memory, and below the 5,000 messages that a late reader is given."""

BEHIND = 5000
"""Sojourns that a reader may be behind: what the middleware keeps of a writer."""

FAREWELL = 4.0  # s; more than the 3 s between two heartbeats of Fast DDS


class Switcher(NetworkNode):
    """Draws the exact path of the chain and keeps a bounded number of sojourns ahead of the agents.

    Parameters
    ----------
    record : of the run
    model : its step model
    readers : names of the nodes, besides the agents, that must read the graph before the run starts
    on_progress : called with the newest step of every agent (-1: none yet) whenever one of them reports
    checkpoints : directory in which it leaves a mark; whoever finds one there takes over from a process that has gone
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: StepModel,
        readers: list[str],
        on_progress: Callable[[Sequence[int]], None] = lambda _: None,
        checkpoints: Path | None = None,
    ) -> None:
        super().__init__("switcher", record=record)
        self._graphs = record.experiment.graph_list
        self._path = sojourns(record.experiment, model.initial)
        self._steps = record.experiment.steps
        self._reached = [-1] * model.agents
        self._recorded = RECORDER not in readers
        self._on_progress = on_progress
        # Part of the path has been published if there is a mark, and nobody says how much.
        self._mark = checkpoints and checkpoints / f"switcher.{record.run}"
        self._behind = bool(self._mark and self._mark.exists())
        self._ahead: list[int] = []  # first steps of the published sojourns that the slowest agent has not reached
        self._expected = [agent_name(i) for i in range(model.agents)] + readers
        self._experiment = self.create_publisher(String, EXPERIMENT_TOPIC, LATCHED)
        self._graph = self.create_publisher(ActiveGraphMsg, GRAPH_TOPIC, LATCHED)
        self._end = self.create_publisher(ProgressMsg, END_TOPIC, LATCHED)
        self.create_subscription(ProgressMsg, PROGRESS_TOPIC, self._receive, LATCHED, raw=True)

    def awaited(self) -> list[str]:
        """See NetworkNode."""
        return self.missing_readers(self._graph, self._expected)

    def health(self) -> Health:
        """See NetworkNode."""
        slowest = min(self._reached)
        values = {"step of the slowest agent": str(slowest), "sojourns ahead of it": str(len(self._ahead))}
        if slowest < 0:
            silent = [agent_name(i) for i, step in enumerate(self._reached) if step < 0]
            return Health(f"waiting for {', '.join(silent)}", waiting=True, values=values)
        return Health(f"{len(self._ahead)} sojourns ahead of step {slowest}", values=values)

    def begin(self) -> None:
        """Publish the experiment and the beginning of the path."""
        if self._mark:
            self._mark.touch()
        self.publish(self._experiment, encode_string(self.record.to_json()))
        self._keep_ahead()

    def finish(self, *, complete: bool) -> None:
        """See NetworkNode. Nobody needs anything but the end any more, and who has left has had it."""
        if complete:
            self._end.wait_for_all_acked(Duration(seconds=FAREWELL))

    def _receive(self, data: bytes) -> None:
        progress = self.decode_progress(data, PROGRESS_TOPIC)
        if progress is None:
            return
        if progress.agent == NOT_AN_AGENT:
            self._recorded = self._recorded or progress.step == self._steps
        else:
            self._reached[progress.agent - 1] = max(progress.step, self._reached[progress.agent - 1])
        self._on_progress(self._reached)
        self._keep_ahead()
        if self._recorded and min(self._reached) >= self._steps and not self.done.done():
            self.publish(self._end, self.progress(NOT_AN_AGENT, self._steps))
            self.done.set_result(None)

    def _keep_ahead(self) -> None:
        slowest = min(self._reached)
        if self._behind:
            if slowest < 0:  # not everybody has said yet where he is
                return
            self._catch_up(slowest)
        self._ahead = [first for first in self._ahead if first > slowest]
        while len(self._ahead) < AHEAD:
            sojourn = next(self._path, None)
            if sojourn is None:
                return
            self._publish_sojourn(sojourn)

    def _catch_up(self, slowest: int) -> None:
        """Publish again what may still have been under way when the process before this one went."""
        recent: deque[Sojourn] = deque(maxlen=BEHIND)
        for sojourn in self._path:
            recent.append(sojourn)
            if sojourn.last_step >= slowest:
                break
        for sojourn in recent:
            self._publish_sojourn(sojourn)
        self._behind = False

    def _publish_sojourn(self, sojourn: Sojourn) -> None:
        self.publish(self._graph, self._message(sojourn).encode())
        self._ahead.append(sojourn.first_step)

    def _message(self, sojourn: Sojourn) -> ActiveGraph:
        graph = self._graphs[sojourn.mode]
        return ActiveGraph(
            stamp=self._step_clock.nanoseconds(sojourn.first_step),
            run=self.run,
            sequence=sojourn.sequence,
            mode=sojourn.mode + 1,
            name=graph.name,
            first_step=sojourn.first_step,
            last_step=sojourn.last_step,
            arcs=graph.arcs,
        )
