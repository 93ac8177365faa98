"""The errors of a run beside what its own path of graphs leads to expect: a control variate for slow switching.

Given the path (and, where messages are lost, given which ones), the states are a linear function of independent normal
numbers from a known start. So the expectation of the time mean follows from the recursion

    M(k+1) = W_k M(k) W_k^T + N_k,      Y(k) = H + W_k^T Y(k+1) W_k   (what is still to come, backwards)

exactly, and its variance is the sum of tr( Y N Y (4 M - 2 N) ) / R, since replicas are independent given the path. The
expectation given the path is itself random, and its mean is the prediction: measured less (expected given the path less
predicted) has the mean of the measured error without the part of its variance that is due to the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.inference.errors.estimates import Estimate, estimate
from msg_analysis.inference.errors.time_means import MAX_JOINT, TimeMeans, forms_of
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.types import FloatArray, IntArray

MAX_NUMBERS = 20_000_000
"""Most numbers in the matrices of all kinds of steps; many, where many messages can be lost."""


@dataclass(frozen=True, slots=True, eq=False)
class GivenPath:
    """Node errors, with what is expected of them given the path of the graphs.

    Attributes
    ----------
    measured
        (m,) time means over the run
    expected
        (m,) their exact expectation given the path
    predicted
        (m,) their expectation over all paths
    covariance
        (m, m) of measured - expected
    unconditional
        variance of the measured system error over all paths
    """

    measured: FloatArray
    expected: FloatArray
    predicted: FloatArray
    covariance: FloatArray
    unconditional: float

    @property
    def variance_ratio(self) -> float | None:
        """Variance of the corrected system error over that of the measured one; None without noise."""
        return float(self.covariance.sum() / self.unconditional) if self.unconditional > 0.0 else None

    @property
    def system_error(self) -> Estimate:
        """Corrected for the path."""
        corrected = self.measured - self.expected + self.predicted
        error = math.sqrt(max(float(self.covariance.sum()), 0.0))
        return estimate(float(corrected.sum()), float(self.predicted.sum()), error, float(self.predicted.sum()))

    @property
    def node_errors(self) -> list[Estimate]:
        """Corrected for the path."""
        corrected, scale = self.measured - self.expected + self.predicted, float(self.predicted.sum())
        errors = np.sqrt(np.diag(self.covariance).clip(0.0))
        numbers = zip(corrected, self.predicted, errors, strict=True)
        return [estimate(float(c), float(p), float(e), scale) for c, p, e in numbers]

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return {
            "expected": float(self.expected.sum()),
            "system_error": self.system_error.to_json(),
            "node_errors": [node.to_json() for node in self.node_errors],
            "variance_ratio": self.variance_ratio,
        }


def given_path(observation: Observation, means: TimeMeans) -> GivenPath | None:
    """Errors of a run in lockstep given its path; None where it would take long (over 20 agents).

    Parameters
    ----------
    observation
        of the run
    means
        its time means over all paths
    """
    system, steps = observation.prediction.system, observation.steps
    if packed_symmetric.size(system.dimension) > MAX_JOINT or not means.joint or observation.timers:
        return None
    forms, _, _ = forms_of(system, "nodes")
    which, matrices, noise = _steps(observation)
    if len(matrices) * packed_symmetric.size(system.dimension) ** 2 > MAX_NUMBERS:
        return None
    y = system.reduced((observation.start - observation.step.reference).T)
    start = packed_symmetric.pack(y.T @ y / len(y))
    total, covariance = _follow(which, matrices, noise, start, forms)
    return GivenPath(
        measured=means.nodes @ means.measured,
        expected=forms @ total / steps,
        predicted=means.nodes @ means.predicted,
        covariance=covariance / (observation.replicas * steps**2),
        unconditional=float(means.trace @ means.covariance @ means.trace),
    )


def _follow(
    which: IntArray, matrices: FloatArray, noise: FloatArray, start: FloatArray, forms: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sum of the packed M(0..N-1) (p,), and the sum of Cov(D) (q, q) of one replica.

    In blocks: M is computed again from the beginning of a block when the Y come by.
    """
    steps, d, q = len(which), matrices.shape[1], len(forms)
    ahead = np.array([packed_symmetric.product(matrix, matrix) for matrix in matrices])
    added = packed_symmetric.pack(noise)
    kinds = which.tolist()
    length = max(1, math.isqrt(steps))
    moment, total, beginnings = start, np.zeros(len(start)), []
    for k, kind in enumerate(kinds):
        if k % length == 0:
            beginnings.append(moment)
        total += moment
        moment = ahead[kind] @ moment + added[kind]
    covariance = np.zeros((q, q))
    dual = forms  # Y(last)
    for block in reversed(range(len(beginnings))):
        first, last = block * length, min((block + 1) * length, steps - 1)  # noise of the last step shows in no error
        if last <= first:
            continue
        moments, duals = np.empty((last - first, len(start))), np.empty((last - first, *forms.shape))
        moment = beginnings[block]
        for k in range(first, last):
            moments[k - first] = moment = ahead[kinds[k]] @ moment + added[kinds[k]]
        for k in range(last - 1, first - 1, -1):
            duals[k - first] = dual
            dual = forms + dual @ ahead[kinds[k]]
        n = noise[which[first:last]]
        y, seen = packed_symmetric.unpack(duals, d), 4.0 * packed_symmetric.unpack(moments, d) - 2.0 * n
        left = (y @ n[:, None]).transpose(1, 0, 2, 3).reshape(q, -1)
        right = (seen[:, None] @ y).transpose(1, 0, 2, 3).reshape(q, -1)
        covariance += left @ right.T
    return total, covariance


def _steps(observation: Observation) -> tuple[IntArray, FloatArray, FloatArray]:
    """(N,) kind of every step, and of every kind the reduced matrix (d, d) and covariance of its noise (d, d)."""
    system, step, lost = observation.prediction.system, observation.step, observation.lost
    if lost is None or not step.loss:
        return observation.modes, system.matrices, system.noise
    keys = np.column_stack([observation.modes, lost.reshape(len(lost), -1)])
    kinds, which = np.unique(keys, axis=0, return_inverse=True)
    matrices, noise = np.empty((2, len(kinds), step.agents, step.agents))
    for number, kind in enumerate(kinds):
        matrices[number], noise[number] = _with_losses(observation, step, int(kind[0]), kind[1:])
    lift = system.lift
    return which.reshape(-1), lift.T @ matrices @ lift, lift.T @ noise @ lift


def _with_losses(observation: Observation, step: StepModel, mode: int, lost: IntArray) -> tuple[FloatArray, FloatArray]:
    """W and N (m, m) of a step under a graph in which these messages (m D,) are lost."""
    tables, air = neighbour_tables(step), observation.prediction.experiment.noise
    weights = step.nominal[mode].copy()
    for i, missing in enumerate(lost.reshape(step.agents, -1).astype(np.bool_)):
        count = tables.count[mode, i]
        for j in tables.senders[mode, i, :count][missing[:count]].tolist():
            weights[i, i] += weights[i, j]
            weights[i, j] = 0.0
    coupling = weights - np.diag(np.diag(weights))
    noise = step.noise_gain[mode] @ step.noise_gain[mode].T + air.broadcast**2 * coupling @ coupling.T
    return weights, noise + air.link**2 * np.diag((coupling**2).sum(axis=1))
