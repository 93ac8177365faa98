# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Metropolis weights: a linear protocol, with predictions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from msg_analysis.protocol import LinearProtocol, Network, Parameters


class MetropolisParameters(Parameters):
    """What an experiment may say beside ``name: metropolis``."""

    laziness: float = Field(0.0, ge=0, lt=1, description="part of the step that is left out", examples=[0.5])


class Metropolis(LinearProtocol):
    """x_i(k+1) = x_i + (1 - laziness) sum_j (x_j - x_i) / (1 + max(d_i, d_j)) over the d_i neighbours of i.

    W is symmetric, so the mean is kept, and an agent need know its neighbours' numbers of neighbours only. Neither the
    weights of the links nor dt matter.
    """

    Parameters = MetropolisParameters
    parameters: MetropolisParameters

    def __init__(self, network: Network, parameters: MetropolisParameters) -> None:
        super().__init__(network, parameters)
        directed = [graph.name for graph in network.graphs if not graph.symmetric]
        if directed:
            raise ValueError(f"graph {directed[0]} is directed, expected undirected graphs")

    def weights(self, mode: int) -> NDArray[np.float64]:
        """See LinearProtocol."""
        heard = self.network.graphs[mode].adjacency > 0.0
        degrees = heard.sum(axis=1)
        weights = (1.0 - self.parameters.laziness) * heard / (1.0 + np.maximum.outer(degrees, degrees))
        return np.asarray(weights + np.diag(1.0 - weights.sum(axis=1)))
