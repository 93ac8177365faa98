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

"""What happened when: processes killed and back, steps that were late, messages refused, states missing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import pieces
from msg_analysis.common.text.agent_names import agent_text
from msg_analysis.common.text.number_words import counted
from msg_analysis.model.arithmetic.step_clock import StepClock
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.model.step.phases import phases
from msg_analysis.types import BoolArray

KINDS = ("killed", "back", "late", "refused", "missing")
MOST_EVENTS = 400  # of a kind, the longest; others are counted
_NEAR = 5  # steps between two late ones of an agent that are told together


@dataclass(frozen=True, slots=True)
class Event:
    """One event, from step to step (both included)."""

    kind: str  # one of KINDS
    first: int
    last: int
    words: str


def run_events(trajectory: Trajectory, reported: Sequence[Mapping[str, Any]] = ()) -> tuple[list[Event], int]:
    """The events in order of time, and how many more there are; ``reported``: by the network."""
    events = [
        Event(str(one["kind"]), int(one["step"]), int(one["step"]), str(one["words"]))
        for one in reported
        if one["kind"] in KINDS
    ]
    names = trajectory.record.experiment.names
    late = [
        Event(
            "late", first, last, f"{agent_text(agent, names)}: late by more than a period in {counted(number, 'step')}"
        )
        for agent, first, last, number in _stretches(_late(trajectory), _NEAR)
    ]
    missing = [
        Event("missing", first, last, f"{agent_text(agent, names)}: {counted(number, 'state')} missing")
        for agent, first, last, number in _stretches(_missing(trajectory), 1)
    ]
    kept, more = [], 0
    for kind in (events, late, missing):
        longest = sorted(kind, key=lambda event: event.first - event.last)[:MOST_EVENTS]
        kept += longest
        more += len(kind) - len(longest)
    return sorted(kept, key=lambda event: (event.first, KINDS.index(event.kind))), more


def _late(trajectory: Trajectory) -> Iterable[tuple[int, BoolArray]]:
    """Pieces (first step, (steps, m)): which states were made more than a period after they were due."""
    if trajectory.made is None:
        return
    experiment, made = trajectory.record.experiment, trajectory.made
    clocks = [StepClock(experiment.step_length, phase) for phase in phases(experiment).tolist()]
    for piece in pieces(made):
        first, last = max(piece.start, 1), min(piece.stop, len(made))
        due = np.stack([clock.times(np.arange(first - 1, last - 1)) for clock in clocks], axis=1)
        yield first, made[first:last] - due > experiment.step_length * 1e9


def _missing(trajectory: Trajectory) -> Iterable[tuple[int, BoolArray]]:
    """Pieces (first step, (steps, m)): which states are missing."""
    if not trajectory.completeness.missing:
        return
    for states in (trajectory.states, trajectory.published):
        if states is not None:
            for piece in pieces(states):
                yield piece.start, np.asarray(np.isnan(states[piece]).any(axis=2))


def _stretches(found: Iterable[tuple[int, BoolArray]], near: int) -> list[tuple[int, int, int, int]]:
    """(agent from 1, first step, last step, number of steps) of those that are at most ``near`` steps apart."""
    stretches: list[tuple[int, int, int, int]] = []
    open_ones: dict[int, tuple[int, int, int]] = {}  # by agent
    for start, piece in found:
        for step, agent in np.argwhere(piece).tolist():
            at, (first, last, number) = start + step, open_ones.get(agent, (-1, -1, 0))
            if number and 0 <= at - last <= near:
                open_ones[agent] = first, at, number + (at > last)
            else:
                if number:
                    stretches.append((agent + 1, first, last, number))
                open_ones[agent] = at, at, 1
    stretches += [(agent + 1, *stretch) for agent, stretch in open_ones.items()]
    return stretches
