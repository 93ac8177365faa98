"""The switcher node: publishes the experiment and the path of the active graph.

In lockstep it keeps ahead of the agents; in real time it publishes the epoch and every sojourn at its time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.duration import Duration
from std_msgs.msg import String

from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.network_node import (
    END_TOPIC,
    EPOCH_TOPIC,
    EXPERIMENT_TOPIC,
    FAREWELL,
    GRAPH_TOPIC,
    NOT_AN_AGENT,
    PROGRESS_TOPIC,
    NetworkNode,
)
from msg_agents.nodes.ros.qos import LATCHED
from msg_agents.nodes.ros.timers import DueTimer, every
from msg_agents.processes.process_plan import RECORDER, agent_name
from msg_agents.stepping.realtime_schedule import Schedule
from msg_analysis.model.arithmetic.step_clock import SECOND
from msg_analysis.model.run.graph_path import Sojourn, sojourns
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.wire.messages import ActiveGraph, Progress, encode_string

AHEAD = 1000
"""Sojourns that are published before the slowest agent reaches them. Enough never to be waited for; bounded, so that a
long run keeps little in memory, and below the 5,000 messages that a late reader is given."""

AHEAD_LEAST, AHEAD_BYTES = 50, 1 << 22
"""Graphs of many agents take long to send and read, and their agents are slow: fewer sojourns, but never fewer than
this, once they are more than so many bytes."""

BEHIND = 5000
"""Sojourns that a reader may be behind: what the middleware keeps of a writer."""

REPORT_PERIOD = 0.1  # s

NAMESAKE = "a second node of this name"
HEAD_START = SECOND // 2
"""ns of the clock from the publication of the epoch to the epoch: by then everybody should know it."""


class Switcher(NetworkNode):
    """Draws the exact path of the chain; when it publishes what of it, is a matter of its pace.

    Parameters
    ----------
    record
        of the run
    model
        its step model, or wiring
    readers
        names of the nodes, besides the agents, that must read the graph before the run starts
    on_progress
        called with the newest step of every agent (-1: none yet) a few times a second, if one has reported
    checkpoints
        directory in which it leaves a mark; whoever finds one there takes over from a process that has gone
    farewell
        s to wait for everybody to say that the end has been heard
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        readers: list[str],
        on_progress: Callable[[Sequence[int]], None] = lambda _: None,
        checkpoints: Path | None = None,
        farewell: float = FAREWELL,
    ) -> None:
        super().__init__("switcher", record=record)
        self._farewell = farewell
        self._graphs = record.experiment.graph_list
        self._path = sojourns(record.experiment, model.initial)
        self._steps = record.experiment.steps
        self._reached = [-1] * model.agents
        self._slowest = -1
        self._heard = False  # from an agent since the last call of on_progress
        self._recorded = RECORDER not in readers
        self._on_progress = on_progress
        self._namesakes: set[str] = set()  # at the last look
        self._mark = checkpoints and checkpoints / f"switcher.{record.run}"
        self._expected = [agent_name(i) for i in range(model.agents)] + readers
        self._experiment = self.create_publisher(String, EXPERIMENT_TOPIC, LATCHED)
        self._graph = self.create_publisher(ActiveGraphMsg, GRAPH_TOPIC, LATCHED)
        self._end = self.create_publisher(ProgressMsg, END_TOPIC, LATCHED)
        self.create_subscription(ProgressMsg, PROGRESS_TOPIC, self._receive, LATCHED, raw=True)
        every(self, REPORT_PERIOD, self._report)

    def found(self) -> bool:
        """See NetworkNode."""
        return not self.awaited()

    def awaited(self) -> list[str]:
        """See NetworkNode. All that it publishes is latched: it is enough that the others are there."""
        here = self.get_namespace()
        there = {name for name, namespace in self.get_node_names_and_namespaces() if namespace == here}
        return [name for name in self._expected if name not in there]

    def companions(self) -> list[str]:
        """See NetworkNode."""
        return self._expected

    def health(self) -> Health:
        """See NetworkNode."""
        self._look_for_namesakes()
        values = {"step of the slowest agent": str(self._slowest)}
        if self._slowest < 0:
            silent = [agent_name(i) for i, step in enumerate(self._reached) if step < 0]
            return Health(f"waiting for {', '.join(silent)}", waiting=True, values=values)
        return self._how(values)

    def _how(self, values: dict[str, str]) -> Health:
        """How it is once all agents have started; ``values`` are what there is to say anyway."""
        raise NotImplementedError

    def _look_for_namesakes(self) -> None:
        """Say who is there twice, once it has been seen twice: someone that was killed may not be gone yet."""
        there = set(self.namesakes())
        for name in there & self._namesakes:
            if not self.refused[name, NAMESAKE]:
                self.refused[name, NAMESAKE] = 1
                self.get_logger().warning(f"there is a second node called {name}: what only one of them says is taken")
        self._namesakes = there

    def begin(self) -> None:
        """Publish the experiment, to begin with."""
        self.publish(self._experiment, encode_string(self.record.to_json()))

    def _moved(self) -> None:
        """The slowest agent has got further."""

    def finish(self, *, complete: bool, deadline: float) -> None:  # noqa: ARG002  it has a patience of its own
        """See NetworkNode. Nobody needs anything but the end any more, and who has left has had it."""
        if complete:
            self._end.wait_for_all_acked(Duration(seconds=self._farewell))

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
            self._moved()
        if self._recorded and slowest >= self._steps and not self.done.done():
            self._report()
            self.publish(self._end, self.progress(NOT_AN_AGENT, self._steps))
            self.done.set_result(None)

    def _report(self) -> None:
        if self._heard:
            self._heard = False
            self._on_progress(self._reached)

    def _publish_sojourn(self, sojourn: Sojourn) -> int:
        """Publish a sojourn; the bytes of its message."""
        message = self._message(sojourn).encode()
        self.publish(self._graph, message)
        return len(message)

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


class LockstepSwitcher(Switcher):
    """Keeps a bounded number of sojourns ahead of the agents. Parameters: see Switcher."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # Part of the path has been published if there is a mark, and nobody says how much.
        self._behind = bool(self._mark and self._mark.exists())
        self._ahead: deque[int] = deque()  # first steps of the published sojourns that the slowest has not reached
        self._most_ahead = AHEAD

    def _how(self, values: dict[str, str]) -> Health:
        """See Switcher."""
        values["sojourns ahead of it"] = str(len(self._ahead))
        return Health(f"{len(self._ahead)} sojourns ahead of step {self._slowest}", values=values)

    def begin(self) -> None:
        """Publish the experiment and the beginning of the path."""
        if self._mark:
            self._mark.touch()
        super().begin()
        self._moved()

    def _moved(self) -> None:
        """See Switcher: keep ahead."""
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
            self._go_ahead(sojourn)

    def _catch_up(self, slowest: int) -> None:
        """Publish again what may still have been under way when the process before this one went."""
        recent: deque[Sojourn] = deque(maxlen=BEHIND)
        for sojourn in self._path:
            recent.append(sojourn)
            if sojourn.last_step >= slowest:
                break
        for sojourn in recent:
            self._go_ahead(sojourn)
        self._behind = False

    def _go_ahead(self, sojourn: Sojourn) -> None:
        size = self._publish_sojourn(sojourn)
        self._most_ahead = min(self._most_ahead, max(AHEAD_LEAST, AHEAD_BYTES // size))
        self._ahead.append(sojourn.first_step)


class RealtimeSwitcher(Switcher):
    """Says when simulated time begins, and publishes each sojourn when it begins. Parameters: see Switcher."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._timer = DueTimer(self, self._keep_up)
        self._schedule: Schedule | None = None
        self._next = next(self._path, None)

    def _how(self, values: dict[str, str]) -> Health:
        """See Switcher."""
        if self._schedule is None:
            return Health("waiting for the time on /clock", waiting=True, values=values)
        late = self._next is not None and self._timer.now() - self._schedule.clock_time(self._next.first_step)
        values["lateness of the graph [ms]"] = f"{max(0, late) / 1e6:.3f}"
        return Health(f"step of the slowest agent: {self._slowest}", values=values)

    def begin(self) -> None:
        """Publish the experiment; and after another process, what that one has published of epoch and path."""
        super().begin()
        text = self._mark.read_text(encoding="ascii") if self._mark and self._mark.exists() else ""
        if text:
            self._start(int(text))

    def _report(self) -> None:
        super()._report()
        now = self._timer.now()
        if self._schedule is None and self._slowest >= 0 and now:
            epoch = now + HEAD_START
            if self._mark:  # whole or not at all: whoever takes over must go on with this epoch
                draft = self._mark.with_suffix(".draft")
                draft.write_text(str(epoch), encoding="ascii")
                draft.replace(self._mark)
            self._start(epoch)

    def _start(self, epoch: int) -> None:
        """Publish the epoch, and the path as far as it has come."""
        experiment = self.record.experiment
        self._schedule = Schedule(epoch=epoch, speed=experiment.run.speed, step_length=experiment.step_length)
        publisher = self.create_publisher(ProgressMsg, EPOCH_TOPIC, LATCHED)
        self.publish(publisher, Progress(epoch, self.run, NOT_AN_AGENT, 0).encode())
        self._keep_up()

    def _keep_up(self) -> None:
        """Publish every sojourn whose time has come, the first one before."""
        assert self._schedule is not None
        simulated = self._schedule.simulated(self._timer.now())
        come: deque[Sojourn] = deque(maxlen=BEHIND)
        while self._next and (self._next.first_step == 0 or self._schedule.due(self._next.first_step) <= simulated):
            come.append(self._next)
            self._next = next(self._path, None)
        for sojourn in come:
            self._publish_sojourn(sojourn)
        if self._next:
            self._timer.set(self._schedule.clock_time(self._next.first_step))


SWITCHERS: dict[str, type[Switcher]] = {"lockstep": LockstepSwitcher, "realtime": RealtimeSwitcher}  # by pace
