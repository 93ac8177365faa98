# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""When steps are due in simulated time, in whole nanoseconds: computed here only.

Stamps, timers, the twin and the analysis use this, so they agree to the nanosecond however long the run is.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from msg_analysis.common.arrays import IntArray

SECOND = 1_000_000_000  # ns
_LARGEST = 2**63 - 1


class StepClock:
    """Simulated time of the steps in whole nanoseconds, without rounding drift.

    Step k is due at (k + phase) dt, phase in [0, 1): k dt to the nearest nanosecond (half up), plus phase dt rounded
    once. ``dt``, in units of simulated time written as seconds, counts as its decimal text: 0.1 is one tenth.
    """

    def __init__(self, dt: float, phase: float = 0.0) -> None:
        step = Fraction(repr(float(dt))) * SECOND
        self._numerator, self._denominator = step.numerator, step.denominator
        self.step_ns = float(step)  # dt [ns]
        self._shift = round(float(phase) * self.step_ns)

    def nanoseconds(self, step: int) -> int:
        """Time of a step [ns]."""
        if self._denominator == 1:
            return step * self._numerator + self._shift
        return (2 * step * self._numerator + self._denominator) // (2 * self._denominator) + self._shift

    def times(self, steps: IntArray) -> IntArray:
        """Times of steps of any shape [ns], in the same shape; equal to ``nanoseconds`` of each."""
        whole, rest = divmod(self._numerator, self._denominator)
        if 2 * int(np.max(steps, initial=0)) * rest + self._denominator > _LARGEST:  # a dt of very many digits
            flat = [self.nanoseconds(step) for step in np.ravel(steps).tolist()]
            return np.array(flat, dtype=np.int64).reshape(np.shape(steps))
        parts = (2 * steps * rest + self._denominator) // (2 * self._denominator)
        return np.asarray(steps * whole + parts + self._shift, dtype=np.int64)
