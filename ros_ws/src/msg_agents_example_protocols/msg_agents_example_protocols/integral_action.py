# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Consensus in spite of constant disturbances: a protocol with a state that others do not hear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from msg_analysis.protocol import Heard, Network, Parameters, Protocol


class IntegralActionParameters(Parameters):
    """What an experiment may say beside ``name: integral_action``."""

    gain: float = Field(1.0, gt=0, description="of the integral [1 / unit of time^2]", examples=[1.0])
    disturbance: list[float] = Field(
        default=[], description="of every agent [per unit of time]; none by default", examples=[[0.5, 0.0, -0.5]]
    )


class IntegralAction(Protocol):
    """dx_i = (u_i + gain z_i + d_i) dt + noise, dz_i = u_i dt, with u_i = sum_j a_ij (x_j - x_i). Others hear x_i.

    Under the built-in law agents that drift apart, because of their disturbances d_i, keep a distance. Here z_i comes
    to make up for what d_i is more than the mean of all.
    """

    Parameters = IntegralActionParameters
    parameters: IntegralActionParameters
    states = 2

    def __init__(self, network: Network, parameters: IntegralActionParameters, agent: int) -> None:
        super().__init__(network, parameters, agent)
        given = parameters.disturbance or [0.0] * network.agents
        if len(given) != network.agents:
            raise ValueError(f"disturbance: {len(given)} values, expected one for each of the {network.agents} agents")
        self._disturbance = given[agent]

    def step(
        self, k: int, mode: int, state: NDArray[np.float64], heard: Heard, noise: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See Protocol."""
        x, z = state
        dt = self.network.dt
        pull = heard.weighted_sum(heard.values - x)
        return np.array([x + dt * (pull + self.parameters.gain * z + self._disturbance) + noise, z + dt * pull])
