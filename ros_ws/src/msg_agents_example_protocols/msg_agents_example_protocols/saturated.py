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
