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

"""The states of a running network with all that their messages log: which values went into each, and its graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from msg_analysis.bags.state_columns import own_layout
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.logged_inputs import LoggedInputs
from msg_analysis.types import AnyArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStates:
    """Whole steps, in any order: what led to x(k) is that of the step k-1 -> k, with graphs from 0; -1 at step 0."""

    steps: IntArray  # (b,) k
    states: FloatArray  # (b, m, R) x(k)
    published: FloatArray | None  # (b, m, R) what was published of x(k); None: x(k)
    graphs: IntArray  # (b, m) that the agents used
    used: IntArray  # (b, m, D) as in ``Trajectory``

    def __getitem__(self, chosen: AnyArray | slice) -> LoggedStates:
        published = None if self.published is None else self.published[chosen]
        return LoggedStates(self.steps[chosen], self.states[chosen], published, self.graphs[chosen], self.used[chosen])


class StateLog:
    """Reads the messages of a run; ``impossible`` counts the states with an impossible graph or ``heard``."""

    def __init__(self, record: RunRecord) -> None:
        experiment = record.experiment
        self._inputs = LoggedInputs(record.model, experiment)
        self._agents, self._replicas, self._width = experiment.agents, experiment.run.replicas, experiment.width
        self._graphs = len(experiment.graph_list)
        self.truth = experiment.truth  # whether what is published is something else than the state
        self.impossible = 0

    def read(self, steps: IntArray, data: bytes, start: IntArray, size: IntArray, published: bytes) -> LoggedStates:
        """Steps (b,), whose messages (b * m,), agent by agent, are in ``data``; without impossible ones.

        ``published``: what was published of the states, in the same order; empty where that is the states.
        """
        b, m = len(steps), self._agents
        found, own = own_layout(data, start, size, np.arange(len(start)))
        assert own.all(), "checked when they came"
        step, agent, mode = np.repeat(steps, m), np.tile(np.arange(m), b), np.minimum(found.mode, self._graphs + 1)
        possible = (mode <= self._graphs) & ((mode == 0) == (step == 0))
        known, heard, count = np.where(possible, mode, 0), found.heard(self._inputs.most), found.heard_count
        possible &= self._inputs.fit(step, known, agent, heard, count)
        self.impossible += int((~possible).sum())
        values = None
        if self.truth:
            values = np.frombuffer(published, "<f8").reshape(b, m, self._replicas)
        states = found.state(self._width).reshape(b, m, self._width)[:, :, : self._replicas]
        good = possible.reshape(b, m).all(axis=1) & np.isfinite(states).all(axis=(1, 2))
        if values is not None:
            good &= np.isfinite(values).all(axis=(1, 2))
        used = self._inputs.used(step, known, agent, heard, count)
        every = LoggedStates(steps, states, values, (known - 1).reshape(b, m), used.reshape(b, m, -1))
        return every if good.all() else every[good]

    def of_messages(
        self, steps: Sequence[int], messages: Sequence[Sequence[bytes]], published: Sequence[Sequence[bytes]]
    ) -> LoggedStates:
        """The same of the messages of every step, one of each agent."""
        each = list(chain.from_iterable(messages))
        size = np.array([len(message) for message in each], dtype=np.int64)
        values = b"".join(chain.from_iterable(published))
        return self.read(np.array(steps, dtype=np.int64), b"".join(each), np.cumsum(size) - size, size, values)
