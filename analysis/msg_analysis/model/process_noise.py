# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Process noise of the agents, block after block of steps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, Stream, normals
from msg_analysis.arithmetic.update_law import weighted_sum
from msg_analysis.common.arrays import FloatArray


class ProcessNoise:
    """The process noise of any agent at any step: row i of B_g v(k), with B_g (n, m, m) = ``noise_gain``.

    Correlated noise needs no communication: an agent draws the sources v_j that its rows use by itself. ``kept``: all
    that was drawn stays in memory, for another pass over the same steps.
    """

    def __init__(self, seed: int, noise_gain: FloatArray, replicas: int, *, kept: bool = False) -> None:
        self.replicas = replicas
        agents = noise_gain.shape[1]
        sources = int(np.count_nonzero(noise_gain.any(axis=0), axis=1).max(initial=1))

        # An agent asks for its own row only, the twin for every row of a block: keep one block of every source.
        @lru_cache(maxsize=None if kept else agents if sources > 1 else 1)
        def source(agent: int, block: int, steps: int) -> FloatArray:
            return normals(seed, Stream.PROCESS, agent, block, (steps, replicas))

        self._source = source
        self._rows = lru_cache(maxsize=None)(lambda agent: _different_rows(noise_gain[:, agent]))

    def block(self, agent: int, block: int, steps: int = STEPS_PER_BLOCK) -> list[FloatArray]:
        """For each mode, the noise of one agent (from 0) in the first steps of a block, (steps, replicas).

        Modes with the same noise share one array.
        """
        rows, of_mode = self._rows(agent)
        drawn = [
            weighted_sum(weights, [self._source(j, block, steps) for j in used])
            if used
            else np.zeros((steps, self.replicas))
            for used, weights in rows
        ]
        return [drawn[row] for row in of_mode]


def _different_rows(rows: FloatArray) -> tuple[list[tuple[list[int], list[float]]], list[int]]:
    """Sources (from 0) and weights of each different one of an agent's rows (n, m), and for each mode which it is."""
    keys = [row.tobytes() for row in rows]
    different = dict(zip(keys, rows, strict=True))
    places = list(different)
    used = [(np.flatnonzero(row).tolist(), row[row != 0.0].tolist()) for row in different.values()]
    return used, [places.index(key) for key in keys]
