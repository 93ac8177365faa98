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
from msg_analysis.model.step import Wiring

AHEAD = 1000
"""Sojourns that are published before the slowest agent reaches them. Enough never to be waited for; bounded, so that a
long run keeps little in memory, and below the 5,000 messages that a late reader is given."""

AHEAD_LEAST, AHEAD_BYTES = 50, 1 << 22
"""Graphs of many agents take long to send and read, and their agents are slow: fewer sojourns, but never fewer than
this, once they are more than so many bytes."""

BEHIND = 5000
"""Sojourns that a reader may be behind: what the middleware keeps of a writer."""

REPORT_PERIOD = 0.1  # s

FAREWELL = 4.0  # s; more than the 3 s between two heartbeats of Fast DDS


class Switcher(NetworkNode):
    """Draws the exact path of the chain and keeps a bounded number of sojourns ahead of the agents.

    Parameters
    ----------
    record : of the run
    model : its step model, or wiring
    readers : names of the nodes, besides the agents, that must read the graph before the run starts
    on_progress : called with the newest step of every agent (-1: none yet) a few times a second, if one has reported
    checkpoints : directory in which it leaves a mark; whoever finds one there takes over from a process that has gone
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        readers: list[str],
        on_progress: Callable[[Sequence[int]], None] = lambda _: None,
        checkpoints: Path | None = None,
    ) -> None:
        super().__init__("switcher", record=record)
        self._graphs = record.experiment.graph_list
        self._path = sojourns(record.experiment, model.initial)
        self._steps = record.experiment.steps
        self._reached = [-1] * model.agents
        self._slowest = -1
        self._heard = False  # from an agent since the last call of on_progress
        self._recorded = RECORDER not in readers
        self._on_progress = on_progress
        # Part of the path has been published if there is a mark, and nobody says how much.
        self._mark = checkpoints and checkpoints / f"switcher.{record.run}"
        self._behind = bool(self._mark and self._mark.exists())
        self._ahead: deque[int] = deque()  # first steps of the published sojourns that the slowest has not reached
        self._most_ahead = AHEAD
        self._expected = [agent_name(i) for i in range(model.agents)] + readers
        self._experiment = self.create_publisher(String, EXPERIMENT_TOPIC, LATCHED)
        self._graph = self.create_publisher(ActiveGraphMsg, GRAPH_TOPIC, LATCHED)
        self._end = self.create_publisher(ProgressMsg, END_TOPIC, LATCHED)
        self.create_subscription(ProgressMsg, PROGRESS_TOPIC, self._receive, LATCHED, raw=True)
        self.create_timer(REPORT_PERIOD, self._report)

    def found(self) -> bool:
        """See NetworkNode."""
        return not self.awaited()

    def awaited(self) -> list[str]:
        """See NetworkNode. All that it publishes is latched: it is enough that the others are there."""
        there = set(self.get_node_names())
        return [name for name in self._expected if name not in there]

    def health(self) -> Health:
        """See NetworkNode."""
        slowest = self._slowest
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
            self._heard = True
        slowest = min(self._reached)
        if slowest > self._slowest:
            self._slowest = slowest
            self._keep_ahead()
        if self._recorded and slowest >= self._steps and not self.done.done():
            self._report()
            self.publish(self._end, self.progress(NOT_AN_AGENT, self._steps))
            self.done.set_result(None)

    def _report(self) -> None:
        if self._heard:
            self._heard = False
            self._on_progress(self._reached)

    def _keep_ahead(self) -> None:
        slowest = self._slowest
        if self._behind:
            if slowest < 0:  # not everybody has said yet where he is
                return
            self._catch_up(slowest)
        while self._ahead and self._ahead[0] <= slowest:
            self._ahead.popleft()
        while len(self._ahead) < self._most_ahead:
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
        message = self._message(sojourn).encode()
        self._most_ahead = min(self._most_ahead, max(AHEAD_LEAST, AHEAD_BYTES // len(message)))
        self.publish(self._graph, message)
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
