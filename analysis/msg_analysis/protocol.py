# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The interface for laws of agents in other packages.

A package offers a law under the entry-point group ``msg_agents.protocols``; an experiment asks for it by
``protocol: {name: ..., ...}``. There are two kinds:

* ``LinearProtocol`` declares the matrix of a step under every graph. It runs as fast as the built-in law, and is
  predicted and tested like it.
* ``Protocol`` is any step from an agent's own state and what it has heard. It is run, recorded and measured, without a
  prediction.

A step must depend on its arguments only. What is to be remembered belongs in the state: only the state is kept for an
agent whose process was killed, and only then does the offline twin make the same steps.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from msg_analysis.arithmetic.update_law import weighted_sum
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.graphs import Graph

__all__ = ["ENTRY_POINTS", "Graph", "Heard", "LinearProtocol", "Network", "Parameters", "Protocol"]

ENTRY_POINTS = "msg_agents.protocols"
"""Group of entry points under which packages offer their protocols, by the name that experiments use."""


class Parameters(BaseModel):
    """Parameters of a protocol in the experiment file, beside its name; derive from it, with a default for every field.

    Unknown keys and values of a wrong type are errors of the experiment file, reported with all others.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """The network that a protocol is made for. Agents and graphs count from 0.

    Attributes
    ----------
    graphs
        the n graphs, each with ``name``, ``adjacency`` (m, m) and ``laplacian`` (m, m); ``adjacency[i, j]`` > 0 where
        agent i hears agent j
    dt
        simulated time of a step; 1 in discrete time
    noise_gain
        (n, m, m) B_g = sqrt(dt) F, with F of the experiment: the process noise of a step is B_g v with v ~ N(0, I)
    tracking
        whether the agents should follow leaders to ``reference`` instead of agreeing with each other
    leader_gains
        (m,) kappa [1 / unit of simulated time]; 0 for followers, inf for leaders held at the reference
    reference
        what is tracked; 0 without leaders
    """

    graphs: tuple[Graph, ...]
    dt: float
    noise_gain: FloatArray
    tracking: bool
    leader_gains: FloatArray
    reference: float

    @property
    def agents(self) -> int:
        """Number of agents m."""
        return self.graphs[0].agents


class LinearProtocol(ABC):
    """x(k+1) = W_g x(k) + B_g v(k): one object for the whole network.

    Leaders are added as in the built-in law: dt kappa (reference - x_i) is added to the step of a leader; leaders of
    infinite gain are held at the reference instead, in discrete time plus their process noise.

    ``Parameters`` is the class of the parameters.

    Parameters
    ----------
    network
        the whole network
    parameters
        an instance of ``Parameters``, checked

    Raises
    ------
    ValueError
        the parameters do not fit this network; the text is shown to the user
    """

    Parameters: ClassVar[type[BaseModel]] = Parameters

    def __init__(self, network: Network, parameters: Any) -> None:
        self.network = network
        self.parameters = parameters

    @abstractmethod
    def weights(self, mode: int) -> FloatArray:
        """W_g of a graph, (m, m): rows sum to 1, and agent i uses only itself and the agents that it hears there.

        Parameters
        ----------
        mode
            index of the graph, from 0
        """

    def noise_gain(self, mode: int) -> FloatArray:
        """B_g of a graph, (m, m); by default that of the experiment.

        Parameters
        ----------
        mode
            index of the graph, from 0
        """
        return np.asarray(self.network.noise_gain[mode])


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """What an agent has heard for one step, from d neighbours.

    Lost messages are not in it; broadcast and link noise are in the values.

    Attributes
    ----------
    agents
        (d,) the neighbours, from 0, ascending
    weights
        (d,) of the links, as in the graph's adjacency
    values
        (d, R) what they published
    """

    agents: IntArray
    weights: FloatArray
    values: FloatArray

    def weighted_sum(self, terms: FloatArray) -> FloatArray:
        """Sum over the neighbours of weights[d] * terms[d], (R,); 0 if none was heard.

        Adds one term after the other, which gives the same bits on every machine; a matrix product may not.

        Parameters
        ----------
        terms
            (d, R), for example differences of ``values``
        """
        if not len(self.weights):
            return np.zeros(terms.shape[1:])
        return weighted_sum(self.weights.tolist(), list(terms))


class Protocol(ABC):
    """Any law of an agent: one object for each agent.

    The state is (S, R): S numbers for each of R replicas, which are independent copies and must not mix. Its first row
    is the agent's value: what an experiment's ``start`` gives, and what errors are measured on.

    ``Parameters`` is the class of the parameters.

    Attributes
    ----------
    tracking
        whether this protocol handles leaders; otherwise experiments with ``problem: tracking`` are refused
    states
        S; may be set in the constructor, to the same number for all agents
    network, parameters, agent
        as given; the agent counts from 0

    Raises
    ------
    ValueError
        (constructor) the parameters do not fit this network; the text is shown to the user
    """

    Parameters: ClassVar[type[BaseModel]] = Parameters
    tracking: ClassVar[bool] = False
    states: int = 1

    def __init__(self, network: Network, parameters: Any, agent: int) -> None:
        self.network = network
        self.parameters = parameters
        self.agent = agent

    def start(self, value: FloatArray) -> FloatArray:
        """State (S, R) at step 0. By default the value in the first row, and 0 elsewhere.

        Parameters
        ----------
        value
            (R,) the agent's start in the experiment
        """
        state = np.zeros((self.states, len(value)))
        state[0] = value
        return state

    def publish(self, state: FloatArray) -> FloatArray:
        """What others hear of a state, (R,). By default its first row.

        Parameters
        ----------
        state
            (S, R) of this agent
        """
        return np.asarray(state[0])

    @abstractmethod
    def step(self, k: int, mode: int, state: FloatArray, heard: Heard, noise: FloatArray) -> FloatArray:
        """The state after a step.

        Parameters
        ----------
        k
            number of the step, from x(k) to x(k+1)
        mode
            graph of the step, from 0
        state
            (S, R) before the step; read-only
        heard
            what the neighbours published of their states of step k
        noise
            (R,) this agent's process noise of the step, N(0, (B_g B_g^T)_ii), correlated between agents as F says;
            read-only

        Returns
        -------
        FloatArray
            (S, R), finite
        """
