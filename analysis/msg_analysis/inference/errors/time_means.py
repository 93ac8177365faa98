"""Time means of second moments, with standard errors that hold under the model being tested.

For a quadratic form h(y) = y^T H y the Poisson equation gives f(y, g) = y^T Y_g y + kappa_g with
f - E[f(next) | now] = h - (steady mean of h). So the

    D_k = f(y_k+1, g_k+1) - E[f(y_k+1, g_k+1) | y_k, g_k]

are martingale differences whose sum is N times the error of the time mean, up to a boundary term, whatever
the correlation in time. The covariance of the sum is estimated by the predictable quadratic variation, the
sum of Cov(D_k | y_k, g_k), and not by sum D_k D_k^T: jumps of the graph that did not happen count as much as
those that did, so that the standard errors do not break down in runs with a few jumps. With every step's
second moments s_k packed, and a_k = (s_k, 1), it is exact.
Replicas share the path of the graphs: they are averaged inside h, and share the part of Cov(D_k) that is due
to the jump.

Replicas also share lost messages, on which the noise of a step depends too. Then D_k is split at the moment when
the step has been made and the graph has not jumped yet: with F_k = E[f(y_k+1, g_k+1) | y_k+1, g_k],

    D_k = (F_k - E[f(next) | now])  +  (f(next) - F_k).

The variance of the second part, the jump's, given y_k+1 and g_k is known as before; the first part is squared:
every step adds to it, so its squares do add up to its variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from msg_analysis.inference.observed.observation import Observation
from msg_analysis.theory.moments import mode_potential, transient_mean
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.theory.system.lost_messages import lost_adjoint
from msg_analysis.types import FloatArray

MAX_JOINT = 210
"""Most second moments that are all estimated (20 agents); beyond that, only the node errors."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeMeans:
    """Time means over the steps 0..N-1 of linear functions of y y^T.

    Attributes
    ----------
    second_moments
        (d, d) time mean of y y^T
    expected_moments
        (d, d) its exact expectation under the run's start and length
    joint
        whether what follows is about all entries of y y^T, packed (q = p); else the node errors (q = m)
    measured
        (q,) time means, replicas averaged
    predicted
        (q,) their exact expectation under the run's start and length
    covariance
        (q, q) of measured under the model
    squares
        number of steps whose squares make up ``covariance``; 0 where it is known from the model
    nodes
        (m, q) the node errors as combinations of them; (0, q) where they are too many
    trace
        (q,) the system error as a combination of them
    system_series
        (N,) system error of every step, replicas averaged
    system_variances
        (N,) of the system error: Var(D_k | y_k, g_k), or what stands for it with lost messages
    """

    second_moments: FloatArray
    expected_moments: FloatArray
    joint: bool
    measured: FloatArray
    predicted: FloatArray
    covariance: FloatArray
    squares: int
    nodes: FloatArray
    trace: FloatArray
    system_series: FloatArray
    system_variances: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """What the next step may do to the values f of q forms, given one graph g and a = (s, 1).

    Attributes
    ----------
    probability
        (n,) P_gj
    surprises
        (n, q, p + 1): E[f(next) | next graph j] - E[f(next)] = surprises[j] @ a
    forms
        (n, q, d, d) Y_j
    weights
        (d, d) W_g
    noise
        (d, d) N_g
    """

    probability: FloatArray
    surprises: FloatArray
    forms: FloatArray
    weights: FloatArray
    noise: FloatArray

    def jumps(self, a: FloatArray) -> FloatArray:
        """(q, q): the part of the sum over steps of Cov(D_k | now) that the next graph is to blame for.

        Parameters
        ----------
        a
            (b, p + 1) of some steps
        """
        total = np.zeros((self.forms.shape[1],) * 2)
        for probability, surprise in zip(self.probability, self.surprises, strict=True):
            surprised = a @ surprise.T
            total += probability * (surprised.T @ surprised)
        return total

    def spread(self, total: FloatArray) -> FloatArray:
        """(q, q): the part that the noise is to blame for, with one replica.

        Given the next graph j, the next state is N(W y, N): Cov(f_a, f_b) = 2 tr(A N B N) + 4 y^T W^T A N B W y.

        Parameters
        ----------
        total
            (p + 1,) sum of a over the steps
        """
        moved = self.weights @ packed_symmetric.unpack(total[:-1], len(self.weights)) @ self.weights.T
        seen = 2.0 * total[-1] * self.noise + 4.0 * moved
        result = np.zeros((self.forms.shape[1],) * 2)
        for probability, form in zip(self.probability, self.forms, strict=True):
            left, right = form @ self.noise, seen @ form  # tr(A N B S) is the product of A N and (B S)^T = S B
            result += probability * left.reshape(len(form), -1) @ right.reshape(len(form), -1).T
        return result

    def variances(self, combination: FloatArray, a: FloatArray, replicas: int) -> FloatArray:
        """(b,): Var(D_k | now) of one combination (q,) of the forms in every step, a being (b, p + 1).

        Parameters
        ----------
        combination
            (q,) of the forms
        a
            (b, p + 1) packed moments and 1, of each step
        replicas
            R, over which ``a`` is averaged
        """
        return np.asarray(self.jump_variances(combination, a) + a @ self.spread_variance(combination) / replicas)

    def jump_variances(self, combination: FloatArray, a: FloatArray) -> FloatArray:
        """(b,): the part of ``variances`` that the next graph is to blame for.

        Parameters
        ----------
        combination
            (q,) of the forms
        a
            (b, p + 1) packed moments and 1, of each step
        """
        parts = [(a @ (combination @ surprise)) ** 2 for surprise in self.surprises]
        return np.asarray(self.probability @ np.array(parts))

    def spread_variance(self, combination: FloatArray) -> FloatArray:
        """(p + 1,): as a function of a, the part that the noise is to blame for, with one replica.

        Parameters
        ----------
        combination
            (q,) of the forms
        """
        linear = np.zeros(self.surprises.shape[2])
        for probability, form in zip(self.probability, self.forms, strict=True):
            matrix = np.tensordot(combination, form, axes=1)
            seen = matrix @ self.noise @ matrix
            linear[:-1] += 4.0 * probability * packed_symmetric.pack(self.weights.T @ seen @ self.weights)
            linear[-1] += 2.0 * probability * np.trace(seen @ self.noise)
        return linear


@dataclass(frozen=True, slots=True, eq=False)
class SharedValue:
    """The same where replicas share lost messages; b = (s, 1) is that of the next state, before the jump.

    Attributes
    ----------
    probability
        (n,) P_gj
    surprises
        (n, q, p + 1): f(next) - F_k = surprises[j] @ b for the next graph j
    reached
        (q, p + 1): F_k = reached @ b
    expected
        (q, p + 1): E[f(next)] = expected @ a
    """

    probability: FloatArray
    surprises: FloatArray
    reached: FloatArray
    expected: FloatArray

    def increments(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(steps, q): F_k - E[f(next)] of steps with these a and b, both (steps, p + 1).

        Parameters
        ----------
        a
            (steps, p + 1) packed moments and 1 before each step
        b
            (steps, p + 1) the same after it
        """
        return np.asarray(b @ self.reached.T - a @ self.expected.T)

    def jumps(self, b: FloatArray) -> FloatArray:
        """(q, q): sum over steps of Cov(f(next) - F_k), with b (steps, p + 1).

        Parameters
        ----------
        b
            (steps, p + 1) packed moments and 1 after each step
        """
        total = np.zeros((self.surprises.shape[1],) * 2)
        for probability, surprise in zip(self.probability, self.surprises, strict=True):
            surprised = b @ surprise.T
            total += probability * (surprised.T @ surprised)
        return total

    def jump_variances(self, combination: FloatArray, b: FloatArray) -> FloatArray:
        """(steps,): Var(f(next) - F_k) of one combination (q,) of the forms.

        Parameters
        ----------
        combination
            (q,) of the forms
        b
            (steps, p + 1) packed moments and 1 after each step
        """
        parts = [(b @ (combination @ surprise)) ** 2 for surprise in self.surprises]
        return np.asarray(self.probability @ np.array(parts))


def expected_mean(observation: Observation) -> FloatArray:
    """(d, d) exact mean of E[y(k) y(k)^T] over the run's steps: steady, or transient from the known start.

    A run that was not started from the stationary law is taken as it started, at the x(0) of its record and
    the graph that it logged first: what one draw of g(0) does to a transient is no error.

    Parameters
    ----------
    observation
        of a run in lockstep
    """
    prediction = observation.prediction
    step, system, steady = prediction.step, prediction.system, prediction.steady
    if prediction.experiment.run.start == "stationary":
        law = step.initial
        initial = (law / step.stationary)[:, None, None] * steady
    else:
        law = np.eye(step.modes)[observation.modes[0]]
        y = system.reduced((observation.start - step.reference).T)
        initial = law[:, None, None] * (y.T @ y / len(y))
    return transient_mean(system, steady, initial, law, observation.steps)


def time_means(observation: Observation) -> TimeMeans:
    """Measure a run's second moments and their standard errors.

    Time and memory per step are those of p = d (d + 1) / 2 second moments.

    Parameters
    ----------
    observation
        of a run in lockstep
    """
    system, steps = observation.prediction.system, observation.steps
    p = packed_symmetric.size(system.dimension)
    joint = p <= MAX_JOINT
    forms, nodes, trace = forms_of(system, "joint" if joint else "nodes")

    values = values_of(observation.prediction, forms)
    totals = np.zeros((system.modes, p + 1))
    covariance = np.zeros((len(forms), len(forms)))
    series, variances = np.empty(steps), np.empty(steps)
    for first, last in observation.blocks(max(p, observation.states[0].size)):
        a = np.ones((last + 1 - first, p + 1))
        a[:, :p] = moments(observation, first, last + 1, observation.states)
        series[first:last] = a[:-1, :p] @ (trace @ forms)
        for mode, value in enumerate(values):
            at = np.flatnonzero(observation.modes[first:last] == mode)
            totals[mode] += a[at].sum(axis=0)
            if isinstance(value, Value):
                covariance += value.jumps(a[at])
                variances[first + at] = value.variances(trace, a[at], observation.replicas)
            else:
                b = a[at + 1]
                increments = value.increments(a[at], b)
                covariance += increments.T @ increments + value.jumps(b)
                variances[first + at] = (increments @ trace) ** 2 + value.jump_variances(trace, b)
    for value, total in zip(values, totals, strict=True):
        if isinstance(value, Value):
            covariance += value.spread(total) / observation.replicas
    seen = totals.sum(axis=0)[:p] / steps
    expected = expected_mean(observation)
    return TimeMeans(
        second_moments=packed_symmetric.unpack(seen, system.dimension),
        expected_moments=expected,
        joint=joint,
        measured=forms @ seen,
        predicted=forms @ packed_symmetric.pack(expected),
        covariance=covariance / steps**2,
        squares=0 if system.loss_variance is None else steps,
        nodes=nodes,
        trace=trace,
        system_series=series,
        system_variances=variances,
    )


def values_of(prediction: Prediction, forms: FloatArray) -> list[Value | SharedValue]:
    """One for each graph.

    Parameters
    ----------
    prediction
        of the experiment
    forms
        (q, p) on packed y y^T
    """
    system = prediction.system
    dual = prediction.solver.dual(packed_symmetric.unpack(forms, system.dimension))
    _, kappa = mode_potential(system, dual)
    packed = np.moveaxis(packed_symmetric.pack(dual), 1, 0)
    here = np.concatenate([packed, kappa.T[:, :, None]], axis=2)  # f(y, j) = here[j] @ (s, 1)
    values: list[Value | SharedValue] = []
    for mode, step in enumerate(system.matrices):
        before = step.T @ dual @ step  # (q, n, d, d): the adjoint of what this graph's step does
        if system.loss_variance is not None:
            before += lost_adjoint(system.lift, system.loss_variance[mode], dual)
        constant = packed @ packed_symmetric.pack(system.noise[mode]) + kappa.T
        ahead = np.concatenate([np.moveaxis(packed_symmetric.pack(before), 1, 0), constant[:, :, None]], axis=2)
        law = system.chain[mode]
        expected = np.tensordot(law, ahead, axes=1)
        if system.loss_variance is None:
            values.append(Value(law, ahead - expected, np.moveaxis(dual, 1, 0), step, system.noise[mode]))
        else:
            reached = np.tensordot(law, here, axes=1)
            values.append(SharedValue(law, here - reached, reached, expected))
    return values


def forms_of(
    system: JumpSystem, kind: Literal["joint", "nodes", "system"]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is estimated: all second moments, the node errors, or the system error.

    Parameters
    ----------
    system
        reduced
    kind
        what to estimate

    Returns
    -------
    tuple[FloatArray, FloatArray, FloatArray]
        the forms (q, p) on packed y y^T; the node errors (m, q) as combinations of them, or (0, q) if only the system
        error is estimated; the system error (q,), which is the sum of the node errors
    """
    per_node = packed_symmetric.pack(system.lift[:, :, None] * system.lift[:, None, :])
    if kind == "joint":
        return np.eye(per_node.shape[1]), per_node, per_node.sum(axis=0)
    if kind == "nodes":
        return per_node, np.eye(len(per_node)), np.ones(len(per_node))
    return per_node.sum(axis=0)[None], np.empty((0, 1)), np.ones(1)


def moments(observation: Observation, first: int, last: int, states: FloatArray) -> FloatArray:
    """(last - first, p): packed y y^T of the states first..last-1 of (N + 1, m, R), averaged over the replicas.

    Parameters
    ----------
    observation
        of the run
    first
        step
    last
        step behind the last one
    states
        (N + 1, m, R) of the run
    """
    return packed_moments(states[first:last] - observation.step.reference, observation.prediction.system)


def packed_moments(deviations: FloatArray, system: JumpSystem) -> FloatArray:
    """(b, p): packed y y^T of what the agents are off in some steps, (b, m, R), averaged over the replicas.

    Parameters
    ----------
    deviations
        (b, m, R) from what the states should be
    system
        whose reduced coordinates
    """
    y = np.einsum("kmr,md->krd", deviations, system.lift, optimize=True)
    return packed_symmetric.pack(y.transpose(0, 2, 1) @ y / deviations.shape[2])
