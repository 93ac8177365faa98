# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Autocovariance and power spectral density of the errors in the steady state, exact. Discrete time.

With q_i(l) = E[y(k + l) y(k)^T; g(k + l) = i] and W_i the mean over losses (Costa, Fragoso and Marques, Discrete-Time
Markov Jump Linear Systems, 2005, section 3.4: the operator of first moments B),

    q_j(l + 1) = sum_i P_ij W_i q_i(l),    q_i(0) = C_i,    R(l) = sum_i q_i(l),

so R(l) = S B^l q(0) with S the sum over the graphs, and the density needs no sum over lags:

    sum_l R(l) exp(-i w l) = G(w) + G(w)^* - R(0),    G(w) = S (1 - exp(-i w) B)^-1 q(0)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.text import markdown_table, number_text
from msg_analysis.errors import InputError
from msg_analysis.theory.jump_system import JumpSystem, continuous
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SIZE = 600  # graphs times coordinates, of the resolvent
FADED = 0.01  # of the autocovariance at lag 0: where the default lags end
MAX_LAG = 100_000
SHOWN_LAGS = 200
SHOWN_FREQUENCIES = 200


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Spectrum:
    """Predicted autocovariance and spectral density of the errors e of a run, in the steady state.

    Attributes
    ----------
    prediction
        of the experiment
    lags
        (L,) ascending, from 0 [steps]
    covariances
        (L, m, m) E[e(k + l) e(k)^T]: of the disagreement of the agents with their mean, or of their distance from the
        reference
    frequencies
        (F,) ascending [cycles per unit of simulated time]
    node_densities
        (F, m) one-sided spectral density of each agent: its integral from 0 to 1 / (2 dt) is the node error
    """

    prediction: Prediction
    lags: IntArray
    covariances: FloatArray
    frequencies: FloatArray
    node_densities: FloatArray
    period: float | None = None  # of one lag, and of the samples; None: run.dt

    def __repr__(self) -> str:
        last = number_text(float(self.times[-1]))
        return f"<Spectrum of {self.prediction.experiment.name!r}: {len(self.lags)} lags up to {last}>"

    def _repr_markdown_(self) -> str:
        shown = np.unique(np.linspace(0, len(self.lags) - 1, 11).round().astype(int)).tolist()
        covariance = self.system_autocovariance
        rows = [(number_text(float(self.times[i])), number_text(float(covariance[i]))) for i in shown]
        return markdown_table(("lag", "autocovariance of the system"), rows)

    @property
    def times(self) -> FloatArray:
        """(L,) the lags [units of simulated time]."""
        return np.asarray(self.lags * (self.period or self.prediction.step.dt), dtype=float)

    @property
    def node_autocovariances(self) -> FloatArray:
        """(L, m) of each agent; at lag 0 its node error."""
        return np.asarray(np.diagonal(self.covariances, axis1=1, axis2=2))

    @property
    def system_autocovariance(self) -> FloatArray:
        """(L,) E[e(k + l) . e(k)], the sum over the agents; at lag 0 the system error."""
        return np.asarray(self.node_autocovariances.sum(axis=1))

    @property
    def system_density(self) -> FloatArray:
        """(F,) the sum over the agents; its integral from 0 to 1 / (2 dt) is the system error."""
        return np.asarray(self.node_densities.sum(axis=1))

    def plot(self) -> Figure:
        """Draw the autocovariance over the lag, and the density over the frequency.

        Returns
        -------
        matplotlib.figure.Figure
            notebooks show it; ``figure.savefig("spectrum.png")`` writes it
        """
        from msg_analysis.report.figures import spectrum_figure

        return spectrum_figure(self)

    @property
    def system_error(self) -> float:
        """Predicted."""
        if self.period is None:
            return self.prediction.emulated.system_error
        return float(self.system_autocovariance[0])

    def to_json(self) -> dict[str, Any]:
        """The keys of ``msg-analysis spectrum --json`` that are predicted."""
        experiment = self.prediction.experiment
        return {
            "experiment": experiment.name,
            "names": experiment.names,
            "system_error": self.system_error,
            "lags": self.times.tolist(),
            "system_autocovariance": self.system_autocovariance.tolist(),
            "node_autocovariances": self.node_autocovariances.tolist(),
            "frequencies": self.frequencies.tolist(),
            "system_density": self.system_density.tolist(),
            "node_densities": self.node_densities.tolist(),
        }


def spectrum(
    prediction: Prediction,
    lags: IntArray | None = None,
    frequencies: FloatArray | None = None,
    *,
    most_unknowns: int = MAX_SIZE,
) -> Spectrum:
    """The spectrum of a prediction: arguments and errors as in ``Experiment.spectrum``."""
    system, dt = prediction.system, prediction.step.dt
    if lags is not None and (not len(lags) or lags[0] < 0 or (np.diff(lags) <= 0).any()):
        raise InputError("lags: expected ascending whole numbers of steps, not below 0")
    chosen = _fading_lags(system, prediction.steady) if lags is None else np.asarray(lags)
    nyquist = 0.5 / dt
    if frequencies is None:
        lowest = 0.05 / (dt * max(int(chosen[-1]), 10))
        frequencies = np.minimum(np.geomspace(lowest, nyquist, SHOWN_FREQUENCIES), nyquist)
    frequencies = np.asarray(frequencies, dtype=float)
    if not ((frequencies >= 0.0) & (frequencies <= nyquist * (1.0 + 1e-12))).all() or (np.diff(frequencies) < 0).any():
        raise InputError(f"frequencies: expected ascending numbers from 0 to 1 / (2 dt) = {nyquist:g}")
    return Spectrum(
        prediction,
        chosen,
        _covariances(system, prediction.steady, chosen),
        frequencies,
        2.0 * dt * _densities(system, prediction.steady, 2.0 * np.pi * dt * frequencies, most_unknowns),
    )


def sampled_spectrum(prediction: Prediction, law: str, period: float) -> Spectrum:
    """Of samples at equal intervals [units of simulated time] of the "continuous" law, or of the "steps" of a run.

    As above, with exp(A period) in the place of B, where (A q)_j = -Z_j q_j + sum_i Gamma_ij q_i, or with B^period/dt.
    """
    system, steady = prediction.system, prediction.steady
    if law == "continuous":
        system = continuous(prediction.experiment)
        steady = MomentSolver(system).steady()
        drift = scipy.linalg.block_diag(*(-matrix for matrix in system.matrices))
        operator = scipy.linalg.expm((drift + np.kron(system.chain.T, np.eye(system.dimension))) * period)
    else:
        operator = np.linalg.matrix_power(_operator(system), round(period / prediction.step.dt))
    shape = steady.shape
    moments, found = steady.reshape(-1, shape[2]), list[FloatArray]()
    error = float(np.trace(system.lifted(steady.sum(axis=0))))
    while len(found) < 2 or (len(found) < SHOWN_LAGS and np.trace(found[-1]) > FADED * error):
        found.append(system.lifted(moments.reshape(shape).sum(axis=0)))
        moments = operator @ moments
    nyquist = 0.5 / period
    frequencies = np.minimum(np.geomspace(0.05 / (period * max(len(found), 10)), nyquist, SHOWN_FREQUENCIES), nyquist)
    densities = _densities(system, steady, 2.0 * np.pi * period * frequencies, MAX_SIZE, operator)
    return Spectrum(
        prediction, np.arange(len(found)), np.stack(found), frequencies, 2.0 * period * densities, period=period
    )


def _ahead(system: JumpSystem, moments: FloatArray) -> FloatArray:
    """(n, d, a): q(l + 1) from q(l) (n, d, a)."""
    moved = system.matrices @ moments
    return np.asarray((system.chain.T @ moved.reshape(len(moved), -1)).reshape(moved.shape))


def _fading_lags(system: JumpSystem, steady: FloatArray) -> IntArray:
    moments, weights = steady, system.output.T @ system.output
    start = float((weights * steady.sum(axis=0)).sum())
    last = 1
    for lag in range(1, MAX_LAG + 1):
        moments = _ahead(system, moments)
        if abs(float((weights * moments.sum(axis=0)).sum())) > FADED * start:
            last = lag
        elif lag >= 2 * last:
            break
    return np.unique(np.linspace(0, last, SHOWN_LAGS).round().astype(np.int64))


def _covariances(system: JumpSystem, steady: FloatArray, lags: IntArray) -> FloatArray:
    """(L, m, m) of the agents."""
    found, moments, lag = [], steady, 0
    for wanted in lags.tolist():
        while lag < wanted:
            moments, lag = _ahead(system, moments), lag + 1
        found.append(system.lifted(moments.sum(axis=0)))
    return np.stack(found)


def _operator(system: JumpSystem) -> FloatArray:
    """(n d, n d): B."""
    n, d = system.modes, system.dimension
    blocks = system.chain.T[:, None, :, None] * system.matrices.transpose(1, 0, 2)
    return np.asarray(blocks.reshape(n * d, n * d))


def _densities(
    system: JumpSystem,
    steady: FloatArray,
    angles: FloatArray,
    most_unknowns: int,
    operator: FloatArray | None = None,
) -> FloatArray:
    """(F, m): sum over all lags of R(l) exp(-i w l) of every agent, for angles w (F,) per step."""
    n, d = system.modes, system.dimension
    if n * d > most_unknowns:
        raise InputError(
            f"spectrum: {n} graphs or states of the network and {d} coordinates make {n * d} unknowns; at most "
            f"{most_unknowns} are computed: use fewer agents or graphs"
        )
    output = system.output
    if not d:
        return np.zeros((len(angles), len(output)))
    operator = _operator(system) if operator is None else operator
    triangle, vectors = scipy.linalg.schur(operator.astype(complex), output="complex")
    right = vectors.conj().T @ (steady @ output.T).reshape(n * d, -1)  # (n d, m)
    left = np.tile(output, (1, n)) @ vectors  # (m, n d)
    variance = np.diagonal(system.lifted(steady.sum(axis=0)))
    eye = np.eye(n * d)
    found = np.empty((len(angles), len(output)))
    for place, angle in enumerate(angles.tolist()):
        solved = scipy.linalg.solve_triangular(eye - np.exp(-1j * angle) * triangle, right)
        found[place] = 2.0 * np.einsum("ia,ai->i", left, solved).real - variance
    return np.maximum(found, 0.0)
