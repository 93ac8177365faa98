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

"""Replicas of a run, thinned to a fixed size: smallest and largest value of each interval of steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS, release
from msg_analysis.types import FloatArray

NUMBERS = 80_000  # values of the agents that are kept, at most about
_LARGEST = 1e30  # of single precision: 3e38


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """Arrays (bins, series) of single precision: lowest and highest value in each bin of ``width`` steps.

    NaN where no value of the bin is known. With a width of 1, lowest and highest are the same array.
    """

    width: int
    values: tuple[FloatArray, FloatArray]  # (bins, m) states of the agents
    deviations: tuple[FloatArray, FloatArray]  # (bins, m) the same without the centre
    centre: tuple[FloatArray, FloatArray]  # (bins, 1) mean of the agents, or the reference
    error: tuple[FloatArray, FloatArray]  # (bins, 1) sum of the squared deviations


def thin(
    states: FloatArray,  # (N + 1, m, replicas), perhaps in a file; NaN where missing
    replica: int,
    reference: float | None,  # None: the mean of the agents
    numbers: int = NUMBERS,
) -> Thinned:
    """Thin one replica; the memory needed does not depend on the length of the run."""
    return thin_together(states, slice(replica, replica + 1), reference, numbers)[0]


def thin_together(
    states: FloatArray,  # as in ``thin``
    replicas: slice,
    reference: float | None,
    numbers: int,  # of each replica, at most about
) -> list[Thinned]:
    """Thin several replicas, each to the same width, while the states are read once."""
    count, agents = states.shape[:2]
    several = len(range(states.shape[2])[replicas])
    width = max(1, math.ceil(2 * count * agents / numbers)) if count * agents > numbers else 1
    bins = math.ceil(count / width)
    low, high = (
        [np.empty((several, bins, agents if key < 2 else 1), np.float32) for key in range(4)] for _ in range(2)
    )
    length = width * max(1, BLOCK_NUMBERS // max(1, width * states[:1].size))  # steps that are looked at together
    for first in range(0, count, length):
        piece = np.clip(states[first : first + length, :, replicas], -_LARGEST, _LARGEST)
        centre = piece.mean(axis=1, keepdims=True) if reference is None else np.full_like(piece[:, :1], reference)
        deviations = piece - centre
        error = np.minimum(np.square(deviations).sum(axis=1, keepdims=True), _LARGEST)
        starts = np.arange(0, len(piece), width)
        place = slice(first // width, first // width + len(starts))
        for key, series in enumerate((piece, deviations, centre, error)):
            low[key][:, place] = np.moveaxis(np.fmin.reduceat(series, starts, axis=0), 2, 0)
            high[key][:, place] = np.moveaxis(np.fmax.reduceat(series, starts, axis=0), 2, 0)
        release(states)
    pairs = [
        [(one, one if width == 1 else other) for one, other in zip(*both, strict=True)]
        for both in zip(low, high, strict=True)
    ]
    return [Thinned(width, *of_replica) for of_replica in zip(*pairs, strict=True)]


def envelope(pair: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """(bins,) lowest and highest value of all series; NaN where none is known."""
    return np.fmin.reduce(pair[0], axis=1), np.fmax.reduce(pair[1], axis=1)
