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

"""Score test of the gains with noise or loss on the air, and in real time."""

from __future__ import annotations

import numpy as np

from msg_analysis.inference.hypothesis_tests.gain_regression import Term
from msg_analysis.inference.observed.heard_values import HeardValues, mode_links, process_noise
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.types import FloatArray, IntArray


class HeardRegression:
    """Score test: innovations do not depend on what the agents heard, with the weights it was used with.

    As ``gain_regression.StateRegression``, but row i uses the differences y_j - x_i of the received values, y_j as
    published, and the covariance of the innovations is that of each step. In real time the agents make a step one after
    the other. With correlated noise, a value that is used may contain a part of the noise of the same step; so each
    innovation is first freed of what those made earlier in the step say about it (``position``, needed only then).

    Parameters
    ----------
    observation
        of a run with noise or loss on the air, or in real time
    most
        largest number of regressors K; beyond it, fewer kinds of them are tested
    position
        (N, m) order in which the states were made
    """

    def __init__(self, observation: Observation, most: int, position: IntArray | None = None) -> None:
        self._step = step = observation.step
        self._replicas = observation.replicas
        self._position = position
        n, m = step.modes, step.agents
        # Weight of a state's own deviation from the reference: the leaders' pull.
        self._pull = step.nominal.sum(axis=2) - 1.0
        leads = np.abs(self._pull) > 1e-12
        self._links = [mode_links(step, mode) for mode in range(n)]
        count = m + sum(len(receiver) for receiver, _, _ in self._links) + int(leads.sum())
        self._each = count <= most
        if not self._each:
            count = n * m + m if n * m + m <= most else 2 * m
        # Index of the regressor of a link, of a leader, or of the whole pull on an agent; by the agent's graph.
        self._link_place = np.zeros((n, m, step.most_neighbours), dtype=np.int64)
        self._lead_place = np.full((n, m), -1)
        self._pull_place = np.zeros((n, m), dtype=np.int64)
        place = m
        for mode, (receiver, _, which) in enumerate(self._links):
            self._pull_place[mode] = np.arange(m) + (m + mode * m if count == n * m + m else m)
            self._link_place[mode, receiver, which] = np.arange(place, place + len(receiver))
            place += len(receiver)
            leaders = np.flatnonzero(leads[mode])
            self._lead_place[mode, leaders] = np.arange(place, place + len(leaders))
            place += len(leaders)
        self._score, self._covariance = np.zeros(count), np.zeros((count, count))
        self._gram = np.zeros((count, count))

    @property
    def numbers_per_step(self) -> int:
        """Size of the largest temporary array, per step."""
        m, d = self._step.agents, self._step.most_neighbours
        return max((2 + d) * m * self._replicas, m * d)

    def statistic(self) -> tuple[FloatArray, FloatArray]:
        """Scores U (K,) and their covariance (K, K)."""
        return self._score, self._covariance

    def gram(self) -> FloatArray | None:
        """See ``StateRegression.gram``; None where innovations are freed of earlier ones."""
        return None if self._position is not None else self._gram

    @property
    def terms(self) -> list[Term]:
        """The regressors (K); the weights are the nominal ones."""
        step = self._step
        found = [Term("constant", i) for i in range(step.agents)]
        if not self._each:
            graphs = range(step.modes) if len(self._score) > 2 * step.agents else [None]
            return found + [Term("pull", i, graph) for graph in graphs for i in range(step.agents)]
        for mode, (receiver, sender, _) in enumerate(self._links):
            links = zip(receiver.tolist(), sender.tolist(), strict=True)
            found += [Term("link", i, mode, j, float(step.nominal[mode, i, j])) for i, j in links]
            leaders = np.flatnonzero(self._lead_place[mode] >= 0).tolist()
            found += [Term("lead", i, mode, None, float(self._pull[mode, i])) for i in leaders]
        return found

    def add(self, reception: HeardValues, innovations: FloatArray, first: int = 0) -> None:
        """Add a block of steps, beginning with step ``first``, and their innovations (b, m, R)."""
        order = None
        if self._position is not None:
            order = np.argsort(self._position[first : first + len(innovations)], axis=1)
        for graphs, agents, at in reception.patterns(order):
            e, process = innovations[at], process_noise(self._step, graphs)
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
        self, reception: HeardValues, at: IntArray, graphs: IntArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Places (a,), rows (a,) and values (len(at), a, R): constants of all agents, then what their rows use."""
        m = self._step.agents
        agents = np.arange(m)
        x = reception.states[at]
        deviation = x - self._step.reference
        ones = np.ones((len(at), m, x.shape[2]))
        receivers, which = np.nonzero(np.arange(self._step.most_neighbours) < self._count(graphs)[:, None])
        differences = reception.heard(at, receivers, which) - x[:, receivers]
        weights = reception.weights[at[:, None], receivers, which][:, :, None]
        if self._each:
            leaders = np.flatnonzero(self._lead_place[graphs, agents] >= 0)
            places = [agents, self._link_place[graphs[receivers], receivers, which], self._lead_place[graphs, agents]]
            places[2] = places[2][leaders]
            rows = np.concatenate([agents, receivers, leaders])
            parts = [ones, differences * (weights != 0.0), deviation[:, leaders]]
            return np.concatenate(places), rows, np.concatenate(parts, axis=1)
        pulled = self._pull[graphs, agents][:, None] * deviation
        for i in range(m):
            mine = receivers == i
            pulled[:, i] += (weights[:, mine] * differences[:, mine]).sum(axis=1)
        places = [agents, self._pull_place[graphs, agents]]
        return np.concatenate(places), np.tile(agents, 2), np.concatenate([ones, pulled], axis=1)

    def _count(self, graphs: IntArray) -> IntArray:
        """(m,): neighbours of the agents."""
        return np.asarray(neighbour_tables(self._step).count[graphs, np.arange(self._step.agents)])


def _freed(e: FloatArray, process: FloatArray, agents: IntArray) -> tuple[FloatArray, FloatArray]:
    """Innovations less what those of agents earlier in the order say about them; and their covariance (m, m)."""
    free = np.eye(len(agents))
    for number, i in enumerate(agents.tolist()):
        before = agents[:number]
        free[i, before] = -process[i, before] @ np.linalg.pinv(process[np.ix_(before, before)], hermitian=True)
    return free @ e, np.diag(np.diag(free @ process @ free.T).clip(0.0))
