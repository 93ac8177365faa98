# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Time means of a run next to their law given its own path of graphs (docs/statistics.md).

Given the path, and which messages were lost, the reduced states are linear in independent normal numbers:

    y(k+1) = W_k y(k) + noise N_k,    M(k+1) = W_k M(k) W_k^T + N_k,    Y(k) = H + W_k^T Y(k+1) W_k.

M gives the exact expectation of the time mean. For quadratic forms H the dual Y gives E[sum of what is still to come |
y(k)], with martingale increments D. The covariance of their sum is estimated by the sum of

    Cov(D_a, D_b | y(k)) = tr( Y_a N Y_b (2 N + 4 W y y^T W^T) ) / R,

an exact function of the states. Where a few holding times decide the errors (far starts, short runs, rare jumps),
the law over all paths is far from normal; this ratio is not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.common.arrays import SMALL_BLOCK, BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.inference.estimates import Estimate, estimate
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.time_means import TimeMeans, forms_of, moments, without_rounding
from msg_analysis.model.reception import neighbour_tables
from msg_analysis.model.step_model import StepModel
from msg_analysis.theory import packed_symmetric

MAX_WORK = 3e10  # multiplications, at most (seconds); the joint test is left out first, then the node errors

# Numbers in the matrices of all kinds of steps, at most; there are many kinds where many messages are lost
MAX_NUMBERS = 20_000_000


@dataclass(frozen=True, slots=True, eq=False)
class GivenPath:
    """Errors of a run corrected for its path: measured - (expected given the path - expected over all paths)."""

    means: TimeMeans  # over all paths
    given: TimeMeans  # given the path

    @property
    def variance_ratio(self) -> float | None:
        """Variance of the corrected system error over that of the measured one; None where that is 0 or infinite."""
        if self.means.heavy:
            return None
        unconditional = _variance(self.means, self.means.trace)
        return _variance(self.given, self.given.trace) / unconditional if unconditional > 0.0 else None

    @property
    def expected(self) -> float:
        """Exact expectation of the system error given the path."""
        return float(self.given.trace @ self.given.predicted)

    @property
    def system_error(self) -> Estimate:
        """Corrected for the path."""
        return self._corrected(self.given.trace, self.means.trace)

    @property
    def node_errors(self) -> list[Estimate]:
        """Corrected for the path, without ``p_adjusted``; empty where only the system error is estimated."""
        return [self._corrected(one, other) for one, other in zip(self.given.nodes, self.means.nodes, strict=False)]

    def _corrected(self, given: FloatArray, means: FloatArray) -> Estimate:
        """The error that is this combination of the forms of each."""
        predicted = float(means @ self.means.predicted)
        corrected = float(given @ (self.given.measured - self.given.predicted)) + predicted
        scale = float(self.means.trace @ self.means.predicted)
        return estimate(corrected, predicted, math.sqrt(max(_variance(self.given, given), 0.0)), scale)

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "expected": self.expected,
            "system_error": self.system_error.to_json(),
            "node_errors": [node.to_json() for node in self.node_errors],
            "variance_ratio": self.variance_ratio,
        }


def _variance(means: TimeMeans, combination: FloatArray) -> float:
    return float(combination @ means.covariance @ combination)


def means_given_path(
    observation: Observation, *, most_work: float = MAX_WORK, most_numbers: int = MAX_NUMBERS
) -> TimeMeans | None:
    """Time means of a run in lockstep given the path of the graphs; None where that is more than ``most_work``."""
    system, steps = observation.prediction.system, observation.steps
    d = system.dimension
    counts: dict[Literal["joint", "nodes", "system"], int] = {  # of forms; made only where they are used
        "joint": packed_symmetric.size(d),
        "nodes": observation.step.agents,
        "system": 1,
    }
    kind = next((kind for kind, q in counts.items() if steps * d**2 * (q**2 + 5 * q * d) <= most_work), None)
    if kind is None:
        return None
    forms, nodes, trace = forms_of(system, kind)
    kinds = steps_of_path(observation, most_numbers)
    if kinds is None:
        return None
    which, matrices, noise = kinds
    y = system.reduced((observation.start - observation.step.reference).T)
    y = without_rounding(y, system, observation.largest)
    expected = np.zeros((d, d))
    for moment in moments_of_path(which[:-1], matrices, noise, y.T @ y / len(y)):
        expected += moment
    expected /= steps
    seen, covariance, series, variances = _backwards(observation, kinds, forms, trace)
    return TimeMeans.of(
        (forms, nodes, trace), seen / steps, expected, covariance / steps**2, (series, variances), joint=kind == "joint"
    )


def moments_of_path(
    which: IntArray, matrices: FloatArray, noise: FloatArray, start: FloatArray
) -> Iterator[FloatArray]:
    """(d, d): M(0..N) given the path, each in the place of the one before."""
    moment, room = start.copy(), np.empty_like(start)
    steps = [(matrix, matrix.T, added) for matrix, added in zip(matrices, noise, strict=True)]
    for kind in which.tolist():
        yield moment
        matrix, transposed, added = steps[kind]
        matrix.dot(moment, out=room)  # of small matrices half as long as matmul
        room.dot(transposed, out=moment)
        moment += added
    yield moment


def _backwards(
    observation: Observation, kinds: tuple[IntArray, FloatArray, FloatArray], forms: FloatArray, trace: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Sum of packed y y^T (p,), sum of Cov(D | now) (q, q), and of every step the system error and its Var(D | now)."""
    which, matrices, noise = kinds
    steps, q, d = len(which), len(forms), matrices.shape[1]
    lifted = packed_symmetric.unpack(forms, d).transpose(1, 0, 2).copy()
    seen, covariance = np.zeros(forms.shape[1]), np.zeros((q, q))
    series, variances = np.empty(steps), np.zeros(steps)
    length = max(1, min(SMALL_BLOCK, observation.block_numbers) // max(q * d**2, observation.states[0].size))
    dual = lifted  # Y(last + 1) of the block
    for first in reversed(range(0, steps, length)):
        last = min(first + length, steps)
        tell("errors given the path", steps - last, steps)
        found = moments(observation, first, last)
        seen += found.sum(axis=0)
        series[first:last] = found @ (trace @ forms)
        last = min(last, steps - 1)  # the noise of the last step is in no error
        if last <= first:
            continue
        duals = _duals(which[first:last], matrices, lifted, dual)
        dual, duals = duals[0].copy(), duals[1:]
        matrix, added = matrices[which[first:last]], noise[which[first:last]]
        now = packed_symmetric.unpack(found[: last - first], d)
        spread = (2.0 * added + 4.0 * matrix @ now @ matrix.transpose(0, 2, 1)) / observation.replicas
        left = (duals.reshape(-1, d * q, d) @ added).reshape(duals.shape)
        right = (spread @ duals.reshape(-1, d, q * d)).reshape(duals.shape)
        covariance += left.transpose(0, 1, 3, 2).reshape(-1, q).T @ right.transpose(0, 1, 3, 2).reshape(-1, q)
        total = trace @ duals
        variances[first:last] = np.einsum("kij,kij->k", total @ added, spread @ total)
        observation.release()
    return seen, covariance, series, variances


def _duals(which: IntArray, matrices: FloatArray, forms: FloatArray, after: FloatArray) -> FloatArray:
    """(b + 1, d, q, d): Y of b steps and ``after`` the last of them; so a product is one for all forms (d, q, d)."""
    d, q = forms.shape[:2]
    duals = np.empty((len(which) + 1, *forms.shape))
    duals[-1] = after
    flat, room = forms.reshape(-1, d), np.empty((d, q * d))
    moved = room.reshape(-1, d)
    steps = [(matrix.T, matrix) for matrix in matrices]
    later, earlier = duals.reshape(-1, d, q * d)[:0:-1], duals.reshape(-1, d * q, d)[-2::-1]
    for kind, old, new in zip(which[::-1].tolist(), later, earlier, strict=True):
        transposed, matrix = steps[kind]
        transposed.dot(old, out=room)  # of small matrices half as long as matmul
        moved.dot(matrix, out=new)
        new += flat
    return duals


def steps_of_path(
    observation: Observation, most_numbers: int = MAX_NUMBERS
) -> tuple[IntArray, FloatArray, FloatArray] | None:
    """(N,) kind of every step; and of every kind the reduced matrix and noise covariance, (kinds, d, d) each."""
    system, step, lost = observation.prediction.system, observation.step, observation.lost
    if lost is None or not step.loss:
        return observation.modes, system.matrices, system.noise
    found = _kinds(observation, lost, most_numbers // step.agents**2)
    if found is None:
        return None
    which, kinds = found
    lift = system.frame
    matrices, noise = np.empty((2, len(kinds), lift.shape[1], lift.shape[1]))
    for number, (mode, missing) in enumerate(kinds):
        whole = _with_losses(observation, step, mode, missing)
        matrices[number], noise[number] = (lift.T @ each @ lift for each in whole)
    return which, matrices, noise


def _kinds(observation: Observation, lost: BoolArray, most: int) -> tuple[IntArray, list[tuple[int, BoolArray]]] | None:
    """(N,) kind of every step; and of every kind the graph and the lost messages (m, D). None: more than ``most``."""
    numbers: dict[bytes, int] = {}
    which = np.empty(observation.steps, dtype=np.int64)
    for first, last in observation.blocks(lost[:1].size, "kinds of steps"):
        bits = np.packbits(lost[first:last].reshape(last - first, -1), axis=1)
        modes = observation.modes[first:last].astype(">u4").view(np.uint8).reshape(last - first, 4)
        rows, here = np.unique(np.concatenate([modes, bits], axis=1), axis=0, return_inverse=True)
        which[first:last] = np.array([numbers.setdefault(row.tobytes(), len(numbers)) for row in rows])[
            here.reshape(-1)
        ]
        if len(numbers) > most:
            return None
    keys = sorted(numbers)
    places = np.empty(len(keys), dtype=np.int64)
    places[[numbers[key] for key in keys]] = np.arange(len(keys))
    kinds = []
    for key in keys:
        missing = np.unpackbits(np.frombuffer(key[4:], np.uint8), count=lost[0].size).astype(np.bool_)
        kinds.append((int.from_bytes(key[:4], "big"), missing.reshape(lost.shape[1:])))
    return places[which], kinds


def _with_losses(
    observation: Observation, step: StepModel, mode: int, lost: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """W and N (m, m) of a step under a graph in which these messages (m, D) are lost."""
    tables, reception = neighbour_tables(step), observation.prediction.experiment.noise
    weights = step.nominal[mode].copy()
    for i, missing in enumerate(lost):
        count = tables.count[mode, i]
        for j in tables.senders[mode, i, :count][missing[:count]].tolist():
            weights[i, i] += weights[i, j]
            weights[i, j] = 0.0
    coupling = weights - np.diag(np.diag(weights))
    noise = step.noise_gain[mode] @ step.noise_gain[mode].T + reception.broadcast**2 * coupling @ coupling.T
    return weights, noise + reception.link**2 * np.diag((coupling**2).sum(axis=1))
