# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Time means of second moments, with standard errors that hold under the model being tested (docs/statistics.md).

For h(y) = y^T H y, f(y, g) = y^T Y_g y + kappa_g solves the Poisson equation f - E[f(next) | now] = h - (steady mean of
h). So D_k = f(y_k+1, g_k+1) - E[f(y_k+1, g_k+1) | y_k, g_k] are martingale differences, whose sum is N times the error
of the time mean up to a boundary term, whatever the correlation in time. The covariance of the sum is estimated by the
sum of Cov(D_k | y_k, g_k), an exact function of a_k = (s_k, 1), s_k the packed second moments of a step. Graph jumps
that did not happen count as much as those that did, so this holds in runs with a few jumps. Replicas are averaged
inside h, and share the part that is due to the jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import number_text
from msg_analysis.experiment.markov_chain import Schedule
from msg_analysis.inference.observation import Observation
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.first_steps import Start, known_start, steady_start
from msg_analysis.theory.jump_system import JumpSystem, held
from msg_analysis.theory.moments import mode_potential, transient_mean
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.scheduled import mean_given

ROUNDING = 64 * float(np.finfo(float).eps)  # of the largest state: what thousands of steps may leave in differences
PARTS = 20  # of a run, whose variances are compared
MAX_SPREAD = 0.6  # relative standard error of the variance that follows from these parts, at most
MIN_SWITCHES = 1.0
FEW_SWITCHES = 10.0  # expected, below which intervals over all paths cover too much: benchmarks/trust.py


def expected_switches(step: StepModel, steps: int) -> float:
    """Of a run with so many steps in its steady state, away from the graph with the fewest; infinite for one graph."""
    if isinstance(step.switching, Schedule):
        return math.inf
    leaving = steps * step.stationary * (1.0 - np.diag(step.transition))
    return math.inf if step.modes == 1 else float(leaving.min())


def few_switches(switches: float) -> str | None:
    """That a run has few switches, for a sentence about it; None where they are enough."""
    # Then its errors over all paths depend on a few random lengths, and intervals are much too wide (calibration.md).
    if switches >= FEW_SWITCHES:
        return None
    return f"has few switches (some graph is left {number_text(switches, 3)} times on average)"


@dataclass(frozen=True, slots=True, eq=False)
class TimeMeans:
    """Time means over the steps 0..N-1 of q linear functions of y y^T: see ``forms_of``."""

    second_moments: FloatArray  # (f, f) time mean of y y^T, y the agents' coordinates in ``JumpSystem.frame``
    expected_moments: FloatArray  # (f, f) its exact expectation for the run's start and length
    joint: bool  # whether q = p
    measured: FloatArray  # (q,) time means, replicas averaged
    predicted: FloatArray  # (q,) their exact expectation for the run's start and length
    covariance: FloatArray  # (q, q) of measured, under the model
    nodes: FloatArray  # (m, q) the node errors as combinations of the functions; (0, q) where these are too many
    trace: FloatArray  # (q,) the system error as a combination of the functions
    system_series: FloatArray  # (N,) system error of every step, replicas averaged
    system_variances: FloatArray  # (N,) Var(D_k | y_k, g_k) of the system error, or its estimate with lost messages
    # Expected number of switches away from the graph with the fewest; infinite where the path is given or certain
    switches: float = math.inf
    heavy: bool = False  # whether the law over all paths has infinite fourth moments, so that no standard error exists

    @classmethod
    def of(
        cls,
        kind: tuple[FloatArray, FloatArray, FloatArray],
        seen: FloatArray,
        expected: FloatArray,
        covariance: FloatArray,
        series: tuple[FloatArray, FloatArray],
        **others: Any,
    ) -> TimeMeans:
        """Of ``forms_of``, the packed time mean (p,), its expectation (f, f), (q, q), and (N,) both series."""
        forms, nodes, trace = kind
        return cls(
            second_moments=packed_symmetric.unpack(seen, len(expected)),
            expected_moments=expected,
            measured=forms @ seen,
            predicted=forms @ packed_symmetric.pack(expected),
            covariance=covariance,
            nodes=nodes,
            trace=trace,
            system_series=series[0],
            system_variances=series[1],
            **others,
        )

    @property
    def long_enough(self) -> bool:
        """Whether the errors of such runs are nearly normal: many holding times, none of which decides the variance."""
        if self.heavy:
            return False
        if math.isinf(self.switches):
            return True
        if self.switches < MIN_SWITCHES or len(self.system_variances) < PARTS:
            return False
        size, more = divmod(len(self.system_variances), PARTS)
        lengths = np.where(np.arange(PARTS) < more, size + 1, size)
        parts = np.add.reduceat(self.system_variances, lengths.cumsum() - lengths)
        total = float(parts.sum())
        return total > 0.0 and float((parts / total).std(ddof=1)) * math.sqrt(PARTS) <= MAX_SPREAD


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """What the next graph may do to the values f of q forms, given the graph g of this step."""

    # In the methods, a is (b, p + 1): packed moments and 1 of b steps, averaged over R replicas; a combination is (q,).

    probability: FloatArray  # (n,) P_gj
    surprises: FloatArray  # (n, q, p + 1), effect of the next graph j: surprises[j] @ a

    def jumps(self, a: FloatArray) -> FloatArray:
        """(q, q): the part of the sum over the steps of Cov(D_k | now) that is due to the next graph."""
        total = np.zeros((self.surprises.shape[1],) * 2)
        for probability, surprise in zip(self.probability, self.surprises, strict=True):
            surprised = a @ surprise.T
            total += probability * (surprised.T @ surprised)
        return total

    def jump_variances(self, combination: FloatArray, a: FloatArray) -> FloatArray:
        """(b,): the part of Var(D_k | now) that is due to the next graph; of several combinations (r, q), (b, r)."""
        parts = [(a @ (combination @ surprise).T) ** 2 for surprise in self.surprises]
        return np.tensordot(self.probability, np.array(parts), axes=1)


@dataclass(frozen=True, slots=True, eq=False)
class Value(_Jumps):
    """The values, where the next state is normal: E[f(next) | next graph j] - E[f(next)] = surprises[j] @ a."""

    forms: FloatArray  # (n, q, d, d) Y_j
    weights: FloatArray  # (d, d) W_g
    noise: FloatArray  # (d, d) N_g

    def spread(self, total: FloatArray) -> FloatArray:
        """(q, q): the part that is due to the noise, with one replica; ``total`` (p + 1,) is the sum of a.

        Given the next graph j, the next state is N(W y, N): Cov(f_a, f_b) = 2 tr(A N B N) + 4 y^T W^T A N B W y.
        """
        moved = self.weights @ packed_symmetric.unpack(total[:-1], len(self.weights)) @ self.weights.T
        seen = 2.0 * total[-1] * self.noise + 4.0 * moved
        result = np.zeros((self.forms.shape[1],) * 2)
        for probability, form in zip(self.probability, self.forms, strict=True):
            left, right = form @ self.noise, seen @ form  # tr(A N B S) is the product of A N and (B S)^T = S B
            result += probability * left.reshape(len(form), -1) @ right.reshape(len(form), -1).T
        return result

    def variances(self, combination: FloatArray, a: FloatArray, replicas: int) -> FloatArray:
        """(b,): Var(D_k | now) of one combination of the forms in every step."""
        return np.asarray(self.jump_variances(combination, a) + a @ self.spread_variance(combination) / replicas)

    def spread_variance(self, combination: FloatArray) -> FloatArray:
        """(p + 1,): coefficients on a of the part of ``variances`` that is due to the noise, with one replica."""
        linear = np.zeros(self.surprises.shape[2])
        for probability, form in zip(self.probability, self.forms, strict=True):
            matrix = np.tensordot(combination, form, axes=1)
            seen = matrix @ self.noise @ matrix
            linear[:-1] += 4.0 * probability * packed_symmetric.pack(self.weights.T @ seen @ self.weights)
            linear[-1] += 2.0 * probability * np.trace(seen @ self.noise)
        return linear


@dataclass(frozen=True, slots=True, eq=False)
class SharedValue(_Jumps):
    """As ``Value``, where replicas share lost messages, on which the noise of a step depends too.

    With F_k = E[f(y_k+1, g_k+1) | y_k+1, g_k], D_k = (F_k - E[f(next) | now]) + (f(next) - F_k). The variance of the
    second part, the jump's, given y_k+1 and g_k is known. The first part is squared: every step adds to it, so its
    squares do add up to its variance. b is a of the next state, before the jump: f(next) - F_k = surprises[j] @ b.
    """

    reached: FloatArray  # (q, p + 1), F_k = reached @ b
    expected: FloatArray  # (q, p + 1), E[f(next)] = expected @ a

    def increments(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(steps, q): F_k - E[f(next)]."""
        return np.asarray(b @ self.reached.T - a @ self.expected.T)


def start_of_run(prediction: Prediction, start: FloatArray, first: int | None) -> Start:
    """The start of a run, given x(0) (m, R) and g(0) if it is not stationary."""
    system, law = prediction.system, prediction.system.of_modes(prediction.step.initial)
    if prediction.experiment.run.start == "stationary":
        return steady_start(system, system.lifted(prediction.steady), law)
    if first is not None:  # the effect of one draw of g(0) on a transient is not an error
        law = system.of_modes(np.eye(prediction.step.modes)[first])
    return known_start(system, (start - prediction.step.reference).T, law)


def expected_mean(observation: Observation) -> FloatArray:
    """(f, f): exact mean of E[y y^T] over the steps of a run: steady, or transient from the known start."""
    prediction = observation.prediction
    if prediction.path:
        return prediction.system.framed(mean_given(prediction.system, observation.start, observation.modes))
    start = start_of_run(prediction, observation.start, int(observation.modes[0]))
    mean = transient_mean(prediction.system, prediction.steady, start, observation.steps)
    return prediction.system.framed(mean)


def time_means(observation: Observation) -> TimeMeans:
    """Second moments of a run in lockstep and their standard errors, by the martingale method of this module."""
    system, steps = observation.prediction.system, observation.steps
    forms, nodes, trace = forms_of(system, "nodes")
    p = packed_symmetric.size(system.frame.shape[1])
    # Where agents keep values from step to step, f depends on more than is logged: then there are no standard errors.
    without = system.readout is not None or observation.prediction.path
    values = [] if without else values_of(observation.prediction, forms)
    totals = np.zeros((observation.step.modes, p + 1))
    covariance = np.zeros((len(forms), len(forms)))
    series, variances = np.empty(steps), np.zeros(steps)
    for first, last in observation.blocks(max(p, observation.states[0].size), "errors"):
        a = np.ones((last + 1 - first, p + 1))
        a[:, :p] = moments(observation, first, last + 1)
        series[first:last] = a[:-1, :p] @ (trace @ forms)
        for mode, total in enumerate(totals):
            at = np.flatnonzero(observation.modes[first:last] == mode)
            total += a[at].sum(axis=0)
            if not values:
                continue
            value = values[mode]
            if isinstance(value, Value):
                covariance += value.jumps(a[at])
                variances[first + at] = value.variances(trace, a[at], observation.replicas)
            else:
                b = a[at + 1]
                increments = value.increments(a[at], b)
                covariance += increments.T @ increments + value.jumps(b)
                variances[first + at] = (increments @ trace) ** 2 + value.jump_variances(trace, b)
    for value, total in zip(values, totals, strict=False):
        if isinstance(value, Value):
            covariance += value.spread(total) / observation.replicas
    return TimeMeans.of(
        (forms, nodes, trace),
        totals.sum(axis=0)[:p] / steps,
        expected_mean(observation),
        covariance / steps**2,
        (series, variances),
        joint=False,
        switches=expected_switches(observation.step, steps) if values else 0.0,
        heavy=observation.prediction.fourth_moment.finite is not True,
    )


def values_of(prediction: Prediction, forms: FloatArray) -> list[Value | SharedValue]:
    """Values f of the Poisson equation of ``forms`` (q, p) on packed y y^T, one object for each graph."""
    system = prediction.system
    dual = prediction.solver.dual(packed_symmetric.unpack(forms, system.dimension))
    _, kappa = mode_potential(system, dual)
    packed = np.moveaxis(packed_symmetric.pack(dual), 1, 0)
    here = np.concatenate([packed, kappa.T[:, :, None]], axis=2)  # f(y, j) = here[j] @ (s, 1)
    values: list[Value | SharedValue] = []
    for mode, step in enumerate(system.matrices):
        before = step.T @ dual @ step  # (q, n, d, d): the adjoint of this graph's step
        if system.lossy:
            before += held(system, mode).lost_adjoint(dual)
        constant = packed @ packed_symmetric.pack(system.noise[mode]) + kappa.T
        ahead = np.concatenate([np.moveaxis(packed_symmetric.pack(before), 1, 0), constant[:, :, None]], axis=2)
        law = system.chain[mode]
        expected = np.tensordot(law, ahead, axes=1)
        if not system.lossy:
            values.append(Value(law, ahead - expected, np.moveaxis(dual, 1, 0), step, system.noise[mode]))
        else:
            reached = np.tensordot(law, here, axes=1)
            values.append(SharedValue(law, here - reached, reached, expected))
    return values


def forms_of(
    system: JumpSystem, kind: Literal["joint", "nodes", "system"]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Functions (q, p) of packed y y^T, and as their combinations the node errors (m, q) and the system error (q,).

    All second moments ("joint"), the node errors, or only the system error, where the node errors are (0, q).
    """
    frame = system.frame
    per_node = packed_symmetric.pack(frame[:, :, None] * frame[:, None, :])
    if kind == "joint":
        return np.eye(per_node.shape[1]), per_node, per_node.sum(axis=0)
    if kind == "nodes":
        return per_node, np.eye(len(per_node)), np.ones(len(per_node))
    return per_node.sum(axis=0)[None], np.empty((0, 1)), np.ones(1)


def moments(observation: Observation, first: int, last: int) -> FloatArray:
    """(last - first, p): packed y y^T of the states first..last-1, averaged over the replicas."""
    deviations = observation.states[first:last] - observation.step.reference
    return packed_moments(deviations, observation.prediction.system, observation.largest)


def packed_moments(deviations: FloatArray, system: JumpSystem, largest: float) -> FloatArray:
    """(b, p): packed y y^T of deviations (b, m, R), averaged over the replicas; ``largest`` state of the run."""
    y = without_rounding(deviations.transpose(0, 2, 1) @ system.frame, system, largest)
    return packed_symmetric.pack(y.transpose(0, 2, 1) @ y / deviations.shape[2])


def without_rounding(y: FloatArray, system: JumpSystem, largest: float) -> FloatArray:
    """Reduced coordinates y without what rounding leaves of them where the system has no noise."""
    # Agents with the same noise, for example, move together, and their disagreement is rounding.
    return y if system.noise.any() else np.where(np.abs(y) <= ROUNDING * largest, 0.0, y)
