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

"""The neighbours of every agent in every graph, as tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """The neighbours of every agent in every graph, padded."""

    senders: IntArray  # (n, m, D) the d-th neighbour, ascending; the agent itself beyond their number
    count: IntArray  # (n, m) their number


@lru_cache(maxsize=4)
def neighbour_tables(wiring: Wiring) -> Neighbours:
    """Tables of the neighbours, in the order of the log."""
    n, m = wiring.modes, wiring.agents
    senders = np.tile(np.arange(m)[:, None], (n, 1, wiring.most_neighbours))
    count = np.zeros((n, m), dtype=np.int64)
    for mode in range(n):
        for i in range(m):
            neighbours = wiring.neighbours(mode, i)
            count[mode, i] = len(neighbours)
            senders[mode, i, : len(neighbours)] = neighbours
    return Neighbours(senders, count)
