"""Errors of a run given its own path of graphs: a control variate for slow switching (docs/statistics.md).

Given the path (and which messages were lost), the states are linear in independent normal numbers. The expectation of
the time mean follows exactly from M(k+1) = W_k M(k) W_k^T + N_k, and with Y(k) = H + W_k^T Y(k+1) W_k (backwards) its
variance is the sum of tr( Y N Y (4 M - 2 N) ) / R: replicas are independent given the path. So measured - (expected
given the path - predicted) has the right mean, without the part of the variance that is due to the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.inference.errors.estimates import Estimate, estimate
from msg_analysis.inference.errors.time_means import MAX_JOINT, TimeMeans, forms_of, without_rounding
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.types import FloatArray, IntArray

# Numbers in the matrices of all kinds of steps, at most; there are many kinds where many messages are lost
MAX_NUMBERS = 20_000_000


@dataclass(frozen=True, slots=True, eq=False)
class GivenPath:
    """Node errors, and their expectation given the path of the graphs."""

    measured: FloatArray  # (m,) time means over the run
    expected: FloatArray  # (m,) their exact expectation given the path
    predicted: FloatArray  # (m,) their expectation over all paths
    covariance: FloatArray  # (m, m) of measured - expected
    unconditional: float  # variance of the measured system error over all paths

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
        """Corrected for the path; without ``p_holm``."""
        corrected, scale = self.measured - self.expected + self.predicted, float(self.predicted.sum())
        errors = np.sqrt(np.diag(self.covariance).clip(0.0))
        numbers = zip(corrected, self.predicted, errors, strict=True)
        return [estimate(float(c), float(p), float(e), scale) for c, p, e in numbers]

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "expected": float(self.expected.sum()),
            "system_error": self.system_error.to_json(),
            "node_errors": [node.to_json() for node in self.node_errors],
            "variance_ratio": self.variance_ratio,
        }


def given_path(observation: Observation, means: TimeMeans) -> GivenPath | None:
    """Errors of a run given its path of graphs, by the recursions of this module; ``means`` are those over all paths.

    None in real time, and where it would take long: over ``MAX_JOINT`` second moments, or too many kinds of steps.
    """
    system, steps = observation.prediction.system, observation.steps
    if packed_symmetric.size(system.dimension) > MAX_JOINT or not means.joint or observation.timers:
        return None
    forms, _, _ = forms_of(system, "nodes")
    which, matrices, noise = _steps(observation)
    if len(matrices) * packed_symmetric.size(system.dimension) ** 2 > MAX_NUMBERS:
        return None
    y = system.reduced((observation.start - observation.step.reference).T)
    y = without_rounding(y, system, observation.largest)
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

    Works in blocks: going backwards, the M of a block are computed again from its beginning.
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
        first, last = block * length, min((block + 1) * length, steps - 1)  # the noise of the last step is in no error
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
    """(N,) kind of every step; and of every kind the reduced matrix and noise covariance, (kinds, d, d) each."""
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
