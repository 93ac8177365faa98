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

"""The newest steps of a running network: the states as they were, and how late the agents are in real time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.phases import phases
from msg_analysis.types import FloatArray, IntArray

WINDOW = 240  # steps that are kept


@dataclass(frozen=True, slots=True, eq=False)
class Recent:
    """The newest whole steps, at least one, ascending; some may be missing between them."""

    steps: IntArray  # (b,)
    modes: IntArray  # (b,) graph k -> k+1 from 0; in real time that of the first agent, or 0 where it is not known
    states: FloatArray  # (b, m) first replica

    def newest(self) -> Recent:
        """The last ``WINDOW`` of any steps, in order, as a copy."""
        order = np.argsort(self.steps, kind="stable")[-WINDOW:]
        return Recent(self.steps[order], self.modes[order], self.states[order])


class RecentSteps:
    """Keeps the last ``WINDOW`` whole steps."""

    def __init__(self) -> None:
        self._kept: Recent | None = None

    def add(self, steps: IntArray, modes: IntArray, states: FloatArray) -> None:
        """Add whole steps k (b,): graphs from 0 (b,), x(k) (b, m, width)."""
        new = Recent(steps, modes, states[:, :, 0]).newest()
        if self._kept is not None:
            new = Recent(
                np.concatenate([self._kept.steps, new.steps]),
                np.concatenate([self._kept.modes, new.modes]),
                np.concatenate([self._kept.states, new.states]),
            ).newest()
        self._kept = new

    def newest(self) -> Recent | None:
        """What is kept; None before the first step."""
        return self._kept


class Lateness:
    """Real time: how long after they were due the agents made their newest steps, as in ``realtime.timing``."""

    def __init__(self, experiment: ValidExperiment) -> None:
        self._clocks = [StepClock(experiment.step_length, phase) for phase in phases(experiment).tolist()]
        self._speed = experiment.run.speed
        self._late: list[deque[int]] = [deque(maxlen=WINDOW) for _ in self._clocks]  # [ns] of simulated time

    def add(self, agent: int, step: int, stamp: int) -> None:
        """Take the stamp [ns] of x(step) of an agent (from 0)."""
        if step > 0:  # x(0) is there before the time begins
            self._late[agent].append(stamp - self._clocks[agent].nanoseconds(step - 1))

    def medians(self) -> list[float | None]:
        """Of each agent, over its last ``WINDOW`` steps that were added [s of wall time]; None: none was."""
        return [float(np.median(late)) / 1e9 / self._speed if late else None for late in self._late]
