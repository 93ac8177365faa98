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

"""Where the states of two runs differ, bit for bit: in blocks of steps, so that long runs take no more memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS, release
from msg_analysis.common.long_work import tell
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.types import BoolArray, FloatArray, IntArray


def state_difference(a: Trajectory, b: Trajectory) -> dict[str, Any]:
    """The key ``states`` of the difference of two runs; steps count from 0, agents and replicas from 1.

    States of a step count as equal if both are missing; +0 and -0 are different.
    """
    if a.states.shape[1:] != b.states.shape[1:]:
        why = f"{_shape(a)} and {_shape(b)}"
        return {"compared": None, "why": why, "equal": None, **dict.fromkeys(_KEYS)}
    steps = min(len(a.states), len(b.states)) - 1
    found = _Differences(a.record.experiment.step_length)
    numbers = 4 * max(1, a.states[:1].size)
    length = max(1, BLOCK_NUMBERS // numbers)
    for first in range(0, steps + 1, length):
        tell("comparing states", first, steps + 1)
        block = slice(first, min(first + length, steps + 1))
        found.add(first, a.states[block], b.states[block])
        for array in (a.states, b.states):
            release(array)
    return {
        "compared": steps,
        "why": None,
        "equal": not found.states and not found.only_a and not found.only_b and len(a.states) == len(b.states),
        **{key: getattr(found, key) for key in _KEYS},
    }


def graph_difference(a: Trajectory, b: Trajectory) -> dict[str, Any] | None:
    """First step in which the runs used different graphs, and the names of these; None: there is none."""
    names_a, names_b = ([graph.name for graph in run.record.experiment.graph_list] for run in (a, b))
    steps = min(len(a.modes), len(b.modes))
    places = np.array([names_a.index(name) if name in names_a else -2 for name in names_b] + [-1])  # -1: not known
    there: IntArray = places[b.modes[:steps]]
    known = (a.modes[:steps] >= 0) & (b.modes[:steps] >= 0)
    differs = known & (a.modes[:steps] != there)
    if not differs.any():
        return None
    step = int(np.argmax(differs))
    return {"step": step, "a": names_a[a.modes[step]], "b": names_b[b.modes[step]], "steps": int(differs.sum())}


def _shape(run: Trajectory) -> str:
    agents, width = run.states.shape[1:]
    return f"{agents} agents with {width} {'number' if width == 1 else 'numbers'} each"


_KEYS = ("first", "largest", "last", "steps", "states", "only_a", "only_b")


@dataclass(slots=True)
class _Differences:
    """What the blocks so far have shown."""

    step_length: float
    first: dict[str, Any] | None = None  # step that differs: its time, agents, and largest difference
    largest: dict[str, Any] | None = None  # difference of all
    last: dict[str, Any] | None = None  # the newest step of which both runs have all states: largest difference
    steps: int = 0  # that differ
    states: int = 0  # that differ, of one agent each
    only_a: int = 0  # states that only one run has
    only_b: int = 0

    def add(self, begin: int, a: FloatArray, b: FloatArray) -> None:
        """Take the states (steps, agents, width) of both runs, from step ``begin`` on."""
        has_a, has_b = _there(a), _there(b)
        self.only_a += int((has_a & ~has_b).sum())
        self.only_b += int((has_b & ~has_a).sum())
        both = has_a & has_b
        bits = (np.ascontiguousarray(a).view(np.int64) != np.ascontiguousarray(b).view(np.int64)).any(axis=2)
        differs: BoolArray = both & bits
        whole = np.flatnonzero(both.all(axis=1))
        if len(whole):
            end = int(whole[-1])
            self.last = {"step": begin + end, "difference": float(np.abs(a[end] - b[end]).max(initial=0.0))}
        if not differs.any():
            return
        self.states += int(differs.sum())
        self.steps += int(differs.any(axis=1).sum())
        sizes = np.where(differs[:, :, None], np.abs(a - b), -1.0)
        if self.first is None:
            step = int(np.argmax(differs.any(axis=1)))
            self.first = {
                "step": begin + step,
                "time": (begin + step) * self.step_length,
                "agents": (np.flatnonzero(differs[step]) + 1).tolist(),
                "difference": float(sizes[step].max()),
            }
        size = float(sizes.max())
        if self.largest is None or size > self.largest["difference"]:
            place = [int(index) for index in np.unravel_index(int(np.argmax(sizes)), sizes.shape)]
            self.largest = {"step": begin + place[0], "agent": place[1] + 1, "number": place[2] + 1, "difference": size}


def _there(states: FloatArray) -> BoolArray:
    """(steps, agents) which states are not missing."""
    return np.asarray(~np.isnan(states).any(axis=2))
