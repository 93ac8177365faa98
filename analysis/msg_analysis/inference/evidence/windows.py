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

from msg_analysis.inference.evidence.looks import Looks
from msg_analysis.inference.evidence.mixture_evidence import log_sums
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

    def begun(self, steps: IntArray) -> IntArray:
        """(..., levels): windows that have begun, or ended, after so many steps (...)."""
        half = 1 << np.maximum(np.arange(self.levels) - 1, 0)
        return np.asarray(np.minimum(-(-steps[..., None] // half), self.planned))


class WindowEvidence:
    """The mean of evidence over all windows of a run, lengths with equal weight; runs are multiplied.

    A window counts 1 before it begins, 0 while it goes on and its evidence when it has ended: never more than the
    martingale of which it is the end.
    """

    def __init__(self, windows: Windows, columns: int) -> None:
        self._windows = windows
        self._ended, self._others = np.full(columns, -np.inf), np.zeros(columns)

    def add(self, ended: EndedWindows, logarithms: FloatArray, looks: Looks) -> FloatArray:
        """Evidence (w, K) of windows that ended in the newest steps, a block with these looks: (T, K) after each."""
        levels, begun = ended.level, self._windows.steps - int(looks.ends[-1])
        look = looks.after(ended.first + (1 << levels) - 1 - begun)
        order = np.argsort(look, kind="stable")
        shares = np.log(self._windows.planned[levels] * float(self._windows.levels))
        begins = np.searchsorted(look[order], np.arange(looks.count))  # a window of one step ends in every step
        each = log_sums((logarithms - shares[:, None])[order], begins)
        total = np.logaddexp.accumulate(np.vstack([self._ended, each]), axis=0)[1:]
        self._ended = total[-1]
        return self._after(begun + looks.ends, total)

    def merge(self, other: WindowEvidence) -> None:
        """With that of other runs."""
        self._others = self._others + other.logarithms()

    def logarithms(self) -> FloatArray:
        """(K,) of the evidence so far."""
        return self._after(np.array(self._windows.steps), self._ended)

    def _after(self, steps: IntArray, ended: FloatArray) -> FloatArray:
        """(..., K): after so many steps (...), from the logs (..., K) of the sum over the windows that ended."""
        rest = (1.0 - self._windows.begun(steps) / self._windows.planned).mean(axis=-1)
        with np.errstate(divide="ignore"):
            return np.asarray(self._others + np.logaddexp(ended, np.log(rest)[..., None]))
