# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Saturated coupling: a protocol that is not linear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from msg_analysis.protocol import Heard, Parameters, Protocol


class SaturatedParameters(Parameters):
    """What an experiment may say beside ``name: saturated``."""

    limit: float = Field(1.0, gt=0, description="largest difference that is felt", examples=[1.0])


class Saturated(Protocol):
    """x_i(k+1) = x_i + dt sum_j a_ij sat(x_j - x_i) + noise, where sat cuts off beyond +-limit.

    Without a limit it would be the built-in law.
    """

    Parameters = SaturatedParameters
    parameters: SaturatedParameters

    def step(
        self, k: int, mode: int, state: NDArray[np.float64], heard: Heard, noise: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See Protocol."""
        limit = self.parameters.limit
        felt = np.clip(heard.values - state[0], -limit, limit)
        return state + self.network.dt * heard.weighted_sum(felt) + noise
