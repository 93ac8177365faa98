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

"""The outcome of a run: the states of all agents and the graph of every step, from a bag or from the twin."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from msg_analysis.common.large_arrays import pieces, release
from msg_analysis.common.text.markdown import markdown_table
from msg_analysis.model.run.record import RunRecord
from msg_analysis.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Completeness:
    """How much of a run is there, counted in states x_i(k): m (N + 1) are expected of a run of N steps.

    Where agents publish something else than their state, every state is expected twice: as it is, and as published.

    Attributes
    ----------
    expected, received, missing
        states; received counts each (agent, step) once, and none whose copies contradict each other
    duplicates
        further copies of states
    out_of_order
        states that came after a later one of the same agent
    missing_modes
        steps whose graph is not known
    refused
        number of messages that were not used, by reason
    """

    expected: int
    received: int
    missing: int
    duplicates: int = 0
    out_of_order: int = 0
    missing_modes: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    def _repr_markdown_(self) -> str:
        keys = ("expected", "received", "missing", "duplicates", "out_of_order", "missing_modes")
        rows = [(key.replace("_", " "), str(getattr(self, key))) for key in keys]
        rows += [(f"refused: {reason}", str(count)) for reason, count in self.refused.items()]
        return markdown_table(("states", "number"), rows)

    @property
    def complete(self) -> bool:
        """Whether no state and no graph is missing."""
        return self.missing == 0 and self.missing_modes == 0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """One run, ordered by step.

    Attributes
    ----------
    record
        what the run was started from
    states
        (N + 1, m, width); NaN where a state is missing. The width is the number of replicas R, or S R for a protocol
        whose state has S numbers; the first R are the agents' values
    modes
        (N,) index from 0 of the graph used in the step k -> k+1; -1 where not known
    completeness
        how many states are there and how many are missing
    agent_modes
        (N + 1, m) index from 0 of the graph that each agent says it used in the step to this state; -1 at step 0 and
        where missing. None where it was not logged
    published
        (N + 1, m, replicas) what the agents published of their states, NaN where missing; None where that is the states
        themselves
    lost
        (N, m, D) in lockstep: whether agent i did not get the newest message of its d-th neighbour, ascending, under
        the graph of the step k -> k+1 (see ``StepModel.neighbours``), that is the one with x_j(max(0, k - delay));
        False where the state is missing. D is the largest number of neighbours. None where messages cannot be lost
    used
        (N, m, D) step of the value of the d-th neighbour, ascending, that was used for x_i(k+1), under the graph
        ``agent_modes[k + 1, i]``; -1 where the agent's own value took its place because the message was lost or nothing
        had been heard, where the state is missing, and beyond the last neighbour. None in lockstep without delay and
        without ``on_loss: hold``, where it is k unless the message was lost
    made
        (N + 1, m) in real time: simulated time [ns] at which the state was made, later than that of every value used
        for it; 0 for x(0), -1 where missing. None in lockstep
    """

    record: RunRecord
    states: FloatArray
    modes: IntArray
    completeness: Completeness
    agent_modes: IntArray | None = None
    published: FloatArray | None = None
    lost: BoolArray | None = None
    used: IntArray | None = None
    made: IntArray | None = None

    def __repr__(self) -> str:
        experiment, count = self.record.experiment, self.completeness
        whole = "complete" if count.complete else f"{count.missing} of {count.expected} states missing"
        last = len(self.states) - 1
        states = f"x(0..{last}) of {experiment.agents} agents" if last >= 0 else "no states kept"
        replicas = f"{experiment.run.replicas} replicas, seed {experiment.run.seed}"
        return f"<{type(self).__name__} of {experiment.name!r}: {states}, {replicas}; {whole}>"

    def release(self) -> None:
        """Give the memory of a long run, whose arrays are in files, back to the system: after every part of it."""
        for array in (self.states, self.published, self.lost, self.used, self.made, self.agent_modes):
            if array is not None:
                release(array)

    @property
    def values(self) -> FloatArray:
        """(N + 1, m, replicas): the agents' values; they are the whole state unless a protocol has more numbers."""
        return self.states[:, :, : self.record.experiment.run.replicas]

    @property
    def present(self) -> BoolArray:
        """(N + 1, m): which states are there; what was published of them, too, where that is something else."""
        there = np.ones(self.states.shape[:2], dtype=np.bool_)
        for states in (self.states,) if self.published is None else (self.states, self.published):
            for piece in pieces(states):
                there[piece] &= ~np.isnan(states[piece]).any(axis=2)
        return there

    @property
    def prefix(self) -> int:
        """Steps in the longest complete beginning: x(0..prefix) and g(0..prefix-1) are there; -1 if x(0) is not."""
        whole = np.asarray(self.present.all(axis=1))
        states = int(np.argmin(whole)) if not whole.all() else len(whole)
        known = self.modes >= 0
        modes = int(np.argmin(known)) if not known.all() else len(known)
        return min(states - 1, modes)

    @property
    def stretch(self) -> tuple[int, int] | None:
        """First and last step of the longest stretch in which no state is missing; None where no step is complete."""
        whole = np.concatenate(([0], self.present.all(axis=1), [0])).astype(np.int64)
        first, behind = np.flatnonzero(np.diff(whole) == 1), np.flatnonzero(np.diff(whole) == -1)
        if not len(first):
            return None
        longest = int(np.argmax(behind - first))
        return int(first[longest]), int(behind[longest]) - 1
