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

"""The numbers of steps after which sums over a block of steps are looked at, in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Looks at a block of b steps."""

    ends: IntArray  # (T,) numbers of steps before each look, from 1, ascending; the last is b

    @classmethod
    def at_the_end(cls, steps: int) -> Looks:
        """Only one, after so many steps."""
        return cls(np.array([steps]))

    @property
    def count(self) -> int:
        """T."""
        return len(self.ends)

    @property
    def begins(self) -> IntArray:
        """(T,): first step between each look and the one before it."""
        begins = np.zeros_like(self.ends)
        begins[1:] = self.ends[:-1]
        return begins

    @property
    def lengths(self) -> IntArray:
        """(T,): steps between each look and the one before it."""
        return self.ends - self.begins

    def after(self, steps: IntArray) -> IntArray:
        """The look that comes next after each of these steps, from 0."""
        return np.searchsorted(self.ends, steps, side="right")

    def sums(self, values: FloatArray) -> FloatArray:
        """(T, ...): sums of values (b, ...) over the steps between each look and the one before it."""
        return np.asarray(np.add.reduceat(values, self.begins, axis=0))

    def counts(self, values: IntArray | BoolArray) -> IntArray:
        """(T, ...): the same of whole numbers, or of how many are true."""
        return np.asarray(np.add.reduceat(np.asarray(values, dtype=np.int64), self.begins, axis=0))
