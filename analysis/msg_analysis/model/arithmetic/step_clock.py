"""When steps are due in simulated time, in whole nanoseconds: the one place where that is computed.

Stamps, timers, the twin and the analysis all go by it, so they agree to the nanosecond however late in the run.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from msg_analysis.types import IntArray

SECOND = 1_000_000_000  # ns
_LARGEST = 2**63 - 1


class StepClock:
    """Simulated time of the steps in whole nanoseconds, free of rounding drift.

    Step k is due at (k + phase) dt: k dt rounded to the nearest nanosecond (a half goes up), and as many more, for all
    steps alike, as phase dt rounds to.

    Parameters
    ----------
    dt
        length of a step [units of simulated time, written as seconds]; its decimal text counts: 0.1 is one tenth
    phase
        part of a step, in [0, 1)

    Attributes
    ----------
    step_ns
        dt [ns], as near as a float comes
    """

    def __init__(self, dt: float, phase: float = 0.0) -> None:
        step = Fraction(repr(float(dt))) * SECOND
        self._numerator, self._denominator = step.numerator, step.denominator
        self.step_ns = float(step)
        self._shift = round(float(phase) * self.step_ns)

    def nanoseconds(self, step: int) -> int:
        """Time of step k [ns].

        Parameters
        ----------
        step
            k
        """
        if self._denominator == 1:
            return step * self._numerator + self._shift
        return (2 * step * self._numerator + self._denominator) // (2 * self._denominator) + self._shift

    def times(self, steps: IntArray) -> IntArray:
        """Times of many steps [ns], in the same shape; the same as one by one.

        Parameters
        ----------
        steps
            of any shape: k
        """
        whole, rest = divmod(self._numerator, self._denominator)
        if 2 * int(np.max(steps, initial=0)) * rest + self._denominator > _LARGEST:  # a dt of very many digits
            flat = [self.nanoseconds(step) for step in np.ravel(steps).tolist()]
            return np.array(flat, dtype=np.int64).reshape(np.shape(steps))
        parts = (2 * steps * rest + self._denominator) // (2 * self._denominator)
        return np.asarray(steps * whole + parts + self._shift, dtype=np.int64)
