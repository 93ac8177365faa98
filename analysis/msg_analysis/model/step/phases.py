"""Real time: when which agent makes which step.

Simulated time runs with the clock of the nodes, ``run.speed`` units a second, from the epoch of the run on. Agent i
makes its step from x(k) to x(k+1) at (k + phi_i) dt, with the newest values that it has by then. The phases phi_i are
those of timers of equal period which nobody has synchronised: spread over the period, in an order that the seed draws.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.model.arithmetic.random_streams import Stream, generator
from msg_analysis.types import FloatArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.experiment import Experiment


def phases(experiment: Experiment) -> FloatArray:
    """(m,) phi_i in (0, 1): the part of a step after which agent i makes it.

    They are (rank + 1/2) / m, the ranks a random permutation drawn from the seed of the experiment.

    Parameters
    ----------
    experiment
        in real time; its seed draws them
    """
    ranks = generator(experiment.run.seed, Stream.PHASE).permutation(experiment.agents)
    return np.asarray((ranks + 0.5) / experiment.agents)
