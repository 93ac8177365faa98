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

"""Which values went into a state, by what its message logs: the field ``heard`` of docs/messages.md."""

from __future__ import annotations

import numpy as np

from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air import LOST, NOTHING
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import AnyArray, BoolArray, IntArray


class LoggedInputs:
    """What ``heard`` can be in a run, and what it says. Agents count from 0, graphs as sent: from 1, 0 at step 0.

    ``heard`` (states, D) uint64 has 0 beyond its end, after ``count`` (states,) entries.
    """

    def __init__(self, model: Wiring, experiment: ValidExperiment) -> None:
        noise, self.realtime = experiment.noise, experiment.run.pace == "realtime"
        self.most = model.most_neighbours  # D
        self._last = np.uint64(experiment.steps)
        self._delay, self._lossy = noise.delay, noise.loss.any or self.realtime
        self.holds = noise.holds and not self.realtime  # whether an older value stands for a lost one in lockstep
        self._neighbours = np.zeros((model.modes + 1, model.agents), dtype=np.int64)  # row 0: no graph led to step 0
        for mode in range(model.modes):
            self._neighbours[mode + 1] = [len(model.neighbours(mode, i)) for i in range(model.agents)]

    def neighbours(self, mode: IntArray, agent: IntArray) -> IntArray:
        """How many neighbours these agents have in these graphs."""
        return np.asarray(self._neighbours[mode, agent])

    def newest(self, step: IntArray) -> IntArray:
        """In lockstep: steps of the newest messages that are used in the steps to states of these steps."""
        return np.maximum(0, step - 1 - self._delay)

    def fit(self, step: IntArray, mode: IntArray, agent: IntArray, heard: AnyArray, count: IntArray) -> BoolArray:
        """Whether ``heard`` is possible: one entry per neighbour in their graph, each a step that can be.

        In lockstep that is the newest one, and an empty ``heard`` says so of all; where the last value heard takes the
        place of a lost one (``holds``) an earlier one, too; else ``LOST``, if messages can be lost.
        """
        newest = self.newest(step).astype(np.uint64)[:, None]
        possible = heard == newest
        if self.realtime or self.holds:
            possible = heard <= (self._last if self.realtime else newest)
        if self._lossy and not self.holds:
            possible |= heard == LOST
        known = possible | (np.arange(self.most) >= count[:, None])
        fits = (count == self.neighbours(mode, agent)) & known.all(axis=1)
        return np.asarray(fits if self.realtime else fits | (count == 0))

    def used(self, step: IntArray, mode: IntArray, agent: IntArray, heard: AnyArray, count: IntArray) -> IntArray:
        """(states, D) steps of the values used; NOTHING where the own value took their place, and beyond the last."""
        there = np.arange(self.most) < self.neighbours(mode, agent)[:, None]
        newest = self.newest(step)[:, None]
        listed = np.where(heard == LOST, NOTHING, heard.astype(np.int64))
        return np.where(there, np.where(count[:, None] > 0, listed, newest), NOTHING)

    def lost(self, step: IntArray, mode: IntArray, agent: IntArray, used: IntArray) -> BoolArray:
        """(states, D) in lockstep: whether the newest message was lost, given the values ``used``."""
        there = np.arange(self.most) < self.neighbours(mode, agent)[:, None]
        return np.asarray(there & (used < self.newest(step)[:, None]))
