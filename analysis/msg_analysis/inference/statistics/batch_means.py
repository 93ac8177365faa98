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

"""Batch means: a confidence interval that assumes no model."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from msg_analysis.inference.statistics.distributions import student_quantile
from msg_analysis.types import FloatArray

BATCHES = 20
MOST_RUNNING = 64  # batches of a series that goes on
LEAST_LENGTH = 16  # values in each of them before they count


def batch_interval(series: FloatArray, level: float = 0.95) -> tuple[float, float] | None:
    """95 % (by default) interval for the mean of a correlated stationary series, from 20 batch means and Student's t.

    Its coverage is too low when the graphs switch slowly compared with a batch. It is reported next to the martingale
    interval as a model-free check.

    Parameters
    ----------
    series
        (N,)
    level
        nominal coverage

    Returns
    -------
    tuple[float, float] | None
        (low, high), or None for a series shorter than two values per batch
    """
    length = len(series) // BATCHES
    if length < 2:
        return None
    # The remainder is dropped at the beginning, where the start may still have an effect.
    means = series[len(series) - length * BATCHES :].reshape(BATCHES, length).mean(axis=1)
    half = student_quantile(0.5 + level / 2, BATCHES - 1) * means.std(ddof=1) / np.sqrt(BATCHES)
    return float(means.mean() - half), float(means.mean() + half)


class RunningBatches:
    """Batch means of a series that goes on: ``MOST_RUNNING`` / 2 to ``MOST_RUNNING`` batches, whose length doubles."""

    def __init__(self) -> None:
        self.count = 0
        self._length, self._sums = 1, list[float]()
        self._open, self._left = 0.0, 1  # sum of the batch that is not full, and how many it lacks

    def add(self, values: Iterable[float]) -> None:
        """Take the next values."""
        series = np.fromiter(values, dtype=float)
        self.count += len(series)
        while len(series):
            part, series = series[: self._left], series[self._left :]
            self._open += float(part.sum())
            self._left -= len(part)
            if self._left:
                return
            self._sums.append(self._open)
            if len(self._sums) == MOST_RUNNING:
                pairs = np.array(self._sums).reshape(-1, 2)
                self._sums, self._length = pairs.sum(axis=1).tolist(), 2 * self._length
            self._open, self._left = 0.0, self._length

    def variance(self) -> float | None:
        """Variance of the mean of all values, times the square of their number; None: too few values."""
        if self._length < LEAST_LENGTH:
            return None
        means = np.array(self._sums) / self._length
        return float(means.var(ddof=1)) * self._length * self.count
