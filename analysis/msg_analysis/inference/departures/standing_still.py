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

"""Agents that stand still: the same state twice, to the last bit, although there is noise."""

from __future__ import annotations

from typing import Self

import numpy as np

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.evidence.event_evidence import EventEvidence
from msg_analysis.types import BoolArray, FloatArray, IntArray

ROUNDINGS = 4.0  # of the largest state, in the computation of a state, at most
EPSILON = float(np.finfo(np.float64).eps)


class StandingStill(Departure):
    """Steps in which no replica of an agent moves.

    The density of a normal number is below 0.4 over its standard deviation, so the probability q of such a step is at
    most that of hitting an interval of a few roundings, for every replica. The mean of 1 / q over the steps that stood
    still, 0 for the others and 1 for those to come, is evidence; half of the whole always counts 1. Its inverse is the
    p of the test (Markov).
    """

    test = "innovations: standing still"

    def __init__(self, law: Law) -> None:
        self._agents = np.flatnonzero(law.noisy)
        self._evidence = EventEvidence(law.planned * len(self._agents))
        self._since = np.full(len(self._agents), -1)  # first step of what may go on, from 0; -1: moved
        self._longest: tuple[int, int, Place] | None = None  # steps, agent, place
        self._runs = 1

    def add(self, block: Block) -> FloatArray:
        """Look at the steps of a block."""
        looks = block.looks
        if not len(self._agents):
            return np.empty((looks.count, 0, 1))
        before, after = block.reception.states, block.after
        still: BoolArray = (after[:, self._agents] == before[:, self._agents]).all(axis=2)
        at, which = np.nonzero(still)
        size = np.spacing(np.abs(before[at]).max(axis=1))  # (s, R)
        chance = ROUNDINGS * (size / block.scale[at, self._agents[which]][:, None] + EPSILON)
        seen, logarithms = looks.lengths * len(self._agents), -np.log(np.minimum(chance, 1.0)).sum(axis=1)
        for place in np.unique(which).tolist():
            self._stretches(place, block.first, block.first + at[which == place])
        moved = ~still[-1]
        self._since[moved] = -1
        return self._evidence.add(seen, logarithms, looks.after(at))[:, None, None]

    def _stretches(self, place: int, first: int, steps: IntArray) -> None:
        """The longest stretch of an agent that stood still in ``steps`` from ``first`` on, ascending."""
        begins = steps[np.append(True, np.diff(steps) > 1)]
        ends = steps[np.append(np.diff(steps) > 1, True)]
        if self._since[place] >= 0 and begins[0] == first:
            begins[0] = self._since[place]
        longest = int(np.argmax(ends - begins))
        length = int(ends[longest] - begins[longest]) + 1
        if self._longest is None or length > self._longest[0]:
            found = Place(int(begins[longest]) + 1, int(ends[longest]) + 1)
            self._longest = (length, int(self._agents[place]), found)
        self._since[place] = begins[-1]

    def merge(self, other: Self) -> None:
        """Nothing goes on from one run to another."""
        self._evidence.merge(other._evidence)
        if other._longest and (self._longest is None or other._longest[0] > self._longest[0]):
            length, agent, place = other._longest
            self._longest = (length, agent, place.later(self._runs))
        self._runs += other._runs

    def finding(self) -> Finding | None:
        """The longest stretch."""
        if not len(self._agents):
            return None
        log_p = min(0.0, -self._evidence.logarithm())
        if self._longest is None:
            return Finding(self.test, log_p)
        length, agent, place = self._longest
        return Finding(self.test, log_p, agent=agent, place=place, estimate=float(length), expected=0.0)

    def evidence(self) -> FloatArray:
        """(1, 1)."""
        return np.array([[self._evidence.logarithm()]]) if len(self._agents) else np.empty((0, 1))

    def questions(self) -> list[Question]:
        """One, about all agents."""
        return [("agents that stand still", ())]
