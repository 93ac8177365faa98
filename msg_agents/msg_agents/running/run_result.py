# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a run leaves behind, and its comparison with the prediction."""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msg_analysis.common.files import REPORT_FILE
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.run.trajectory import Trajectory

if TYPE_CHECKING:
    from msg_analysis.inference.verdict.comparison import Comparison

ReportWhen = Literal["always", "on-failure", "never"]


@dataclass(slots=True)
class RunResult:
    """What a run left behind.

    Attributes
    ----------
    experiment
        what was run
    bag
        directory; None if nothing was to be recorded on this host
    failures
        what went wrong, one line each
    interrupted_by
        number of the signal (Ctrl-C: SIGINT) that ended the run, or the comparison; then the bag is not read
    wall_time
        s from the first state of the slowest agent to its last one, as reported a few times a second
    rate
        steps of the slowest agent per second of wall time
    restarts
        processes that were killed, or crashed, and were started again, one line each
    strangers
        messages that the nodes refused: dictionaries with "node", "topic", "reason", "count"
    events
        when processes were killed and back, and messages first refused: see ``running.event_log``
    reached
        newest step of the slowest agent, as last reported; -1: none
    until
        of a run that may end early: "rule", "planned_steps", "ended_early", "step" (the last one, None: not known) and
        "reason", in words; else None
    clocks
        with several hosts in real time, how far the clocks of the agents' hosts are ahead of the switcher's:
        dictionaries with "node" and "ahead_ms", an interval; None: not compared
    channel
        what the channel did: see ``channel.counts``; None: there was none
    trajectory
        states of the bag; None if there is none, or it could not be read, or the run was interrupted
    comparison
        with the prediction; None before ``conclude``
    report
        file of the report; None: not written
    """

    experiment: ValidExperiment
    bag: Path | None
    failures: list[str] = field(default_factory=list)
    interrupted_by: int | None = None
    wall_time: float = 0.0
    rate: float = 0.0
    restarts: list[str] = field(default_factory=list)
    strangers: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    reached: int = -1
    until: dict[str, Any] | None = None
    clocks: list[dict[str, Any]] | None = None
    channel: dict[str, Any] | None = None
    trajectory: Trajectory | None = None
    comparison: Comparison | None = None
    report: Path | None = None

    @property
    def interrupted(self) -> bool:
        """Whether a signal has ended the run, or the comparison."""
        return self.interrupted_by is not None

    @property
    def recorded(self) -> bool:
        """Whether there is a bag that can be read, although perhaps not to its end."""
        if self.trajectory is None and not self.interrupted:
            return False
        return self.bag is not None and any(self.bag.glob("*.mcap"))

    def interrupt(self, by: int, during: str) -> None:
        """Note that a signal has ended the run or the comparison.

        Parameters
        ----------
        by
            number of the signal
        during
            when, in words; may be empty
        """
        self.interrupted_by = by
        name = "Ctrl-C" if by == signal.SIGINT else signal.Signals(by).name
        self.failures.insert(0, f"stopped by {name} {during}".rstrip())


def conclude(result: RunResult, report: ReportWhen = "always") -> None:
    """Compare the bag of a run with its prediction, and write report.html into the bag.

    Does nothing if there is no bag, or it was not read.

    Parameters
    ----------
    result
        from ``run_network``; its ``comparison`` is set
    report
        when the report is written; "on-failure": if the verdict is not "agrees"

    Raises
    ------
    InputError
        there is no prediction (too large, unbounded), the bag lacks what is needed, or the report cannot be written
    """
    if result.trajectory is None or result.bag is None:
        return
    from msg_analysis.inference.verdict.compare import compare

    comparison = compare(result.trajectory)
    if result.channel is not None and comparison.timing is not None:
        from msg_agents.channel.findings import channel_findings

        timing = comparison.timing
        result.channel["findings"] = channel_findings(result.channel, timing.unheard, timing.period_ms)
    if report == "always" or (report == "on-failure" and comparison.verdict != "agrees"):
        from msg_analysis.report.html.report_page import write_report

        file = result.bag / REPORT_FILE
        write_report(
            comparison,
            result.trajectory,
            file,
            restarts=result.restarts,
            strangers=result.strangers,
            events=result.events,
            wall_time=result.wall_time,
            channel=result.channel,
        )
        result.report = file
    result.comparison = comparison
