# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A snapshot of a run, for a terminal or a browser."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_agents.stepping.monitoring import SILENT, StepAges, silence_text, silent_after
from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import agent_text, finite
from msg_analysis.model.graph_path import HoldingPeriod, holding_periods
from msg_analysis.model.step_model import first_graph

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment
    from msg_analysis.inference.online_errors import LiveReport
    from msg_analysis.inference.online_steps import Recent


WINDOW = 3.0  # s over which speeds are measured
GRAIN = 0.25  # s; least time between two measurements
MOST_HOLDING_PERIODS = 500  # that are shown beside the states
MOST_EVENTS = 50  # the newest, which a page gets
MOST_TRACED = 20  # agents whose states a page gets


class StepRates:
    """Steps per second of every agent over the last ``WINDOW`` seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: deque[tuple[float, list[int]]] = deque()

    def add(self, steps: Sequence[int]) -> None:
        """Take the newest step of every agent, by index."""
        now = self._clock()
        if self._seen and now - self._seen[-1][0] < GRAIN:
            return
        self._seen.append((now, list(steps)))
        while len(self._seen) > 2 and now - self._seen[1][0] > WINDOW:
            self._seen.popleft()

    def rates(self) -> tuple[list[float], float | None]:
        """Steps per second of every agent, and of the step that all have reached; empty, None: not known yet."""
        if len(self._seen) < 2:
            return [], None
        (then, before), (now, after) = self._seen[0], self._seen[-1]
        rates = [(b - a) / (now - then) for a, b in zip(before, after, strict=True)]
        # Not the least of these: in an overloaded network agents step in bursts, and one is always between two.
        return rates, (min(after) - min(before)) / (now - then)


class HoldingPeriods:
    """Finds the holding period of a step of a run."""

    def __init__(self, experiment: Experiment) -> None:
        self._rest: Iterator[HoldingPeriod] = holding_periods(experiment, first_graph(experiment))
        self._now = next(self._rest, None)
        self._before: deque[HoldingPeriod] = deque(maxlen=MOST_HOLDING_PERIODS)

    def at(self, step: int) -> HoldingPeriod | None:
        """The holding period of the step k -> k+1; steps must not decrease from call to call."""
        while self._now is not None and step > self._now.last_step:
            following = next(self._rest, None)
            if following is None:  # the end of the run
                break
            self._before.append(self._now)
            self._now = following
        return self._now

    def since(self, step: int) -> list[HoldingPeriod]:
        """The holding periods from that of a step to the present one, the last ``MOST_HOLDING_PERIODS`` of them."""
        known = [*self._before, *([self._now] if self._now else [])]
        return [holding for holding in known if holding.last_step >= step]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of a run at one time."""

    # Newest step of every agent, -1: none; empty before the start; a single one for all where only that is known.
    steps: list[int]
    rates: list[float] = field(default_factory=list)  # steps per second, as ``steps``; empty where not known
    rate: float | None = None  # steps per second of all agents together; None where not known
    holding: HoldingPeriod | None = None  # of the slowest agent's next step; None before the start
    left: float | None = None  # s until the end at this ``rate``; None where not known
    report: LiveReport | None = None  # the errors up to now
    note: str | None = None  # about the errors
    ages: list[float] = field(default_factory=list)  # s since each agent has made its newest step
    gone: frozenset[int] = frozenset()  # agents (from 0) without a process, or with one that has made no step yet
    path: list[HoldingPeriod] = field(default_factory=list)  # holding periods from the oldest of ``report.recent`` on
    events: tuple[tuple[int, str], ...] = ()  # the newest ``MOST_EVENTS``: step that all had reached, text
    last: int | None = None  # last step of a run that ends before its planned end; None: not known to do so
    silent: frozenset[int] = frozenset()  # in real time: agents (from 0) without a step for a while, others have some
    warning: str | None = None  # about these

    @property
    def reached(self) -> int:
        """The step that every agent has reached, but for silent ones; -1: none. What is after the end is no part."""
        reached = min((step for agent, step in enumerate(self.steps) if agent not in self.silent), default=-1)
        return reached if self.last is None else min(reached, self.last)


class SnapshotSource:
    """Makes snapshots of a run from the steps that its agents have reached."""

    def __init__(self, experiment: Experiment, clock: Callable[[], float] = time.monotonic) -> None:
        self._steps, self._names = experiment.steps, experiment.names
        self._last: int | None = None  # where the run ends early
        self._holding_periods, self._rates = HoldingPeriods(experiment), StepRates(clock)
        after = silent_after(due_rate(experiment)) if experiment.run.pace == "realtime" else math.inf
        self._ages = StepAges(after, clock)
        self.silent = self._ages.silent
        self._gone: set[int] = set()  # agents (from 0) whose process has ended, until a new one makes a step
        self._events: deque[tuple[int, str]] = deque(maxlen=MOST_EVENTS)
        self._refused: dict[str, int] = {}
        self._reached = -1

    def ends_at(self, step: int) -> None:
        """The run ends at this step, before its planned end."""
        self._last = self._steps = step

    def happened(self, text: str) -> None:
        """Something happened, now."""
        self._events.append((self._reached, text))

    def snapshot(
        self,
        steps: Sequence[int],
        report: LiveReport | None = None,
        note: str | None = None,
        ended: Iterable[int] = (),
        pids: Mapping[int, int] | None = None,
    ) -> Snapshot:
        """The snapshot now, from the newest step of every agent; ``ended``: those (from 0) without a process."""
        now = Snapshot(list(steps), report=report, note=note or (report.note if report else None), last=self._last)
        self._reached = max(self._reached, now.reached)
        back, ended = set(self._ages.update(steps, self._steps)), set(ended)
        for agent in sorted(self._gone & back - ended):
            self.happened(f"{agent_text(agent + 1, self._names)} is back")
        self._gone = self._gone - back | ended
        if silent := self._ages.silent():
            quiet, others = min(silent.values()), len(steps) - len(silent)
            words = silence_text(sorted(silent), quiet, others, pids or {}, self._names)
            now = replace(now, silent=frozenset(silent), warning=words)
        self._reached = max(self._reached, now.reached)
        for reason, count in (report.refused if report else {}).items():
            if reason not in self._refused:
                self.happened(f"messages are refused: {reason} ({count} so far)")
            self._refused[reason] = count
        now = replace(now, ages=self._ages.ages(), gone=frozenset(self._gone), events=tuple(self._events))
        if now.reached < 0:
            return now
        self._rates.add(steps)
        rates, rate = self._rates.rates()
        left = (self._steps - now.reached) / rate if rate else None
        holding = self._holding_periods.at(min(now.reached, self._steps - 1))
        now = replace(now, rates=rates, rate=rate, left=left, holding=holding)
        recent = report.recent if report else None
        return now if recent is None else replace(now, path=self._holding_periods.since(int(recent.steps[0])))


def due_rate(experiment: Experiment) -> float:
    """Steps per second that are due in real time."""
    return experiment.run.speed / experiment.step_length


def run_description(experiment: Experiment) -> dict[str, Any]:
    """What does not change in a run, for a page that draws it: agents, graphs, positions."""
    from msg_analysis.report.look import places

    where = places(experiment.graph_list)
    return {
        "name": experiment.name,
        "problem": experiment.problem,
        "agents": experiment.agents,
        "names": experiment.names,
        "steps": experiment.steps,
        "dt": experiment.step_length,
        "pace": experiment.run.pace,
        "silent": silent_after(due_rate(experiment)) if experiment.run.pace == "realtime" else SILENT,
        "leaders": list(experiment.spec.leaders.agents) if experiment.spec.leaders else [],
        "external": sorted(experiment.external),
        "reference": experiment.reference if experiment.spec.leaders else None,
        "graphs": [
            {
                "name": graph.name,
                "directed": not graph.symmetric,
                "links": [[a - 1, b - 1] for a, b, _ in (graph.edges if graph.symmetric else graph.arcs)],
            }
            for graph in experiment.graph_list
        ],
        "places": [[float(x) for x in where[agent]] for agent in range(experiment.agents)],
    }


def snapshot_document(snapshot: Snapshot, before: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """A snapshot for a page; unknown numbers are None, the graph counts from 0 and the holding period from 1."""
    report, holding = snapshot.report, snapshot.holding
    recent = report.recent if report else None
    return {
        "steps": snapshot.steps if len(snapshot.steps) > 1 else [],
        "reached": snapshot.reached,
        "last": snapshot.last,
        "rate": snapshot.rate or 0.0,
        "left": snapshot.left,
        "graph": None if holding is None else holding.mode,
        "holding": None if holding is None else [holding.sequence + 1, holding.first_step, holding.last_step],
        "system": report.system.to_json() if report else None,
        "nodes": [node.to_json() for node in report.nodes] if report else None,
        "any_time": report.any_time.to_json() if report else None,
        "values": None if recent is None else finite(_newest(recent.states).tolist()),
        "errors_step": report.last if report else None,  # which the states are ahead of while an agent is silent
        "values_step": None if recent is None else int(recent.steps[-1]),
        "trace": None if recent is None else _trace(snapshot, recent, before and before["trace"]),
        "lateness": report.lateness if report else None,
        "ages": [round(age, 2) for age in snapshot.ages] if len(snapshot.ages) > 1 else [],
        "gone": sorted(snapshot.gone),
        "events": [list(event) for event in snapshot.events],
        "note": snapshot.note,
        "warning": snapshot.warning,
    }


def _newest(states: FloatArray) -> FloatArray:
    """(m,) newest state of every agent, of (b, m) with NaN where there is none."""
    there = ~np.isnan(states)
    rows = len(states) - 1 - np.argmax(there[::-1], axis=0)
    return np.asarray(states[rows, range(states.shape[1])])


def _trace(snapshot: Snapshot, recent: Recent, before: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """The newest states of the first agents, in four digits, with the graphs; ``before`` while there are none new."""
    steps = recent.steps.tolist()
    if before is not None and before["steps"] == steps:
        return before
    return {
        "steps": steps,
        "agents": finite([[float(f"{x:.4g}") for x in column] for column in recent.states.T[:MOST_TRACED].tolist()]),
        "path": [[each.mode, each.first_step, each.last_step] for each in snapshot.path],
    }
