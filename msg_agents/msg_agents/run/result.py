# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Files in which the processes of a run report to the runner, so that neither side waits for the other; the result."""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msg_analysis.common.files import REPORT_FILE, RESULT_FILE, write_whole
from msg_analysis.common.text import json_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run

if TYPE_CHECKING:
    from msg_analysis.inference.comparison import Comparison


@dataclass(slots=True)
class StatusSummary:
    """Sum of the status files of a run."""

    refused: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # by (node, topic, reason)
    waiting: dict[str, str] = field(default_factory=dict)  # by node, what it waits for; only nodes that wait

    def rejected_messages(self) -> list[dict[str, Any]]:
        """Key ``rejected_messages`` of result.json: refused messages by node, topic and reason, with their counts."""
        return [
            {"node": node, "topic": topic, "reason": reason, "count": count}
            for (node, topic, reason), count in sorted(self.refused.items())
        ]


def write_report(path: Path, document: Any) -> None:
    """Replace a file as a whole; an error such as a full disk is ignored."""
    with contextlib.suppress(OSError):
        write_whole(path, json.dumps(document).encode())


def read_report(path: Path) -> Any:
    """What is in such a file; None: it is not there, or damaged."""
    with contextlib.suppress(OSError, ValueError):
        return json.loads(path.read_bytes())
    return None


def read_steps(path: Path) -> list[int]:
    """The newest step of every agent; empty as long as there is no such file."""
    return read_report(path) or []


def read_status_files(paths: Iterable[Path]) -> StatusSummary:
    """Add up the status files of processes, given in the order of their starts."""
    status = StatusSummary()
    waiting: dict[str, str] = {}
    for document in filter(None, map(read_report, paths)):
        for *what, count in document["refused"]:
            status.refused[tuple(what)] += count
        waiting |= document["waiting"]  # later processes are more recent; "": does not wait
    status.waiting = {node: message for node, message in waiting.items() if message}
    return status


_STATUS_PERIOD = 1.0  # s between two readings of the status files


class EventLog:
    """Appends dictionaries with "kind" (killed, back, refused), "step", "node" and "words" to a list."""

    def __init__(self, events: list[dict[str, Any]], clock: Callable[[], float] = time.monotonic) -> None:
        self._events, self._clock = events, clock
        self._absent: dict[str, tuple[Sequence[int], int]] = {}  # by node: its agents from 0, their step
        self._refused: set[tuple[str, str, str]] = set()
        self._next_status = clock()
        self._newest = 0

    def killed(self, node: str, agents: Sequence[int], step: int, words: str) -> None:
        """Note that a process, with these agents (from 0), has ended after this step."""
        if agents:  # one without any, such as the switcher, makes no steps: it is not known to be back
            self._absent[node] = agents, step
        self._add("killed", step if agents else self._newest, node, words)

    def look(self, steps: Sequence[int], status: Callable[[], StatusSummary], *, last: bool = False) -> None:
        """Note who is back and what is refused, given the newest step of every agent; ``last``: at the end."""
        newest = self._newest = max(steps, default=0)
        for node, (agents, step) in list(self._absent.items()):
            if steps and min(steps[agent] for agent in agents) > step:
                del self._absent[node]
                self._add("back", newest, node, f"{node}: back")
        if self._clock() < self._next_status and not last:
            return
        self._next_status = self._clock() + _STATUS_PERIOD
        for node, topic, reason in sorted(set(status().refused) - self._refused):
            self._refused.add((node, topic, reason))
            self._add("refused", newest, node, f"{node}: refused on {topic}: {reason} (first noticed)")

    def _add(self, kind: str, step: int, node: str, words: str) -> None:
        self._events.append({"kind": kind, "step": max(step, 0), "node": node, "words": words})


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
    rejected_messages
        messages that the nodes refused: dictionaries with "node", "topic", "reason", "count"
    events
        when processes were killed and back, and messages first refused: see ``EventLog``
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
    not_kept
        files that could not be written, on a full disk for example, and why, one line each
    """

    experiment: Experiment
    bag: Path | None
    failures: list[str] = field(default_factory=list)
    interrupted_by: int | None = None
    wall_time: float = 0.0
    rate: float = 0.0
    restarts: list[str] = field(default_factory=list)
    rejected_messages: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    reached: int = -1
    until: dict[str, Any] | None = None
    clocks: list[dict[str, Any]] | None = None
    channel: dict[str, Any] | None = None
    trajectory: Run | None = None
    comparison: Comparison | None = None
    report: Path | None = None
    not_kept: list[str] = field(default_factory=list)

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

    @property
    def incomplete(self) -> bool:
        """Whether a process failed, or states are missing."""
        return bool(self.failures) or (self.trajectory is not None and not self.trajectory.completeness.complete)

    def to_json(self) -> dict[str, Any]:
        """The document of result.json and of ``msg-agents run --json``."""
        document: dict[str, Any] = {"verdict": "incomplete" if self.incomplete else None}  # None: nothing to judge
        if self.comparison is not None:
            document = dict(self.comparison.to_json())
        elif self.interrupted:
            document |= _without_comparison(self.experiment)
        return document | {
            "bag": str(self.bag) if self.recorded else None,
            "report": str(self.report) if self.report else None,
            "rate": self.rate,
            "wall_time": self.wall_time,
            "restarts": self.restarts,
            "events": self.events,
            "rejected_messages": self.rejected_messages,
            "failures": self.failures,
            "not_kept": self.not_kept,
            "clocks": self.clocks,
            "channel": self.channel,
            "until": self.until,
            "notes": list(self.experiment.notes),
        }

    def write(self) -> None:
        """Write result.json into the bag, if there is a comparison, or an interrupted run that left a bag.

        An error of the system is noted in ``not_kept``.
        """
        if self.bag is not None and (self.comparison is not None or (self.interrupted and self.recorded)):
            file = self.bag / RESULT_FILE
            try:
                write_whole(file, json_text(self.to_json(), 1).encode() + b"\n")
            except OSError as error:
                self.not_kept.append(f"{file}: {error.strerror}")

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


def _without_comparison(experiment: Experiment) -> dict[str, Any]:
    """What ``msg-analysis tabulate`` reads of a result, without numbers."""
    from msg_analysis.inference.estimates import Estimate

    return {
        "experiment": experiment.name,
        "leaders": (experiment.leader_gains.nonzero()[0] + 1).tolist(),
        "seed": experiment.run.seed,
        "simulated_time": 0.0,
        "system_error": Estimate().to_json(),
    }


def conclude(result: RunResult, report: ReportWhen = "always", **limits: float) -> None:
    """Set the ``comparison`` (``limits``: arguments of it) of a run whose bag was read, and write report and result.

    What cannot be written is noted in ``not_kept``: the verdict holds without it.
    """
    if result.trajectory is None or result.bag is None:
        return
    from msg_analysis.inference.pool import compare

    comparison = compare(result.trajectory, **limits)
    if result.channel is not None and comparison.timing is not None:
        from msg_agents.run.run_channel import channel_findings

        timing = comparison.timing
        result.channel["findings"] = channel_findings(result.channel, timing.lost_messages, timing.period_ms)
    if report == "always" or (report == "on-failure" and comparison.verdict != "agrees"):
        from msg_analysis.report.page import write_report

        try:
            result.report = write_report(
                comparison,
                result.bag / REPORT_FILE,
                restarts=result.restarts,
                rejected_messages=result.rejected_messages,
                events=result.events,
                wall_time=result.wall_time,
                channel=result.channel,
            )
        except InputError as error:
            result.not_kept.append(str(error))
    result.comparison = comparison
    result.write()
