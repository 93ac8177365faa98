# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The switcher node: publishes the experiment and the path of the active graph."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

from msg_agents.nodes.base import ACK_TIMEOUT, CLOCK_BOUND, NOT_AN_AGENT, Health, NetworkNode
from msg_agents.nodes.ros import DueTimer, every
from msg_agents.process_layout import RECORDER, SWITCHER
from msg_agents.recovery import StopFiles
from msg_agents.stepping.monitoring import MILLISECOND, ClockOffsets
from msg_agents.stepping.newest_values import Schedule
from msg_agents.stepping.synchronizer import LOCKSTEP_WINDOW
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.common.files import write_whole
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal, finite_number, graph_message
from msg_analysis.messages.messages import encode_string
from msg_analysis.messages.topics import agent_node_name
from msg_analysis.model.graph_path import HoldingPeriod, holding_periods
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring

# Holding periods that are published before the slowest agent reaches them: enough that no agent waits; bounded, so
# that a long run takes little memory, and below the 5,000 messages that a late reader gets.
MOST_AHEAD = 1000
# Graphs of many agents are large messages, and their agents are slow: only as many as fit BYTES_AHEAD.
LEAST_AHEAD, BYTES_AHEAD = 50, 1 << 22
MOST_BEHIND = 5000  # holding periods that a reader may be behind: the messages that the middleware keeps of a writer
REPORT_PERIOD = 0.1  # s
STOP_NOTICE = 1.0  # s in real time between the news of an early end and that end: time for all nodes to receive it
EPOCH_DELAY = SECOND // 2  # ns of the clock from its publication to the epoch: time for all nodes to receive it


class Switcher(NetworkNode):
    """Draws the exact path of the chain; subclasses, one per pace, decide when to publish which part of it."""

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        readers: list[str],  # nodes other than the agents that must be discovered before the run starts
        on_progress: Callable[[Sequence[int]], None] = lambda _: None,  # newest step of every agent, -1: none yet
        on_graph: Callable[[int], None] = lambda _: None,  # mode, from 0, of the graph that is active from now on
        checkpoints: Path | None = None,  # directory of the switcher's state; a file there means a takeover
        ack_timeout: float = ACK_TIMEOUT,  # s to wait for acknowledgements of the end
        on_clocks: Callable[[ClockOffsets, str | None], None] | None = None,  # with several hosts: see RealtimeSwitcher
    ) -> None:
        super().__init__("switcher", record=record)
        self._ack_timeout = ack_timeout
        self._path = holding_periods(record.experiment, model.initial)
        self._steps = record.experiment.steps
        self._reached = [-1] * model.agents
        self._slowest = -1
        self._new_progress = False  # from an agent since the last call of on_progress
        self._records = RECORDER in readers
        self._recorder_reached = -1  # last step of the run of which the recorder has everything
        self._on_progress, self._on_graph, self._on_clocks = on_progress, on_graph, on_clocks
        self._duplicates: set[str] = set()  # names seen at the last check
        self._stops: StopFiles | None = None  # until an early end of the run is announced; None: it is not to be
        if record.until:
            self._stop = self.publisher_of(topics.STOP)
            self._stops = StopFiles(checkpoints, record.run) if checkpoints else None
        self._state_file = checkpoints and checkpoints / f"switcher.{record.run}"
        if self._state_file and self._state_file.exists():  # in the middle of a run, no node of the user is awaited
            readers = [name for name in readers if name == RECORDER]
        self._expected = [agent_node_name(i) for i in range(model.agents)] + readers
        self._experiment = self.publisher_of(topics.EXPERIMENT)
        self._graph = self.publisher_of(topics.GRAPH)
        self._end = self.publisher_of(topics.END)
        self.subscribe(topics.PROGRESS, self._receive)
        every(self, REPORT_PERIOD, self._report)

    def missing_nodes(self) -> list[str]:
        """Names of nodes that have not been discovered yet; all topics are latched, so readers need not be matched."""
        return self.undiscovered(self._expected)

    def required_peers(self) -> list[str]:
        """All agents and the required readers."""
        return self._expected

    def health(self) -> Health:
        """Progress of the slowest agent, or which agents have not started."""
        duplicates = set(self.duplicate_names())
        for name in duplicates & self._duplicates:  # twice in a row: a killed one may not be gone yet
            if not self.refused[name, Refusal.DUPLICATE_NAME]:
                self.refused[name, Refusal.DUPLICATE_NAME] = 1
                self.get_logger().warning(f"two nodes are called {name}: of different messages, the first is used")
        self._duplicates = duplicates
        values = {"step of the slowest agent": str(self._slowest)}
        if self._slowest < 0:
            silent = [agent_node_name(i) for i, step in enumerate(self._reached) if step < 0]
            return Health(f"waiting for {', '.join(silent)}", waiting=True, values=values)
        return self._health(values)

    def _health(self, values: dict[str, str]) -> Health:
        """Health once all agents have started; ``values``: facts to include."""
        raise NotImplementedError

    def compare_record(self) -> None:
        """Let the others compare their records with this one."""
        self.publish(
            self.publisher_of(topics.RECORD), self.progress(topics.RECORD, NOT_AN_AGENT, 0, self.record.digest)
        )

    def begin(self) -> None:
        """Publish the experiment."""
        self.publish(self._experiment, encode_string(self.record.to_json()))
        if self._stops and (step := self._stops.decided()) is not None:
            self._announce_stop(step)

    def _moved(self) -> None:
        """Called when the slowest agent has advanced."""

    def finish(self, *, complete: bool, deadline: float) -> None:  # noqa: ARG002  it has a time limit of its own
        """Wait until the end is acknowledged; readers need nothing else, and those that have left had received it."""
        if complete:
            self._end.wait_for_all_acked(Duration(seconds=self._ack_timeout))

    def _receive(self, data: bytes) -> None:
        progress = self.decode_progress(data, topics.PROGRESS)
        if progress is None:
            return
        if progress.agent == NOT_AN_AGENT:
            self._recorder_reached = progress.step
        else:
            self._reached[progress.agent - 1] = max(progress.step, self._reached[progress.agent - 1])
            self._new_progress = True
        slowest = min(self._reached)
        if slowest > self._slowest:
            self._slowest = slowest
            self._moved()
        self._end_if_complete()

    def _end_if_complete(self) -> None:
        recorded = not self._records or self._recorder_reached == self._steps
        if recorded and self._slowest >= self._steps and not self.done.done():
            self._report()
            self.publish(self._end, self.progress(topics.END, NOT_AN_AGENT, self._steps))
            self.done.set_result(None)

    def _first_end(self) -> int | None:
        """The first step at which the run can end early; None: not known yet. Agents may be there before they know."""
        return max(self._reached) + LOCKSTEP_WINDOW if self._slowest >= 0 else None

    def _announce_stop(self, step: int) -> None:
        self._stops, self._steps = None, step
        self.publish(self._stop, self.progress(topics.STOP, NOT_AN_AGENT, step))
        self._end_if_complete()

    def _report(self) -> None:
        if self._stops and self._stops.asked() and (step := self._first_end()) is not None:
            if step < self._steps:
                self._stops.decide(step)
                self._announce_stop(step)
            self._stops = None  # too late to end earlier, or announced
        if self._new_progress:
            self._new_progress = False
            self._on_progress(self._reached)

    def _publish_graph(self, holding: HoldingPeriod) -> int:
        """Publish a holding period; the size of its message [bytes]."""
        message = graph_message(self.record, holding).encode()
        self.publish(self._graph, message)
        return len(message)


class LockstepSwitcher(Switcher):
    """Keeps a bounded number of holding periods ahead of the agents; parameters as in ``Switcher``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # A state file means that part of the path has been published; how much is not known.
        self._behind = bool(self._state_file and self._state_file.exists())
        self._ahead: deque[HoldingPeriod] = deque()  # published holding periods that the slowest agent has not reached
        self._most_ahead = MOST_AHEAD

    def _health(self, values: dict[str, str]) -> Health:
        values["holding periods ahead of it"] = str(len(self._ahead))
        return Health(f"{len(self._ahead)} holding periods ahead of step {self._slowest}", values=values)

    def begin(self) -> None:
        """Publish the experiment and the beginning of the path."""
        if self._state_file:
            self._state_file.touch()
        super().begin()
        self._moved()

    def _moved(self) -> None:
        slowest = self._slowest
        if self._behind:
            if slowest < 0:  # not all agents have reported yet
                return
            self._catch_up(slowest)
        while self._ahead and self._ahead[0].first_step <= slowest:
            self._on_graph(self._ahead.popleft().mode)
        while len(self._ahead) < self._most_ahead:
            holding = next(self._path, None)
            if holding is None:
                return
            self._go_ahead(holding)

    def _catch_up(self, slowest: int) -> None:
        """Publish again what may not have been delivered when the process before this one ended."""
        recent: deque[HoldingPeriod] = deque(maxlen=MOST_BEHIND)
        for holding in self._path:
            recent.append(holding)
            if holding.last_step >= slowest:
                break
        for holding in recent:
            self._go_ahead(holding)
        self._behind = False

    def _go_ahead(self, holding: HoldingPeriod) -> None:
        size = self._publish_graph(holding)
        self._most_ahead = min(self._most_ahead, max(LEAST_AHEAD, BYTES_AHEAD // size))
        self._ahead.append(holding)


class RealtimeSwitcher(Switcher):
    """Sets the epoch of simulated time, publishes each holding period when it begins; parameters as in ``Switcher``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._timer = DueTimer(self, self._keep_up)
        self._schedule: Schedule | None = None
        self._next = next(self._path, None)
        self._clocks = ClockOffsets()
        self._apart: str | None = None  # which clocks are too far from ours
        if self._on_clocks and not self.get_parameter("use_sim_time").value:
            self.subscribe(topics.DIAGNOSTICS, self._receive_health)

    def _receive_health(self, data: bytes) -> None:
        """Compare the clocks of agents with ours: their health has the time at which it was sent."""
        assert self._on_clocks
        experiment, now = self.record.experiment, self._timer.now()
        try:
            array = deserialize_message(data, DiagnosticArray)
        except (RuntimeError, ValueError):  # of Fast CDR; bytes that are not UTF-8
            self.refuse(Refusal.UNDECODABLE, topics.DIAGNOSTICS.name)
            return
        sent = array.header.stamp.sec * SECOND + array.header.stamp.nanosec
        agents = {f"{self.get_namespace()}/{name}".lstrip("/"): name for name in self._own_names()}
        for status in array.status:
            name = agents.get(status.name.partition(":")[0])
            bounds = [value.value for value in status.values if value.key == CLOCK_BOUND]
            if name in (None, SWITCHER, RECORDER) or not bounds:
                continue
            try:
                self._clocks.add(name, sent, now, finite_number(bounds[0]) * MILLISECOND)
            except ValueError:
                self.refuse(Refusal.NOT_FINITE, topics.DIAGNOSTICS.name)
        apart = self._clocks.warning(experiment.step_length / experiment.run.speed * SECOND)
        if apart and not self._apart:
            self.get_logger().warning(apart)
        self._apart = apart
        self._on_clocks(self._clocks, apart)

    def _health(self, values: dict[str, str]) -> Health:
        if self._schedule is None:
            return Health("waiting for the time on /clock", waiting=True, values=values)
        late = self._next is not None and self._timer.now() - self._schedule.clock_time(self._next.first_step)
        values["lateness of the graph [ms]"] = f"{max(0, late) / 1e6:.3f}"
        if self._apart:
            return Health(self._apart, waiting=True, values=values)
        return Health(f"step of the slowest agent: {self._slowest}", values=values)

    def begin(self) -> None:
        """Publish the experiment and, after a takeover, the epoch and the path so far."""
        super().begin()
        if self._state_file and self._state_file.exists():
            self._start(int(self._state_file.read_text(encoding="ascii")))

    def _first_end(self) -> int | None:
        """See Switcher. Agents step by the clock, whatever has been reported."""
        if self._schedule is None or self._slowest < 0:
            return None
        experiment = self.record.experiment
        due = self._schedule.reach(self._timer.now() + round(STOP_NOTICE * SECOND))
        return max(due, max(self._reached) + math.ceil(STOP_NOTICE * experiment.run.speed / experiment.step_length))

    def _report(self) -> None:
        super()._report()
        now = self._timer.now()
        if self._schedule is None and self._slowest >= 0 and now:
            epoch = now + EPOCH_DELAY
            if self._state_file:  # whole or not at all: a process that takes over must go on with this epoch
                write_whole(self._state_file, str(epoch).encode())
            self._start(epoch)

    def _start(self, epoch: int) -> None:
        """Publish the epoch, and the path so far."""
        experiment = self.record.experiment
        self._schedule = Schedule(epoch=epoch, speed=experiment.run.speed, step_length=experiment.step_length)
        self.publish(self.publisher_of(topics.EPOCH), self.progress(topics.EPOCH, NOT_AN_AGENT, 0, epoch))
        self._keep_up()

    def _keep_up(self) -> None:
        """Publish every holding period that has begun; the first one before the epoch."""
        assert self._schedule is not None
        simulated = self._schedule.simulated(self._timer.now())
        begun: deque[HoldingPeriod] = deque(maxlen=MOST_BEHIND)
        while self._next and (self._next.first_step == 0 or self._schedule.due(self._next.first_step) <= simulated):
            begun.append(self._next)
            self._next = next(self._path, None)
        for holding in begun:
            self._publish_graph(holding)
            self._on_graph(holding.mode)
        if self._next:
            self._timer.set(self._schedule.clock_time(self._next.first_step))


SWITCHERS: dict[str, type[Switcher]] = {"lockstep": LockstepSwitcher, "realtime": RealtimeSwitcher}  # by pace
