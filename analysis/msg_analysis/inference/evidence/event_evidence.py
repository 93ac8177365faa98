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

"""Evidence mixed over all events of a run, any of which may be the one that departs."""

from __future__ import annotations

import math

import numpy as np

from msg_analysis.types import FloatArray, IntArray


class EventEvidence:
    """The mean of evidence over the ``planned`` events of a run, those to come with 1; runs are multiplied.

    Half of the whole always counts 1: so events whose evidence is 0, as nearly all have, do not wear it out.
    """

    def __init__(self, planned: int) -> None:
        self.planned = planned
        self._seen, self._ended, self._others = 0, -np.inf, 0.0

    def add(self, seen: IntArray, logarithms: FloatArray, looks: IntArray) -> FloatArray:
        """The evidence after each of T looks, (T,).

        ``seen`` (T,): events between each look and the one before it; ``logarithms`` (e,): evidence of those of them
        where it is not 0, and the ``looks`` (e,) that come next.
        """
        ended = np.full(len(seen), -np.inf)
        np.logaddexp.at(ended, looks, logarithms - math.log(self.planned))
        ended = np.logaddexp.accumulate(np.append(self._ended, ended))[1:]
        number = self._seen + np.cumsum(seen)
        self._seen, self._ended = int(number[-1]), float(ended[-1])
        return self._after(number, ended)

    def merge(self, other: EventEvidence) -> None:
        """With that of other runs."""
        self._others += other.logarithm()

    def logarithm(self) -> float:
        """Of the evidence so far."""
        return float(self._after(np.array(self._seen), np.array(self._ended)))

    def _after(self, seen: IntArray, ended: FloatArray) -> FloatArray:
        """Of so many events, and the log of the sum over them."""
        rest = np.maximum(0.0, 1.0 - seen / self.planned)
        with np.errstate(divide="ignore"):
            mean = np.logaddexp(ended, np.log(rest))
        return np.asarray(self._others + np.logaddexp(0.0, mean) - math.log(2.0))
