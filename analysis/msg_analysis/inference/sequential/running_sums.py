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

"""Sums over the steps of runs, from which the evidence on every question follows, after each of some looks."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from msg_analysis.types import FloatArray, IntArray


@dataclass(slots=True, eq=False)
class RunningSums:
    """Sums over the steps before each of T looks, for m agents, n graphs and L rates of the system error."""

    impossible: IntArray  # (T,) steps in which an agent without noise moved
    samples: IntArray  # (T, m) innovations
    squares: FloatArray  # (T, m) of innovations over their standard deviations
    link_score: FloatArray  # (T, m, m) receiver, sender
    link_information: FloatArray  # (T, m, m)
    pair_score: FloatArray  # (T, m, m)
    pair_information: FloatArray  # (T, m, m)
    common_score: FloatArray  # (T,) of all gains at once
    common_information: FloatArray  # (T,)
    counts: IntArray  # (T, n, n) of steps from graph to graph
    messages: IntArray  # (T, m, m) of links that lose some
    lost: IntArray  # (T, m, m)
    broadcast_samples: IntArray  # (T,) of each agent
    broadcast_squares: FloatArray  # (T, m)
    error: FloatArray  # (T, L) logarithms of the martingales of the system error

    @classmethod
    def zeros(cls, looks: int, agents: int, graphs: int, rates: int) -> RunningSums:
        """Of no step."""

        def whole(*shape: int) -> IntArray:
            return np.zeros((looks, *shape), np.int64)

        def real(*shape: int) -> FloatArray:
            return np.zeros((looks, *shape))

        m, n = agents, graphs
        return cls(
            impossible=whole(),
            samples=whole(m),
            squares=real(m),
            link_score=real(m, m),
            link_information=real(m, m),
            pair_score=real(m, m),
            pair_information=real(m, m),
            common_score=real(),
            common_information=real(),
            counts=whole(n, n),
            messages=whole(m, m),
            lost=whole(m, m),
            broadcast_samples=whole(),
            broadcast_squares=real(m),
            error=real(rates),
        )

    def then(self, parts: RunningSums) -> RunningSums:
        """After each look, from the last sums of these and those between the looks."""
        added = {each.name: getattr(parts, each.name).cumsum(axis=0) for each in fields(self)}
        return RunningSums(**{name: getattr(self, name)[-1] + values for name, values in added.items()})

    def last(self) -> RunningSums:
        """After the last look only."""
        return RunningSums(**{each.name: getattr(self, each.name)[-1:].copy() for each in fields(self)})

    def merge(self, other: RunningSums) -> None:
        """Add the sums of another run, looked at as often."""
        for each in fields(self):
            getattr(self, each.name).__iadd__(getattr(other, each.name))
