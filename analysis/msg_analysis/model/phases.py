# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Real time: at which time each agent makes each step.

Simulated time follows the clock of the nodes, ``run.speed`` units per second, from the epoch of the run. Agent i makes
its step from x(k) to x(k+1) at (k + phi_i) dt, with the newest values that it has by then. The phases phi_i are
those of unsynchronised timers of equal period: spread evenly over the period, in an order drawn from the seed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.arithmetic.reproducible import Stream, generator
from msg_analysis.common.arrays import FloatArray

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


def phases(experiment: Experiment) -> FloatArray:
    """(m,) phi_i = (rank_i + 1/2) / m, a part of a step; the ranks are a permutation drawn from the seed."""
    ranks = generator(experiment.run.seed, Stream.PHASE).permutation(experiment.agents)
    return np.asarray((ranks + 0.5) / experiment.agents)
