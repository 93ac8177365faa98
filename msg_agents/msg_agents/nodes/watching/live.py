"""The live node: the errors of a running or replayed network beside their prediction."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from msg_agents_interfaces.msg import AgentState as AgentStateMsg
from msg_agents_interfaces.msg import Estimate as EstimateMsg
from rclpy.duration import Duration
from std_msgs.msg import Header

from msg_agents.nodes.network_node import (
    state_topic,
    truth_topic,
    why_not,
)
from msg_agents.nodes.ros.qos import NEWEST, STREAM
from msg_agents.nodes.ros.timers import every
from msg_agents.nodes.watching.watch_process import LISTEN, Watcher, run_watcher
from msg_agents.recovery.checkpoint import longest_heard
from msg_analysis.inference.online.running_errors import LiveEstimate, LiveReport
from msg_analysis.model.arithmetic.step_clock import SECOND, StepClock
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire.messages import StateFrame

ESTIMATE_TOPIC = "estimate"
PERIOD = 1.0  # s between two estimates
FAREWELL = 5.0  # s for readers to acknowledge the last estimate
SILENCE = 5  # estimates without any state, after which a run that has ended or has no publishers is over


@dataclass(frozen=True, slots=True)
class Watched:
    """What has been seen of a network."""

    record: RunRecord
    report: LiveReport
    finished: bool  # followed to its last step


class Live(Watcher):
    """Reads the states of the first network that it hears of, and publishes its running estimates.

    With ``reliable`` it misses no state, and the network waits for this node where it is too slow.
    """

    def __init__(
        self,
        *,
        reliable: bool,
        on_report: Callable[[Watched, float], None],  # the float: steps per second
        on_note: Callable[[str], None],
    ) -> None:
        super().__init__("live", on_note=on_note)
        self.outcome: Watched | None = None  # set at the end
        self._qos = STREAM if reliable else LISTEN
        self._on_report = on_report
        self._estimate: LiveEstimate | None = None
        self._before = (-1, time.monotonic())  # newest step of the last estimate, and its time
        self._silent = 0  # estimates in a row without a newer state
        self._writer = self.create_publisher(EstimateMsg, ESTIMATE_TOPIC, NEWEST)

    def follow(self) -> None:
        """Read the states of the run; InputError if its prediction fails (too large, unbounded)."""
        assert self.record is not None
        record, experiment = self.record, self.record.experiment
        topic, width = state_topic, experiment.run.replicas
        if experiment.truth:
            topic, width = truth_topic, experiment.width
        frame = StateFrame(record.run.bytes, width, longest_heard(record))
        # Before the prediction, which takes some time: states that come meanwhile wait in the middleware.
        for agent in range(experiment.agents):
            self._topics.append(topic(agent))
            self.create_subscription(AgentStateMsg, topic(agent), self._receiver(agent, frame), self._qos, raw=True)
        self._clock_of_steps = StepClock(experiment.step_length)
        self._estimate = LiveEstimate(record)
        every(self, PERIOD, self._report)

    def watched(self) -> Watched | None:
        """What has been seen up to now; None: no network."""
        if self.record is None or self._estimate is None:
            return None
        report = self._estimate.report()
        for reason, count in self._refused.items():
            report.refused[reason] = report.refused.get(reason, 0) + count
        last = self.record.experiment.steps
        return Watched(self.record, report, self._estimate.steps.newest >= last)

    def _receiver(self, agent: int, frame: StateFrame) -> Callable[[bytes], None]:
        """The callback for the states of an agent (index from 0; hot path)."""
        unwrap, refused = frame.unwrap, self._refused

        def receive(data: bytes) -> None:
            found = unwrap(data)
            if found is None or found[0] != agent + 1:
                assert self.record is not None
                refused[why_not(data, self.record, agent, frame.replicas)] += 1
            elif self._estimate is not None:
                self._estimate.add(agent, found[1], found[2], found[3])

        return receive

    def _report(self) -> None:
        watched = self.watched()
        assert watched is not None
        newest, now = watched.report.newest, time.monotonic()
        before, then = self._before
        self._before = newest, now
        self._writer.publish(self._message(watched))
        self._on_report(watched, (newest - before) / max(now - then, 1e-9) if before >= 0 else 0.0)
        last = watched.record.experiment.steps
        assert self._estimate is not None
        self._silent = self._silent + 1 if newest == before else 0
        # All states are here, or no more come because the run has ended or its publishers have gone.
        quiet = self._silent >= (1 if newest >= 0 else SILENCE)
        over = self._estimate.steps.whole >= last or (quiet and (self._ended or not self._anybody()))
        if over and not self.done.done():
            self.done.set_result(None)

    def conclude(self) -> None:
        """See Watcher."""
        self.outcome = self.watched()

    def farewell(self) -> None:
        """See Watcher."""
        self._writer.wait_for_all_acked(Duration(seconds=FAREWELL))

    def _message(self, watched: Watched) -> EstimateMsg:
        report = watched.report
        seconds, nanoseconds = divmod(self._clock_of_steps.nanoseconds(max(report.last, 0)), SECOND)
        message = EstimateMsg(
            header=Header(stamp=Time(sec=seconds, nanosec=nanoseconds)),
            run=list(watched.record.run.bytes),
            first_step=max(report.first, 0),
            last_step=max(report.last, 0),
            steps=report.steps,
            node_errors=[_number(node.measured) for node in report.nodes],
            node_predicted=[_number(node.predicted) for node in report.nodes],
            node_standard_errors=[_number(node.standard_error) for node in report.nodes],
        )
        message.system_error = _number(report.system.measured)
        message.system_predicted = _number(report.system.predicted)
        message.system_standard_error = _number(report.system.standard_error)
        return message


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def watch(
    *,
    reliable: bool = False,
    timeout: float | None = None,  # s to wait for a network; None: forever
    on_report: Callable[[Watched, float], None] = lambda *_: None,
    on_note: Callable[[str], None] = lambda _: None,
    on_look: Callable[[], None] = lambda: None,  # called a few times a second
) -> Watched | None:
    """Watch a network until it is over or a signal ends it; what was seen, or None without a network.

    If the run is over, the node still exists: end the process at once. InputError: no network in time, or its
    prediction fails.
    """
    node = run_watcher(
        lambda: Live(reliable=reliable, on_report=on_report, on_note=on_note),
        timeout=timeout,
        on_note=on_note,
        on_look=on_look,
    )
    return node and node.outcome
