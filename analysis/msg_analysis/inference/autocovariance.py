# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Autocovariance of the errors of a run next to its law given the path of the graphs and the lost messages.

Given the path, y(k + 1) = W_k y(k) + w_k with independent w_k ~ N(0, N_k) (``given_path``), and the errors are e = C y
(C^T C = I without a delay). For lag l let Phi_k = W_k+l-1 ... W_k, so that sum_k e(k)^T e(k + l) has the expectation
sum_k tr(H_k M(k)), H_k the symmetric part of C^T C Phi_k. With Y(j) = H_j + W_j^T Y(j + 1) W_j and a_j = sum over
j - l < k <= j of (W_k+l-1 ... W_j+1)^T C^T C y(k), the sum minus its expectation is the sum of martingale differences

    D_j = w_j^T Y(j + 1) w_j - tr(Y(j + 1) N_j) + b_j^T w_j,    b_j = 2 Y(j + 1) W_j y(j) + a_j

with Cov(D_j of lag l, of lag l' | past) = 2 tr(Y N Y' N) + b^T N b': for any correlation in time, and exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.arrays import SMALL_BLOCK, FloatArray, IntArray
from msg_analysis.common.text import HALF_WIDTH_95
from msg_analysis.inference.given_path import moments_of_path, steps_of_path
from msg_analysis.inference.observation import Observation, deviations
from msg_analysis.inference.statistics import chi2_tail, quadratic_form
from msg_analysis.inference.time_means import without_rounding
from msg_analysis.theory.spectrum import Spectrum, spectrum

MOST_NUMBERS = 2e7  # in the matrices of all lags and steps: of longer runs the beginning is tested
LAGS = 8  # that are tested, beside lag 0
CORRELATED = 0.05  # the longest one still has this share of the variance
LEAST_STEPS = 100
MOST_WINDOW = 4096  # steps, of Welch's method


@dataclass(frozen=True, slots=True, eq=False)
class LoggedAutocovariance:
    """Measured autocovariances of the system error, R(l) = E[e(k + l) . e(k)], and their test."""

    steps: int  # that were used, from the beginning of the run; with a delay and noisy messages, from step d + 1 on
    times: FloatArray  # (L,) lags [units of simulated time]
    predicted: FloatArray  # (L,)
    measured: FloatArray  # (L,)
    expected: FloatArray  # (L,) given the path
    covariance: FloatArray  # (L, L) of measured, given the path
    p: float | None  # of all lags together; None without noise

    @property
    def corrected(self) -> FloatArray:
        """(L,): measured - (expected given the path - predicted): without what the path should have changed."""
        return np.asarray(self.measured - self.expected + self.predicted)

    @property
    def standard_errors(self) -> FloatArray:
        """(L,) of ``corrected``: given the path."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance).clip(0.0)))

    def to_json(self) -> dict[str, Any]:
        """The key ``log`` of ``msg-analysis spectrum --json``."""
        errors, corrected = self.standard_errors, self.corrected
        z = np.divide(corrected - self.predicted, errors, out=np.full_like(errors, np.nan), where=errors > 0.0)
        half = HALF_WIDTH_95 * errors
        return {
            "steps": self.steps,
            "lags": self.times.tolist(),
            "predicted": self.predicted.tolist(),
            "measured": self.measured.tolist(),
            "expected": self.expected.tolist(),
            "corrected": corrected.tolist(),
            "standard_errors": errors.tolist(),
            "intervals": np.column_stack([corrected - half, corrected + half]).tolist(),
            "z": z.tolist(),
            "p": self.p,
        }


@dataclass(frozen=True, slots=True, eq=False)
class LoggedDensity:
    """Spectral density of a run by Welch's method; its standard error is not known, so it is not tested."""

    frequencies: FloatArray  # (F,) [cycles per unit of simulated time]
    system: FloatArray  # (F,) one-sided, sum over the agents, mean over the replicas

    @classmethod
    def of(cls, observation: Observation) -> LoggedDensity:
        """Mean over windows of a sixteenth of the run, which overlap by a half."""
        from scipy.signal import welch  # here, since it takes long to import

        found = deviations(observation.states, observation.prediction.experiment)
        window = min(max(8, min(len(found) // 16, MOST_WINDOW)), len(found))
        frequencies, found = welch(found, fs=1.0 / observation.step.dt, nperseg=window, detrend=False, axis=0)
        return cls(frequencies, found.sum(axis=1).mean(axis=1))


def why_not_tested(observation: Observation) -> str | None:
    """Why the law given the path does not cover a run; None where it does."""
    if observation.prediction.experiment.run.pace == "realtime":
        return "in real time agents use values of different steps"
    if observation.prediction.system.messages is not None:
        return "agents keep values from step to step"
    if observation.step.delay and observation.step.loss:
        return "messages are lost and come later"
    if (steps := observation.steps - _first_step(observation)) < LEAST_STEPS:
        return f"{steps} steps are too few: at least {LEAST_STEPS} are needed"
    return None


def _first_step(observation: Observation) -> int:
    """The first step whose noise is new: until step d, the message with x(0) is used again, with the same noise."""
    noise = observation.prediction.experiment.noise
    return noise.delay + 1 if noise.delay and noise.on_air else 0


def logged_autocovariance(
    observation: Observation, lags: IntArray | None = None, most_numbers: float = MOST_NUMBERS
) -> LoggedAutocovariance | None:
    """Autocovariances of a run in lockstep, with their expectation and covariance given its path.

    ``lags``: (L,) ascending, >= 0 [steps]; None: 0 and up to 8 more, to where 5 % of the correlation is left.
    ``most_numbers`` in the matrices of all lags and steps: of longer runs the beginning is tested. None where the
    losses make too many kinds of steps.
    """
    kinds = steps_of_path(observation)
    if kinds is None:
        return None
    system, replicas = observation.prediction.system, observation.replicas
    chosen = _chosen_lags(observation) if lags is None else np.asarray(lags)
    d = system.dimension
    first = _first_step(observation)
    steps = min(observation.steps - first, int(most_numbers / max(1, len(chosen) * d * max(d, replicas))))
    chosen = chosen[chosen < steps]
    kinds = kinds[0][first : first + steps], kinds[1], kinds[2]
    y, product = _coordinates(observation, first, steps)
    measured, expected, covariance, p = autocovariances(kinds, y, product, chosen)
    found: Spectrum = spectrum(observation.prediction, chosen, np.empty(0))
    return LoggedAutocovariance(
        steps=steps,
        times=found.times,
        predicted=found.system_autocovariance,
        measured=measured,
        expected=expected,
        covariance=covariance,
        p=p,
    )


def autocovariances(
    kinds: tuple[IntArray, FloatArray, FloatArray], y: FloatArray, product: FloatArray | None, chosen: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, float | None]:
    """(L,) measured, (L,) expected given the path, (L, L) their covariance, and the p-value of all lags.

    ``kinds``: of N steps, see ``steps_of_path``; ``y``: (N + 1, R, d); ``product``: C^T C, None: I; ``chosen``: (L,)
    lags below N.
    """
    which, matrices, noise = kinds
    steps, (replicas, d) = len(which), y.shape[1:]
    seen = y if product is None else y @ product
    along = matrices[which]  # (N, d, d) W_k
    forms = np.zeros((steps + 1, d, len(chosen), d))
    left = np.zeros((len(chosen), steps, replicas, d))  # (W_k+l-1 ... W_k+1)^T C^T C y(k), what leaves a_j with k
    measured, counts = np.empty(len(chosen)), steps + 1 - chosen
    for place, lag in enumerate(chosen.tolist()):
        if lag:
            window = _windows(along[1:], lag - 1)  # from k + 1 on
            left[place, : len(window)] = seen[: len(window)] @ window
            window = window @ along[: len(window)]
        else:
            window = np.broadcast_to(np.eye(d), (steps + 1, d, d))
        form = window if product is None else product @ window
        forms[: len(window), :, place] = (form + form.transpose(0, 2, 1)) / 2.0
        measured[place] = (seen[: len(window)] * y[lag:]).sum() / replicas
    moments = np.empty((steps + 1, d, d))
    for kept, moment in zip(moments, moments_of_path(which, matrices, noise, y[0].T @ y[0] / replicas), strict=True):
        kept[:] = moment
    expected = np.einsum("kalb,kab->l", forms, moments)
    felt = np.zeros_like(left)  # a_j + 1: at first what enters it
    for place, lag in enumerate(chosen.tolist()):
        if lag:
            felt[place, lag - 1 :] = seen[: steps - lag + 1]
    covariance = _covariance(kinds, y, forms, felt, left)
    chi2, dof = quadratic_form(measured - expected, covariance)
    p = float(chi2_tail(chi2, dof)) if dof else None
    return measured / counts, expected / counts, covariance / np.outer(counts, counts), p


def _coordinates(observation: Observation, first: int, steps: int) -> tuple[FloatArray, FloatArray | None]:
    """(N + 1, R, d) y from a step on, and (d, d) C^T C of the errors e = C y; None where that is the identity."""
    system, delay = observation.prediction.system, observation.step.delay
    away = observation.states[: first + steps + 1] - observation.step.reference
    times = np.arange(first, first + steps + 1)[:, None] - np.arange(delay + 1)
    stacked = away[np.maximum(times, 0)]  # (N + 1, delay + 1, m, R): what was before the start is as the start
    y = np.einsum("ksr,sd->krd", stacked.reshape(steps + 1, -1, observation.replicas), system.lift)
    product = None if system.readout is None else system.readout.T @ system.readout
    return without_rounding(y, system, observation.largest), product


def _chosen_lags(observation: Observation) -> IntArray:
    """0 and up to ``LAGS`` more, equally spaced on a logarithmic axis."""
    found = spectrum(observation.prediction, frequencies=np.empty(0))
    return lags_of(found, observation.steps)


def lags_of(found: Spectrum, steps: int) -> IntArray:
    """As ``_chosen_lags``, of a predicted spectrum."""
    course = found.system_autocovariance
    last = int(found.lags[np.flatnonzero(np.abs(course) >= CORRELATED * course[0])[-1]]) if course[0] > 0.0 else 1
    last = max(1, min(last, steps // 10))
    return np.unique(np.concatenate([[0], np.geomspace(1, last, LAGS).round().astype(np.int64)]))


def _windows(along: FloatArray, lag: int) -> FloatArray:
    """(N - lag + 1, d, d): W_k+lag-1 ... W_k for every k, by products within blocks of so many steps."""
    steps, d = along.shape[:2]
    if lag == 0:
        return np.broadcast_to(np.eye(d), (steps + 1, d, d))
    blocks = -(-steps // lag) + 1
    padded = np.broadcast_to(np.eye(d), (blocks * lag, d, d)).copy()
    padded[:steps] = along
    parts = padded.reshape(blocks, lag, d, d)
    early, late = np.empty_like(parts), np.empty_like(parts)  # products before and from each place of a block
    early[:, 0], late[:, -1] = np.eye(d), parts[:, -1]
    for place in range(1, lag):
        early[:, place] = parts[:, place - 1] @ early[:, place - 1]
        late[:, -1 - place] = late[:, -place] @ parts[:, -1 - place]
    products = (early[1:] @ late[:-1]).reshape(-1, d, d)
    return np.asarray(products[: steps - lag + 1])


def _covariance(
    kinds: tuple[IntArray, FloatArray, FloatArray], y: FloatArray, forms: FloatArray, felt: FloatArray, left: FloatArray
) -> FloatArray:
    """(L, L): sum of Cov(D_j | past), from H (``forms``), what enters a_j (``felt``) and leaves it (``left``)."""
    # The first two are overwritten. In H (N + 1, d, L, d) the lags are an inner axis: one product is for all of them.
    which, matrices, noise = kinds
    number, steps, replicas, d = felt.shape
    duals, columns = forms.reshape(-1, d * number, d), forms.reshape(-1, d, number * d)
    wide, room, rest = np.empty(columns.shape[1:]), np.empty(duals.shape[1:]), np.empty((number, replicas, d))
    tall, flat = wide.reshape(-1, d), rest.reshape(-1, d)
    transposed = [matrix.T for matrix in matrices]
    kinds_of_steps = which.tolist()
    for j in range(steps - 2, -1, -1):
        kind = kinds_of_steps[j + 1]
        matrix = matrices[kind]
        np.subtract(felt[:, j + 1], left[:, j + 1], out=rest)
        felt[:, j] += flat.dot(matrix).reshape(rest.shape)
        transposed[kind].dot(columns[j + 2], out=wide)
        tall.dot(matrix, out=room)
        duals[j + 1] += room  # now Y(j + 1)
    total = np.zeros((number, number))
    length = max(1, SMALL_BLOCK // max(forms[0].size, felt[:, 0].size))
    for first in range(0, steps, length):
        part = slice(first, min(first + length, steps))
        later = slice(part.start + 1, part.stop + 1)
        added, along = noise[which[part]], matrices[which[part]]
        spread = (duals[later] @ added).reshape(-1, d, number, d)
        total += 2.0 / replicas * (_rows(spread.transpose(2, 0, 1, 3)) @ _rows(spread.transpose(2, 0, 3, 1)).T)
        slope = (2.0 * y[part] @ along.transpose(0, 2, 1)) @ forms[later].transpose(2, 0, 1, 3)
        slope += felt[:, part]
        total += _rows(slope @ added) @ _rows(slope).T / replicas**2
    return (total + total.T) / 2.0


def _rows(array: FloatArray) -> FloatArray:
    """All numbers of each lag in a row."""
    return array.reshape(len(array), -1)
