# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Regression of the gains of links on the values that were used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.received_values import ReceivedValues, mode_links, process_noise
from msg_analysis.model.reception import neighbour_tables
from msg_analysis.model.step_model import StepModel

MAX_REGRESSORS = 400
WEIGHT_ROUNDING = 1e-12  # relative to the sum of an agent's weights


@dataclass(frozen=True, slots=True)
class Term:
    """One regressor of the residuals of an agent."""

    # "link": x_j - x_i; "lead": x_i - reference; "pull": the whole pull on the agent
    kind: Literal["constant", "link", "lead", "pull"]
    agent: int  # i
    graph: int | None = None  # the graph in whose steps it is not 0; None: all
    sender: int | None = None  # j of a link
    weight: float = 1.0  # its factor in the law; a gain wrong by a share s has the coefficient s * weight


def terms_of(step: StepModel, most: int) -> list[Term]:
    """Regressors of the residuals, at most so many.

    One for every graph and difference x_j - x_i that row i uses, for every graph and leader (x_i - reference), and for
    every agent (1, which finds a wrong reference or offset). Where these are more than ``most``: the whole pull (W_g x
    - x)_i of a row instead of each of its terms; where that is still too many, without distinguishing graphs.
    """
    n, m, weights = step.modes, step.agents, step.nominal
    pull, links = weights.sum(axis=2) - 1.0, [mode_links(step, mode) for mode in range(n)]
    leads = np.abs(pull) > WEIGHT_ROUNDING
    terms = [Term("constant", i) for i in range(m)]
    if m + sum(len(receiver) for receiver, _, _ in links) + int(leads.sum()) > most:
        graphs = range(n) if n > 1 and m + n * m <= most else [None]
        return terms + [Term("pull", i, graph) for graph in graphs for i in range(m)]
    for mode, (receiver, sender, _) in enumerate(links):
        pairs = zip(receiver.tolist(), sender.tolist(), strict=True)
        terms += [Term("link", i, mode, j, float(weights[mode, i, j])) for i, j in pairs]
        terms += [Term("lead", i, mode, None, float(pull[mode, i])) for i in np.flatnonzero(leads[mode]).tolist()]
    return terms


class Regression:
    """Score test: residuals do not depend on what the agents received, with the weights it was used with.

    Row i uses the differences y_j - x_i of the received values, y_j as published. The scores U_a = sum_k e_i(a)(k)
    phi_a(k) are martingales, and Cov(U_a, U_b) = sum_k (N_k)_i(a)i(b) phi_a phi_b given the inputs, N_k being the
    covariance of the residuals; so U^T Cov^+ U is chi-square with rank(Cov) degrees of freedom, for any correlation.
    In real time the agents make a step one after the other, in the order ``position`` (N, m). With correlated noise, a
    value that is used may contain a part of the noise of the same step; so each residual is first freed of what those
    made earlier in the step say about it.
    """

    def __init__(self, observation: Observation, most: int, position: IntArray | None = None) -> None:
        self._step = step = observation.step
        self._position = position
        self._pull = step.nominal.sum(axis=2) - 1.0  # of the leaders: weight of the own deviation from the reference
        self.terms = terms_of(step, most)  # (K)
        self._each = self.terms[-1].kind != "pull"
        # Place of the regressor by graph, receiver and sender; of a leader or a whole pull, by the agent twice.
        self._place = np.full((step.modes, step.agents, step.agents), -1)
        for place, term in enumerate(self.terms):
            if term.kind != "constant":
                graph, sender = slice(None) if term.graph is None else term.graph, term.sender
                self._place[graph, term.agent, term.agent if sender is None else sender] = place
        self.numbers_per_step = (2 + step.most_neighbours) * step.agents * observation.replicas
        count = len(self.terms)
        self._score, self._covariance = np.zeros(count), np.zeros((count, count))
        self._gram = np.zeros((count, count))

    def statistic(self) -> tuple[FloatArray, FloatArray]:
        """Scores U (K,) and their covariance (K, K)."""
        return self._score, self._covariance

    def gram(self) -> FloatArray | None:
        """(K, K): sum of phi_a phi_b of regressors of the same agent; E[U] is that times the coefficients.

        None where residuals are freed of earlier ones.
        """
        return None if self._position is not None else self._gram

    def add(self, reception: ReceivedValues, residuals: FloatArray, first: int = 0) -> None:
        """Add a block of steps, beginning with step ``first``, and their residuals (b, m, R)."""
        order = None
        if self._position is not None:
            order = np.argsort(self._position[first : first + len(residuals)], axis=1)
        for graphs, agents, at in reception.patterns(order):
            e, process = residuals[at], process_noise(self._step, graphs)
            if agents is not None:
                e, process = _freed(e, process, agents)
            places, rows, phi = self._regressors(reception, at, graphs)
            self._score[places] += np.einsum("kar,kar->a", e[:, rows], phi)
            block = np.ix_(places, places)
            flat = phi.transpose(1, 0, 2).reshape(len(rows), -1)
            products = flat @ flat.T
            self._covariance[block] += process[np.ix_(rows, rows)] * products
            self._gram[block] += (rows[:, None] == rows) * products
            if reception.link_variance.any():
                phi = phi * np.sqrt(reception.link_variance[at])[:, rows, None]
                flat = phi.transpose(1, 0, 2).reshape(len(rows), -1)
                self._covariance[block] += (rows[:, None] == rows) * (flat @ flat.T)

    def _regressors(
        self, reception: ReceivedValues, at: IntArray, graphs: IntArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Places (a,), rows (a,) and values (len(at), a, R): constants of all agents, then what their rows use."""
        m, tables = self._step.agents, neighbour_tables(self._step)
        agents = np.arange(m)
        x = reception.states[at]
        deviation = x - self._step.reference
        ones, own = np.ones((len(at), m, x.shape[2])), self._place[graphs, agents, agents]
        receivers, which = np.nonzero(np.arange(self._step.most_neighbours) < tables.count[graphs, agents][:, None])
        differences = reception.received(at, receivers, which) - x[:, receivers]
        weights = reception.weights[at[:, None], receivers, which][:, :, None]
        if self._each:
            leaders, of_receivers = np.flatnonzero(own >= 0), graphs[receivers]
            links = self._place[of_receivers, receivers, tables.senders[of_receivers, receivers, which]]
            rows = np.concatenate([agents, receivers, leaders])
            parts = [ones, differences * (weights != 0.0), deviation[:, leaders]]
            return np.concatenate([agents, links, own[leaders]]), rows, np.concatenate(parts, axis=1)
        pulled = self._pull[graphs, agents][:, None] * deviation
        for i in range(m):
            mine = receivers == i
            pulled[:, i] += (weights[:, mine] * differences[:, mine]).sum(axis=1)
        return np.concatenate([agents, own]), np.tile(agents, 2), np.concatenate([ones, pulled], axis=1)


def _freed(e: FloatArray, process: FloatArray, agents: IntArray) -> tuple[FloatArray, FloatArray]:
    """Residuals less what those of agents earlier in the order say about them; and their covariance (m, m)."""
    free = np.eye(len(agents))
    for number, i in enumerate(agents.tolist()):
        before = agents[:number]
        free[i, before] = -process[i, before] @ np.linalg.pinv(process[np.ix_(before, before)], hermitian=True)
    return free @ e, np.diag(np.diag(free @ process @ free.T).clip(0.0))
