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

"""Windows of 1, 2, 4, 8, ... steps over a run, each half overlapping the next one; and evidence mixed over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.inference.statistics.mixture_evidence import log_sum
from msg_analysis.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class EndedWindows:
    """Windows that ended in some steps, ordered by their length."""

    levels: IntArray  # (L,) lengths 2^level that there are, ascending
    begins: IntArray  # (L,) row of the first window of each length
    counts: IntArray  # (L,) windows of each length
    first: IntArray  # (w,) first steps, from 0
    sums: FloatArray  # (w, K)

    @property
    def level(self) -> IntArray:
        """(w,) of each window."""
        return np.repeat(self.levels, self.counts)


class Windows:
    """Sums over windows of a run of ``planned`` steps, as these go by: memory for one window of each length.

    Windows of 2^l steps begin at every multiple of 2^(l-1) steps.
    """

    def __init__(self, planned: int, columns: int) -> None:
        self.levels = max(planned, 1).bit_length()
        steps = np.arange(self.levels)
        # (levels,) windows of each length in the run
        self.planned: IntArray = np.where(steps > 0, (planned >> np.maximum(steps - 1, 0)) - 1, planned).clip(1)
        self.steps = 0  # seen
        self._last = [np.empty((0, columns)) for _ in range(self.levels)]
        self._cells = [0] * self.levels  # of 2^l steps, that were seen

    def add(self, numbers: FloatArray) -> EndedWindows:
        """The windows that end in steps with ``numbers`` (b, K)."""
        first, sums = [self.steps + np.arange(len(numbers))], [numbers]
        self.steps += len(numbers)
        cells = numbers
        for level in range(1, self.levels):
            half = level - 1
            joined = np.concatenate([self._last[half], cells])
            number = self._cells[half] - len(self._last[half]) + np.arange(max(len(joined) - 1, 0))
            self._cells[half] += len(cells)
            self._last[half] = joined[-1:]
            if not len(number):
                break
            first.append(number << half)
            sums.append(joined[:-1] + joined[1:])
            cells = sums[level][number % 2 == 0]
        counts = np.array([len(each) for each in sums])
        levels = np.flatnonzero(counts)
        begins = (np.cumsum(counts) - counts)[levels]
        return EndedWindows(levels, begins, counts[levels], np.concatenate(first), np.concatenate(sums))

    def seen(self) -> IntArray:
        """(levels,) windows that have ended."""
        return np.array([self.steps, *(max(count - 1, 0) for count in self._cells[:-1])])

    def begun(self) -> IntArray:
        """(levels,) windows that have begun, or ended."""
        half = 1 << np.maximum(np.arange(self.levels) - 1, 0)
        return np.asarray(np.minimum(-(-self.steps // half), self.planned))


class WindowEvidence:
    """The mean of evidence over all windows of a run, lengths with equal weight; runs are multiplied.

    A window counts 1 before it begins, 0 while it goes on and its evidence when it has ended: never more than the
    martingale of which it is the end.
    """

    def __init__(self, windows: Windows, columns: int) -> None:
        self._windows = windows
        self._ended, self._others = np.full(columns, -np.inf), np.zeros(columns)

    def add(self, levels: IntArray, logarithms: FloatArray) -> None:
        """Evidence (w, K) of windows that ended, of 2^levels (w,) steps."""
        if len(logarithms):
            shares = np.log(self._windows.planned[levels] * float(self._windows.levels))
            self._ended = np.logaddexp(self._ended, log_sum(logarithms - shares[:, None], 0))

    def merge(self, other: WindowEvidence) -> None:
        """With that of other runs."""
        self._others = self._others + other.logarithms()

    def logarithms(self) -> FloatArray:
        """(K,) of the evidence so far."""
        rest = float((1.0 - self._windows.begun() / self._windows.planned).mean())
        with np.errstate(divide="ignore"):
            return np.asarray(self._others + np.logaddexp(self._ended, np.log(rest)))
