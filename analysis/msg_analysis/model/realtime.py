"""Real time: when each agent is due, on a timer of its own."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.model.streams import Stream, generator
from msg_analysis.types import FloatArray, IntArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment import Experiment


def phases(experiment: Experiment) -> FloatArray:
    """(m,) phi in (0, 1): agent i makes its step k -> k+1 when it is due, at simulated time (k + phi_i) dt.

    Timers of equal period that are not synchronised, spread over it in an order drawn from the seed.
    """
    ranks = generator(experiment.run.seed, Stream.PHASE).permutation(experiment.agents)
    return np.asarray((ranks + 0.5) / experiment.agents)


def times_ns(steps: IntArray, dt: float, phase: float = 0.0) -> IntArray:
    """Times (k + phase) dt in ns of simulated time, for whole steps k; exact to the nanosecond however late.

    Parameters
    ----------
    steps : k, any shape
    dt : step length; its decimal text counts, as for the stamps: 0.1 is one tenth
    phase : in [0, 1)
    """
    step = Fraction(repr(float(dt))) * 10**9
    whole, rest = divmod(step.numerator, step.denominator)
    # k * rest stays exact: the denominator of a decimal text in nanoseconds is small.
    fraction = (2 * steps * rest + step.denominator) // (2 * step.denominator)
    return np.asarray(steps * whole + fraction + round(phase * float(step)), dtype=np.int64)
