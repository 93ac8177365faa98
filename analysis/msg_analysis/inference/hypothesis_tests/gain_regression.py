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

"""Score test of the gains where the agents use the states themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.types import BoolArray, FloatArray, IntArray

MAX_REGRESSORS = 400
WEIGHT_ROUNDING = 1e-12  # relative to the sum of an agent's weights


@dataclass(frozen=True, slots=True)
class Term:
    """One regressor of the innovations of an agent."""

    # "link": x_j - x_i; "lead": x_i - reference; "pull": the whole pull on the agent
    kind: Literal["constant", "link", "lead", "pull"]
    agent: int  # i
    graph: int | None = None  # the graph in whose steps it is not 0; None: all
    sender: int | None = None  # j of a link
    weight: float = 1.0  # its factor in the law; a gain wrong by a share s has the coefficient s * weight


class StateRegression:
    """Score test: the innovations of row i do not depend on what row i of W_g uses; at most ``most`` terms K.

    The scores U_a = sum_k e_i(a)(k) phi_a(k) are martingales, and Cov(U_a, U_b) = sum_k (N_g)_i(a)i(b) phi_a phi_b
    given the inputs; so U^T Cov^+ U is chi-square with rank(Cov) degrees of freedom, for correlated noise too. All
    regressors are linear in z, the deviations of the agents and a constant 1.
    """

    def __init__(self, observation: Observation, most: int = MAX_REGRESSORS) -> None:
        self._step = step = observation.step
        self._rows, self._regressors, self.terms = regressors(step, most)
        self._centred = observation.prediction.experiment.problem == "consensus"
        size = step.agents + 1
        self._scores = np.zeros((step.modes, step.agents, size))  # sum of e z^T
        self._inputs = np.zeros((step.modes, size, size))  # sum of z z^T

    @property
    def numbers_per_step(self) -> int:
        """Size of the largest temporary array, per step; 0: not limiting."""
        return 0

    def add(self, modes: IntArray, states: FloatArray, innovations: FloatArray) -> None:
        """Add a block of steps: graphs (b,) from 0, states x(k) and innovations (b, m, R)."""
        m = self._step.agents
        z = np.ones((len(modes), m + 1, states.shape[2]))
        z[:, :m] = states - (states.mean(axis=1, keepdims=True) if self._centred else self._step.reference)
        for mode in range(self._step.modes):
            at = np.flatnonzero(modes == mode)
            flat_e = innovations[at].transpose(1, 0, 2).reshape(m, -1)
            flat_z = z[at].transpose(1, 0, 2).reshape(m + 1, -1)
            self._scores[mode] += flat_e @ flat_z.T
            self._inputs[mode] += flat_z @ flat_z.T

    def statistic(self) -> tuple[FloatArray, FloatArray]:
        """U (K,) and Cov (K, K)."""
        rows = self._rows
        score = np.einsum("gac,gac->a", self._scores[:, rows], self._regressors)
        return score, self._sum(self._step.noise[:, rows[:, None], rows])

    def gram(self) -> FloatArray:
        """(K, K): sum of phi_a phi_b of regressors of the same agent; E[U] is that times the coefficients."""
        same = self._rows[:, None] == self._rows
        return self._sum(np.broadcast_to(same, (self._step.modes, *same.shape)))

    def _sum(self, factors: FloatArray | BoolArray) -> FloatArray:
        """(K, K): sum over the steps of phi_a phi_b times a factor (n, K, K) that depends on the graph."""
        total = np.zeros((len(self._rows),) * 2)
        for factor, inputs, products in zip(factors, self._regressors, self._inputs, strict=True):
            total += factor * (inputs @ products @ inputs.T)
        return total


def regressors(step: StepModel, most: int) -> tuple[IntArray, FloatArray, list[Term]]:
    """Regressors of the innovations: phi_a(k) = inputs[g, a] . z(k) for row rows[a].

    One for every graph and difference x_j - x_i that row i uses, for every graph and leader (x_i - reference), and for
    every agent (1, which finds a wrong reference or offset). Where these are more than ``most``: the whole pull (W_g x
    - x)_i of a row instead of each of its terms; where that is still too many, without distinguishing graphs.

    Parameters
    ----------
    step
        step model of the run
    most
        largest number K

    Returns
    -------
    tuple[IntArray, FloatArray, list[Term]]
        rows (K,), inputs (n, K, m + 1), and the terms (K)
    """
    n, m = step.modes, step.agents
    terms = [Term("constant", i) for i in range(m)]
    sums = step.weights.sum(axis=2)
    heard = int(step.links.sum(where=~np.eye(m, dtype=np.bool_)))
    if m + heard + int((np.abs(1.0 - sums) > WEIGHT_ROUNDING).sum()) <= most:
        for mode in range(n):
            for i in range(m):
                for j in step.neighbours(mode, i).tolist():
                    terms.append(Term("link", i, mode, j, float(step.weights[mode, i, j])))
                if abs(1.0 - sums[mode, i]) > WEIGHT_ROUNDING:
                    terms.append(Term("lead", i, mode, None, float(sums[mode, i] - 1.0)))
    elif m + n * m <= most:
        terms += [Term("pull", i, mode) for mode in range(n) for i in range(m)]
    else:
        terms += [Term("pull", i) for i in range(m)]
    unit = np.eye(m + 1)
    pulls = np.zeros((n, m, m + 1))
    pulls[:, :, :m] = step.weights - np.eye(m)
    inputs = np.zeros((n, len(terms), m + 1))
    for a, term in enumerate(terms):
        modes = slice(None) if term.graph is None else term.graph
        if term.kind == "pull":
            inputs[modes, a] = pulls[modes, term.agent]
        elif term.kind == "link":
            inputs[modes, a] = unit[term.sender] - unit[term.agent]
        else:
            inputs[modes, a] = unit[m if term.kind == "constant" else term.agent]
    return np.array([term.agent for term in terms]), inputs, terms
