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

"""Quantiles of more numbers than are kept: exact, in a few passes over pieces of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from msg_analysis.types import AnyArray, FloatArray, IntArray

AT_ONCE = 2**21  # numbers that are sorted together
BINS = 2**14

Pieces = Callable[[], Iterable[AnyArray]]
"""Gives the numbers from the beginning, in pieces of any size; the same ones each time."""


def extent(pieces: Pieces) -> tuple[int, float, float]:
    """How many numbers there are, the smallest one and the largest one (infinite where there are none)."""
    count, low, high = 0, np.inf, -np.inf
    for piece in pieces():
        if piece.size:
            count, low, high = count + piece.size, min(low, float(piece.min())), max(high, float(piece.max()))
    return count, low, high


def quantiles(pieces: Pieces, shares: Sequence[float]) -> list[float]:
    """Quantiles of all numbers, between neighbours linearly: as ``numpy.quantile``; empty where there are none."""
    count, low, high = extent(pieces)
    if not count:
        return []
    place = np.array(shares) * (count - 1)
    below = np.floor(place).astype(np.int64)
    ranks = np.unique(np.concatenate([below, np.minimum(below + 1, count - 1)]))
    found = dict(zip(ranks.tolist(), _of_ranks(pieces, ranks, count, low, high).tolist(), strict=True))
    values = []
    for rank, part in zip(below.tolist(), (place - below).tolist(), strict=True):
        one, next_one = found[rank], found[min(rank + 1, count - 1)]
        values.append(one + (next_one - one) * part if part < 0.5 else next_one - (next_one - one) * (1.0 - part))
    return values


def _of_ranks(pieces: Pieces, ranks: IntArray, count: int, low: float, high: float) -> FloatArray:
    """The numbers with these ranks, from 0, of ``count`` numbers from ``low`` to ``high``."""
    if low == high:
        return np.full(len(ranks), low)
    if count <= AT_ONCE:
        return np.sort(np.concatenate([np.ravel(piece) for piece in pieces()]).astype(np.float64))[ranks]

    def bins(piece: AnyArray) -> IntArray:
        return np.minimum((np.ravel(piece) - low) * (BINS / (high - low)), BINS - 1).astype(np.int64)

    counts = sum((np.bincount(bins(piece), minlength=BINS) for piece in pieces()), np.zeros(BINS, np.int64))
    ends = np.cumsum(counts)
    chosen = np.searchsorted(ends, ranks, side="right")
    found = np.empty(len(ranks))
    for one in np.unique(chosen).tolist():

        def inside(one: int = one) -> Iterable[AnyArray]:
            return (np.ravel(piece)[bins(piece) == one] for piece in pieces())

        wanted = chosen == one
        found[wanted] = _of_ranks(inside, ranks[wanted] - (ends[one] - counts[one]), *extent(inside))
    return found
