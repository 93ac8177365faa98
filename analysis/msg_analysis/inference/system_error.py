# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the errors, and the evidence on the system error: an exponentially tilted martingale.

For f(y, g) = y^T Y_g y + kappa_g of ``time_means`` and any rate l, exp(l f(y_k+1, g_k+1)) over its conditional mean is
a martingale factor. The mean is in closed form: given the next graph j, the next y is normal, so that of a quadratic
form is exp of another one; the graphs are then summed over. Replicas are averaged inside f.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.e_values import log_sum
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.question import Question, RunningSums, Statistics, Test
from msg_analysis.inference.time_means import Value, forms_of, values_of
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.moments import MomentSolver, mode_potential
from msg_analysis.theory.prediction import Prediction


def _error_tests(name: str, error: Estimate | None) -> list[Test]:
    return [] if error is None or error.p is None else [Test(name, error.p, estimate=error)]


class SystemMeanError(Question):
    """Whether the mean system error is as predicted."""

    name = "system error"
    meaning = "the mean-square error of the whole system differs from the prediction"

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Corrected for the run's sequence of graphs where that is known."""
        return _error_tests(cls.name + run.corrected, run.system_error)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """Over all paths of the graphs; only in lockstep without noise, delay or loss of the messages."""
        return sums.error[:, None] if sums.error.size else super().evidence(sums)


class AgentMeanErrors(Question):
    """Whether the mean error of each agent is as predicted."""

    name = "error of agent"
    meaning = "the mean-square error of this agent differs from the prediction"

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """One for each agent."""
        nodes = enumerate(run.node_errors, start=1)
        return [test for i, node in nodes for test in _error_tests(f"{cls.name} {i}{run.corrected}", node)]

    def number_of_tests(self) -> int:
        """One for each agent."""
        return self.law.step.agents


class Covariance(Question):
    """Whether all second moments together are as predicted."""

    name = "covariance"
    meaning = "the errors of the agents, or how they vary together, differ from the prediction"
    p_value = attrgetter("p_covariance")


class RunsAlike(Question):
    """Whether several runs differ from the prediction by the same."""

    name = "runs alike"
    meaning = "the runs differ from each other by more than chance: not all followed the same model"
    p_value = attrgetter("p_alike")

    def number_of_tests(self) -> int:
        """None of a single run."""
        return 0


HORIZONS = (300.0, 1e3, 3e3, 1e4, 3e4, 1e5, 1e6)
"""Steps after which the rates find an error that shows then: one rate of either sign for each."""

DETECTED = 4.0  # size of such an error, in standard errors at that time: its evidence is then exp(8)
MOST_SHARE = 0.5  # of the rate beyond which the mean is infinite


class ErrorMartingale:
    """Steps of the logarithm of the martingale, for every rate (L,); ValueError for a system with lost messages."""

    _known: ClassVar[WeakKeyDictionary[MomentSolver, dict[int, ErrorMartingale]]] = WeakKeyDictionary()

    @classmethod
    def of(cls, prediction: Prediction, replicas: int) -> ErrorMartingale:
        """Made once for all runs with this prediction."""
        known = cls._known.setdefault(prediction.solver, {})
        if replicas not in known:
            known[replicas] = cls(prediction, replicas)
        return known[replicas]

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        system = prediction.system
        if system.lossy:
            raise ValueError("lost messages: the next state is not normal given this one")
        forms, _, trace = forms_of(system, "system")
        values = [value for value in values_of(prediction, forms) if isinstance(value, Value)]
        self._forms = values[0].forms[:, 0]  # (n, d, d), the same for every graph of this step
        self._kappa = mode_potential(system, self._forms[None])[1][0]  # (n,)
        self._system, self._replicas = system, replicas
        self.variance = _typical_variance(prediction, replicas, values, trace)
        self.rates = self._choose_rates()
        self.numbers = packed_symmetric.size(system.dimension) + 1
        self._value = np.concatenate([packed_symmetric.pack(self._forms), self._kappa[:, None]], axis=1)  # (n, p + 1)
        # (n, n, L, p + 1): log E[exp(l f(next)) | next graph j] = means[g, j, l] @ (s, 1)
        self._means = np.array([[self._tilted(g, j) for j in range(system.modes)] for g in range(system.modes)])
        with np.errstate(divide="ignore"):
            self._log_law = np.log(system.chain)

    def steps(self, modes: IntArray, following: IntArray, a: FloatArray, b: FloatArray) -> FloatArray:
        """(k, L): of steps with these graphs and next ones (k,), and (s, 1) before and after them, (k, p + 1) each."""
        found = np.empty((len(modes), len(self.rates)))
        for mode in np.unique(modes).tolist():
            at = np.flatnonzero(modes == mode)
            reached = (self._value[following[at]] * b[at]).sum(axis=1)
            means = np.einsum("jlp,kp->klj", self._means[mode], a[at], optimize=True)
            found[at] = reached[:, None] * self.rates - log_sum(means + self._log_law[mode], axis=2)
        return found

    def _choose_rates(self) -> FloatArray:
        """(L,); none where nothing is random."""
        if self.variance <= 0.0:
            return np.empty(0)
        largest = 0.0
        for noise in self._system.noise:
            root = _root(noise)
            largest = max(largest, float(np.abs(np.linalg.eigvalsh(root @ self._forms @ root)).max()))
        most = MOST_SHARE * self._replicas / (2.0 * largest) if largest else math.inf
        rates = np.unique(np.minimum(DETECTED / np.sqrt(np.array(HORIZONS) * self.variance), most))
        return np.concatenate([-rates[::-1], rates])

    def _tilted(self, mode: int, following: int) -> FloatArray:
        """(L, p + 1): see ``_means``."""
        system, d, r = self._system, self._system.dimension, self._replicas
        root, step = _root(system.noise[mode]), system.matrices[mode]
        form = (self.rates / r)[:, None, None] * self._forms[following]  # (L, d, d)
        seen = form @ root
        left = np.eye(d) - 2.0 * root @ seen
        tilted = form + 2.0 * seen @ np.linalg.solve(left, seen.transpose(0, 2, 1))
        tilted = (tilted + tilted.transpose(0, 2, 1)) / 2.0
        constants = self.rates * self._kappa[following] - 0.5 * r * np.linalg.slogdet(left)[1]
        return np.column_stack([r * packed_symmetric.pack(step.T @ tilted @ step), constants])


def _typical_variance(prediction: Prediction, replicas: int, values: Sequence[Value], trace: FloatArray) -> float:
    """Var(D_k) at the steady second moments: what rates are chosen by; nothing depends on its being exact."""
    total = 0.0
    law = prediction.system.stationary
    for value, moments, share in zip(values, prediction.steady, law, strict=True):
        a = np.append(packed_symmetric.pack(moments / share), 1.0)[None]
        total += share * float(value.variances(trace, a, replicas)[0])
    return total


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(values.clip(0.0))) @ vectors.T)
