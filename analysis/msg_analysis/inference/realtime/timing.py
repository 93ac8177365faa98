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

"""Timing of a run in real time: lateness, missed deadlines, jitter, and the age of the values used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.realtime.unheard import UnheardMessages, unheard_messages
from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.sequential_law import ideal_uses
from msg_analysis.twin.ideal_timers import ideal_log
from msg_analysis.types import AnyArray, FloatArray, IntArray

BINS = 60


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Quantiles of a measure; None where there was nothing to measure."""

    p50: float | None
    p95: float | None
    p99: float | None
    max: float | None

    @classmethod
    def of(cls, values: AnyArray) -> Quantiles:
        """Of all entries of an array of any shape."""
        if not values.size:
            return cls(None, None, None, None)
        return cls(*(float(value) for value in (*np.quantile(values, (0.5, 0.95, 0.99)), values.max())))


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """Timing of a run in real time.

    Times in ms are those of the agents' clock: simulated time over the speed of the run.
    """

    period_ms: float  # nominal time between two steps of an agent
    lateness_ms: Quantiles  # of a step after it was due
    steps: int  # of all agents
    missed: int  # steps made more than a period after they were due
    jitter_ms: Quantiles  # |time between two successive steps of an agent - period|
    staleness_ms: Quantiles  # age of the values at the time of use
    staleness_steps: Quantiles  # step of the new state - step of the value; 0 or 1 with ideal timers
    uses: int  # neighbours' values that steps needed, those never heard or lost included
    ideal_uses: int  # uses of the value that ideal timers would have used, the own one for a lost one included
    never_heard: int  # uses in which nothing had been heard yet of the neighbour
    unheard: UnheardMessages
    outdated_graphs: int  # steps made with another graph than the network's at that time
    histogram: tuple[FloatArray, AnyArray]  # of lateness: edges [ms] (BINS + 1,) and counts (BINS,); covers all values
    ages: tuple[FloatArray, AnyArray]  # the same of ``staleness_ms``

    @property
    def missed_share(self) -> float:
        """Of all steps."""
        return self.missed / max(self.steps, 1)

    @property
    def ideal_share(self) -> float:
        """Of all uses, those that ideal timers would have made; 1 where no agent hears another."""
        return self.ideal_uses / self.uses if self.uses else 1.0

    @property
    def outdated_share(self) -> float:
        """Of all steps, those with another graph than the network's."""
        return self.outdated_graphs / max(self.steps, 1)

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        (edges, counts), (age_edges, age_counts) = self.histogram, self.ages
        return {
            "period_ms": self.period_ms,
            "lateness_ms": _document(self.lateness_ms),
            "deadlines": {"steps": self.steps, "missed": self.missed, "share": self.missed_share},
            "jitter_ms": _document(self.jitter_ms),
            "staleness_ms": _document(self.staleness_ms),
            "staleness_steps": _document(self.staleness_steps),
            "ideal_uses": {"uses": self.uses, "ideal": self.ideal_uses, "share": self.ideal_share},
            "never_heard": self.never_heard,
            "unheard": self.unheard.to_json(),
            "outdated_graph": {"steps": self.outdated_graphs, "share": self.outdated_share},
            "histogram": {
                "lateness_ms": edges.tolist(),
                "steps": counts.tolist(),
                "staleness_ms": age_edges.tolist(),
                "uses": age_counts.tolist(),
            },
        }


def measure_timing(observation: Observation) -> Timing:
    """Measure the timing of a run in real time."""
    timers, step = observation.timers, observation.step
    assert timers is not None
    experiment = observation.prediction.experiment
    steps, m = timers.graphs.shape
    agents = np.arange(m)
    milliseconds = 1e-6 / experiment.run.speed  # of the agents' clock, in a nanosecond of simulated time
    phase = phases(experiment)
    due = np.stack([StepClock(step.dt, phi).times(np.arange(steps)) for phi in phase.tolist()], axis=1)
    period = step.dt * 1e9
    lateness = timers.made[1:] - due
    late_ms = lateness * milliseconds

    tables = neighbour_tables(step)
    there = np.arange(step.most_neighbours) < tables.count[timers.graphs, agents][:, :, None]
    heard = there & (timers.used >= 0)
    made = timers.made[timers.used, tables.senders[timers.graphs, agents]]
    age = (timers.made[1:, :, None] - made)[heard] * milliseconds
    behind = (np.arange(1, steps + 1)[:, None, None] - timers.used)[heard]
    ideal = _ideal(observation, phase)
    jitter = np.abs(np.diff(timers.made[1:], axis=0) - period) * milliseconds
    return Timing(
        period_ms=period * milliseconds,
        lateness_ms=Quantiles.of(late_ms),
        steps=steps * m,
        missed=int((lateness > period).sum()),
        jitter_ms=Quantiles.of(jitter),
        staleness_ms=Quantiles.of(age),
        staleness_steps=Quantiles.of(behind),
        uses=int(there.sum()),
        ideal_uses=int((there & (timers.used == ideal)).sum()),
        never_heard=int((there & ~heard & (ideal >= 0)).sum()),
        unheard=unheard_messages(observation),
        outdated_graphs=int((timers.graphs != observation.modes[:, None]).sum()),
        histogram=_histogram(late_ms),
        ages=_histogram(age),
    )


def _ideal(observation: Observation, phase: FloatArray) -> IntArray:
    """(N, m, D) steps of the values that ideal timers would have used; -1: the own value, -2: not known."""
    timers, step, experiment = observation.timers, observation.step, observation.prediction.experiment
    assert timers is not None
    if not experiment.noise.steps_only:
        steps = np.arange(len(timers.graphs))[:, None, None]
        return np.asarray(ideal_uses(step, phase)[timers.graphs, np.arange(step.agents)] + steps)
    # Which messages are lost is in the seed; under another graph than the network's the neighbours are others.
    used = ideal_log(experiment, step, observation.modes)[1]
    return np.where((timers.graphs == observation.modes[:, None])[:, :, None], used, -2)


def _histogram(values: AnyArray) -> tuple[FloatArray, AnyArray]:
    low, high = min(0.0, float(values.min(initial=0.0))), max(float(values.max(initial=0.0)), 1e-3)
    counts, edges = np.histogram(values, bins=BINS, range=(low, high))
    return edges, counts


def _document(quantiles: Quantiles) -> dict[str, float | None]:
    return {"p50": quantiles.p50, "p95": quantiles.p95, "p99": quantiles.p99, "max": quantiles.max}
