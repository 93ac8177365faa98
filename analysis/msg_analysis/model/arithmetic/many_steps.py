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

"""Many steps of a whole network: the sums of the single agents, to the last bit, by the kernel or by numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msg_analysis.model.arithmetic.update_law import step
from msg_analysis.types import BoolArray, FloatArray, IntArray

try:
    from msg_analysis.model.arithmetic import _kernel
except ImportError:  # there was no compiler when this was installed
    COMPILED = False
else:
    COMPILED = True


@dataclass(frozen=True, slots=True)
class Round:
    """Agents that can step at once, under one graph, because none uses what another of them makes."""

    agents: IntArray  # (a,) from 0
    rows: IntArray  # (d, a) the d-th value that each of them uses, a row of [x(k); x(k+1)]; the order of the sum
    there: BoolArray  # (d, a) whether it is no padding
    weights: FloatArray  # (d, a), 0 for padding, which changes no sum


@dataclass(frozen=True, slots=True)
class Reception:
    """What becomes of the values that agents send each other in K steps or more, over L links."""

    links: IntArray  # (m, m) number of the link from the sender, the column; L for an agent's own value
    own: BoolArray  # (L + 1, K) whether the receiver uses its own value, since the message is lost; last row: True
    broadcast: FloatArray | None  # (m, K, R) noise that is added to what each agent publishes
    link: FloatArray | None  # (L + 1, K, R) noise that is added on each link

    def heard(self, k: int, state: FloatArray, agents: IntArray, rows: IntArray) -> list[FloatArray]:
        """For each d, (a, R): what the agents use for their d-th value of x(k) (m, R)."""
        numbers = self.links[agents, rows]
        values = (state if self.broadcast is None else state + self.broadcast[:, k])[rows]
        if self.link is not None:
            values = values + self.link[numbers, k]
        return list(np.where(self.own[numbers, k, None], state[agents], values))


class ManySteps:
    """The steps of m agents, under each graph in one or several rounds."""

    def __init__(self, rounds: Sequence[Sequence[Round]]) -> None:
        """``rounds[mode]`` are the rounds of a graph, in order; each agent is in one of them."""
        self._rounds = rounds
        self._agents = sum(len(one.agents) for one in rounds[0])
        together = [one for of_graph in rounds for one in of_graph]
        terms = np.concatenate([one.there.sum(axis=0) for one in together])
        # Row after row: the agent that it is for, where its terms begin, and its terms.
        self._order = np.concatenate([one.agents for one in together], dtype=np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(terms)], dtype=np.int64)
        self._columns = np.concatenate([one.rows.T[one.there.T] for one in together], dtype=np.int64)
        self._weights = np.concatenate([one.weights.T[one.there.T] for one in together])

    def advance(
        self, modes: IntArray, start: FloatArray, drives: FloatArray, reception: Reception | None = None
    ) -> FloatArray:
        """(K, m, R): x(1) to x(K) from x(0) = ``start``, under the graphs ``modes`` (K,).

        ``drives`` (K, m, R) has the noise of each step and what the reference adds. With a ``reception``, all agents
        are in one round.
        """
        if not COMPILED:
            return self._with_numpy(modes, start, drives, reception)
        states = np.empty((len(modes) + 1, *start.shape))
        states[0] = start
        arrays = self._order, self._offsets, self._columns, self._weights, np.ascontiguousarray(modes)
        air: list[IntArray | BoolArray | FloatArray | bytes] = []
        if reception is not None:
            air = [reception.links, reception.own]
            air += [b"" if noise is None else noise for noise in (reception.broadcast, reception.link)]
        _kernel.advance(*arrays, np.ascontiguousarray(drives), states, *start.shape, *air)
        return states[1:]

    def _with_numpy(
        self, modes: IntArray, start: FloatArray, drives: FloatArray, reception: Reception | None
    ) -> FloatArray:
        m = self._agents
        states = np.empty((len(modes), *start.shape))
        both = np.concatenate([start, start])  # x(k) above x(k+1)
        sums = [[(one.agents, list(one.weights[:, :, None]), one.rows) for one in each] for each in self._rounds]
        for k, mode in enumerate(modes):
            both[:m] = both[m:]
            for agents, weights, rows in sums[mode]:
                values = list(both[rows]) if reception is None else reception.heard(k, both[:m], agents, rows)
                both[m + agents] = step(weights, values, drives[k, agents])
            states[k] = both[m:]
        return states
