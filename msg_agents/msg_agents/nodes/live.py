# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The live node: the errors of a running or replayed network beside their prediction."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from msg_agents_interfaces.msg import Estimate as EstimateMsg
from std_msgs.msg import Header

from msg_agents.nodes.ros import every, until_shutdown
from msg_agents.nodes.watch_process import Watcher
from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.inference.online_errors import LiveEstimate, LiveReport
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal, decode_of_run
from msg_analysis.messages.messages import ActiveGraph, stamp_ns
from msg_analysis.model.run_record import RunRecord

ESTIMATE_PERIOD = 1.0  # s between two estimates
MOST_SILENT = 5  # estimates without any state, after which a run that has ended or has no publishers is over


@dataclass(frozen=True, slots=True)
class Watched:
    """What has been seen of a network."""

    record: RunRecord
    report: LiveReport
    finished: bool  # followed to its last step
    steps: list[int]  # newest step of each agent that has arrived, by index; -1: none
    last_step: int  # see ``Watcher``


class Live(Watcher):
    """Reads the states of the run whose record is given, or of the first one, and publishes its running estimates."""

    def __init__(
        self,
        *,
        reliable: bool,  # miss no state: the network waits for this node where it is too slow
        record: RunRecord | None,
        on_report: Callable[[Watched, float], None],  # the float: steps per second
        on_note: Callable[[str], None],
    ) -> None:
        super().__init__("live", topics.ESTIMATE, on_note=on_note, record=record)
        self.outcome: Watched | None = None  # set at the end
        self._qos = topics.STREAM if reliable else topics.PASSIVE
        self._on_report = on_report
        self._estimate: LiveEstimate | None = None
        self._reached: list[int] = []  # see ``Watched.steps``
        self._logged = False  # whether the messages are needed, and not only the states
        self._before = (-1, time.monotonic())  # newest step of the last estimate, and its time
        self._silent = 0  # estimates in a row without a newer state

    def follow(self) -> None:
        """Read the states of the run; InputError if its prediction fails (too large, unbounded)."""
        assert self.record is not None
        record, experiment = self.record, self.record.experiment
        # Before the prediction, which takes some time: states that arrive meanwhile wait in the middleware.
        self._subscribe_to_states(topics.TRUTH if experiment.truth else topics.STATE, self._qos, whole=True)
        if experiment.truth:
            self._subscribe_to_states(topics.STATE, self._qos, whole=False, take=self._take_published)
        self._reached = [-1] * experiment.agents
        self._realtime = experiment.run.pace == "realtime"
        self._clock_of_steps = StepClock(experiment.step_length)
        self._estimate = LiveEstimate(record)
        if self._realtime and self._estimate.log:
            self.subscribe(topics.GRAPH, self._receive_graph)
        self._logged = self._estimate.log is not None
        if self._end is not None:
            self._estimate.end_at(self.last_step)
        every(self, ESTIMATE_PERIOD, self._report)

    def watched(self) -> Watched | None:
        """What has been seen up to now; None: no network."""
        if self.record is None or self._estimate is None or not self.known.done():
            return None
        report = self._estimate.report()
        for reason, count in self._refused.items():
            report.refused[reason] = report.refused.get(reason, 0) + count
        last = self.last_step
        return Watched(self.record, report, self._estimate.steps.newest >= last, list(self._reached), last)

    def _take(self, agent: int, step: int, mode: int, state: bytes, message: bytes) -> None:
        if self._estimate is not None:
            self._estimate.add(agent, step, mode, state, message if self._logged else b"")
            self._reached[agent] = max(self._reached[agent], step)
            if self._realtime:
                self._estimate.add_stamps(agent, (step,), (stamp_ns(message),))

    def _take_published(self, agent: int, step: int, mode: int, value: bytes, message: bytes) -> None:  # noqa: ARG002
        """Take what an agent has published of its state. Hot path."""
        if self._estimate is not None and self._estimate.needs_published:
            self._estimate.add(agent, step, mode, value, published=True)

    def _receive_graph(self, data: bytes) -> None:
        """Take a holding period of the network's graph, as the reader of bags does."""
        assert self.record is not None
        assert self._estimate is not None
        found, experiment = decode_of_run(ActiveGraph, data, self.record.run.bytes), self.record.experiment
        if isinstance(found, str):
            self._refuse(found)
        elif not (1 <= found.mode <= len(experiment.graph_list) and found.first_step <= found.last_step):
            self._refuse(Refusal.GRAPH_OUT_OF_RANGE)
        elif not self._estimate.add_holding_period(found.first_step, found.last_step, found.mode - 1):
            self._refuse(Refusal.CONTRADICTION)

    def _ends(self) -> None:
        """See Watcher."""
        if self._estimate is not None:
            self._estimate.end_at(self.last_step)

    def _report(self) -> None:
        assert self._estimate is not None
        if not self.known.done():
            if self._estimate.steps.newest < 0:
                return
            self.known.set_result(None)
        watched = self.watched()
        assert watched is not None
        newest, now = watched.report.newest, time.monotonic()
        before, then = self._before
        self._before = newest, now
        with until_shutdown(self):
            self._writer.publish(self._message(watched))
        self._on_report(watched, (newest - before) / max(now - then, 1e-9) if before >= 0 else 0.0)
        self._silent = self._silent + 1 if newest == before else 0
        quiet = self._silent >= (1 if newest >= 0 else MOST_SILENT)
        self._finish_if_over(all_there=self._estimate.steps.whole >= self.last_step, quiet=quiet)

    def take_outcome(self) -> None:
        """See Watcher."""
        self.outcome = self.watched()

    def _message(self, watched: Watched) -> EstimateMsg:
        report = watched.report
        seconds, nanoseconds = divmod(self._clock_of_steps.nanoseconds(max(report.last, 0)), SECOND)
        return EstimateMsg(
            header=Header(stamp=Time(sec=seconds, nanosec=nanoseconds)),
            run=list(watched.record.run.bytes),
            first_step=max(report.first, 0),
            last_step=max(report.last, 0),
            steps=report.steps,
            node_errors=[_number(node.measured) for node in report.nodes],
            node_predicted=[_number(node.predicted) for node in report.nodes],
            node_standard_errors=[_number(node.standard_error) for node in report.nodes],
            system_error=_number(report.system.measured),
            system_predicted=_number(report.system.predicted),
            system_standard_error=_number(report.system.standard_error),
        )


def _number(value: float | None) -> float:
    return math.nan if value is None else value
