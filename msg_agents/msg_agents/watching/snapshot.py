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

"""A snapshot of a run, for a terminal or a browser."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from msg_analysis.model.run.graph_path import Sojourn, sojourns
from msg_analysis.model.step.step_model import first_graph

if TYPE_CHECKING:
    from msg_analysis.inference.online.running_errors import LiveReport
    from msg_analysis.model.experiment.experiment import ValidExperiment

WINDOW = 3.0  # s over which speeds are measured
GRAIN = 0.25  # s; least time between two measurements


class StepRates:
    """Steps per second of every agent over the last ``WINDOW`` seconds."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, list[int]]] = deque()

    def add(self, steps: Sequence[int]) -> None:
        """Take the newest step of every agent, by index."""
        now = time.monotonic()
        if self._seen and now - self._seen[-1][0] < GRAIN:
            return
        self._seen.append((now, list(steps)))
        while len(self._seen) > 2 and now - self._seen[1][0] > WINDOW:
            self._seen.popleft()

    def rates(self) -> list[float]:
        """Steps per second of every agent; empty before the second measurement."""
        if len(self._seen) < 2:
            return []
        (then, before), (now, after) = self._seen[0], self._seen[-1]
        return [(b - a) / (now - then) for a, b in zip(before, after, strict=True)]

    def rate(self) -> float | None:
        """By how many steps per second the step that all agents have reached has moved; None where not known.

        Not the least of ``rates``: in an overloaded network agents step in bursts, and one is always between two.
        """
        if len(self._seen) < 2:
            return None
        (then, before), (now, after) = self._seen[0], self._seen[-1]
        return (min(after) - min(before)) / (now - then)


class SojournFinder:
    """Finds the sojourn of a step of a run."""

    def __init__(self, experiment: ValidExperiment) -> None:
        self._rest: Iterator[Sojourn] = sojourns(experiment, first_graph(experiment))
        self._now = next(self._rest, None)

    def at(self, step: int) -> Sojourn | None:
        """The sojourn of the step k -> k+1; steps must not decrease from call to call."""
        while self._now is not None and step > self._now.last_step:
            following = next(self._rest, None)
            if following is None:  # the end of the run
                break
            self._now = following
        return self._now


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of a run at one time."""

    # Newest step of every agent, -1: none; empty before the start; a single one for all where only that is known.
    steps: list[int]
    rates: list[float] = field(default_factory=list)  # steps per second, as ``steps``; empty where not known
    rate: float | None = None  # steps per second of all agents together; None where not known
    sojourn: Sojourn | None = None  # of the slowest agent's next step; None before the start
    left: float | None = None  # s until the end at this ``rate``; None where not known
    report: LiveReport | None = None  # the errors up to now
    note: str | None = None  # about the errors

    @property
    def reached(self) -> int:
        """The step that every agent has reached; -1: none."""
        return min(self.steps, default=-1)


class SnapshotSource:
    """Makes snapshots of a run from the steps that its agents have reached."""

    def __init__(self, experiment: ValidExperiment) -> None:
        self._steps = experiment.steps
        self._sojourns, self._rates = SojournFinder(experiment), StepRates()

    def snapshot(self, steps: Sequence[int], report: LiveReport | None = None, note: str | None = None) -> Snapshot:
        """The snapshot now, from the newest step of every agent (-1: none; empty before the start)."""
        now = Snapshot(list(steps), report=report, note=note or (report.note if report else None))
        if now.reached < 0:
            return now
        self._rates.add(steps)
        now = replace(now, rates=self._rates.rates(), rate=self._rates.rate())
        left = (self._steps - now.reached) / now.rate if now.rate else None
        return replace(now, left=left, sojourn=self._sojourns.at(min(now.reached, self._steps - 1)))


def run_description(experiment: ValidExperiment) -> dict[str, Any]:
    """What does not change in a run, for a page that draws it: agents, graphs, positions."""
    from msg_analysis.report.figures.agent_places import places

    where = places(experiment.graph_list)
    return {
        "name": experiment.name,
        "problem": experiment.problem,
        "agents": experiment.agents,
        "steps": experiment.steps,
        "dt": experiment.step_length,
        "pace": experiment.run.pace,
        "leaders": list(experiment.leaders.agents) if experiment.leaders else [],
        "reference": experiment.reference if experiment.leaders else None,
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


def snapshot_document(snapshot: Snapshot) -> dict[str, Any]:
    """A snapshot for a page; unknown numbers are None, the graph counts from 0 and the sojourn from 1."""
    report, sojourn = snapshot.report, snapshot.sojourn
    latest = report.latest if report else None
    return {
        "steps": snapshot.steps if len(snapshot.steps) > 1 else [],
        "reached": snapshot.reached,
        "rate": snapshot.rate or 0.0,
        "left": snapshot.left,
        "graph": None if sojourn is None else sojourn.mode,
        "sojourn": None if sojourn is None else [sojourn.sequence + 1, sojourn.first_step, sojourn.last_step],
        "system": report.system.to_json() if report else None,
        "nodes": [node.to_json() for node in report.nodes] if report else None,
        "values": None if latest is None else latest[2].tolist(),
        "values_step": None if latest is None else latest[0],
        "note": snapshot.note,
    }
