# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Autocovariance of a log of any origin next to its law: that of the states as the filter of the log has them.

The filtered states move by x(k+1) = Phi_k x(k) + w_k with independent w_k ~ N(0, G_k), as the states of a run given its
path (``autocovariance``); what the log does not tell of the states adds the same to measured and expected numbers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError
from msg_analysis.inference.autocovariance import (
    LEAST_STEPS,
    MOST_NUMBERS,
    MOST_WINDOW,
    LoggedAutocovariance,
    LoggedDensity,
    autocovariances,
    lags_of,
)
from msg_analysis.inference.innovations import Filter
from msg_analysis.inference.intervals import interval_law
from msg_analysis.inference.log_verdict import measurement_noise
from msg_analysis.model.log import Log
from msg_analysis.theory.jump_system import continuous
from msg_analysis.theory.spectrum import Spectrum, sampled_spectrum

OFF_GRID = 0.1  # of the interval: how far a sample may be from equal intervals


def log_spectrum(log: Log) -> tuple[Spectrum, LoggedAutocovariance | None, LoggedDensity | None, str | None]:
    """Predicted, measured, and why the log is not tested. InputError: its samples are not at equal intervals."""
    law, prediction = interval_law(log.law, log.sampled_law), log.law.predict()
    log, period = _on_grid(log)
    found = sampled_spectrum(prediction, log.sampled_law, period)
    density = None
    if not np.isnan(log.states).any():
        density = _density(log, period)
    if log.hidden or len(log.times) <= LEAST_STEPS:
        few = f"{len(log.times) - 1} intervals are too few: at least {LEAST_STEPS} are needed"
        return found, None, density, f"the log is not tested: {'its graphs are hidden' if log.hidden else few}"
    of = Filter(law, log.times, log.states, log.starts, log.graphs)
    filtered = of.run(measurement_noise(log, of)[0], variances=False, keep=True)
    assert filtered.maps is not None
    assert filtered.gains is not None
    begin = int(np.argmax(np.logical_or.accumulate(of.present | law.held, axis=0).all(axis=1)))
    system = continuous(log.law) if log.sampled_law == "continuous" else prediction.system
    lift, d = system.lift, system.dimension
    lags = lags_of(found, len(log.times) - 1 - begin)
    steps = min(len(log.times) - 1 - begin, int(MOST_NUMBERS / (len(lags) * d * max(d, log.states.shape[2]))))
    part = slice(begin + 1, begin + 1 + steps)
    y = np.einsum("kmr,md->krd", filtered.filtered[begin : begin + 1 + steps], lift)
    matrices, noise = (lift.T @ each[part] @ lift for each in (filtered.maps, filtered.gains))
    measured, expected, covariance, p = autocovariances((np.arange(steps), matrices, noise), y, None, lags)
    predicted = found.system_autocovariance[np.searchsorted(found.lags, lags)]
    note = f"the first {steps} of {len(log.times) - 1} intervals are tested" if steps < len(log.times) - 1 else None
    at = np.asarray(lags * period, dtype=float)
    return found, LoggedAutocovariance(steps, at, predicted, measured, expected, covariance, p), density, note


def _on_grid(log: Log) -> tuple[Log, float]:
    """The log with an empty sample wherever one is left out, and its interval."""
    span, usual = float(log.times[-1] - log.times[0]), float(np.median(np.diff(log.times)))
    count = max(1, round(span / usual))
    period = span / count
    exact = (log.times - log.times[0]) / period
    places = np.rint(exact).astype(np.int64)
    worst = int(np.argmax(np.abs(exact - places)))
    if np.abs(exact - places)[worst] > OFF_GRID or (np.diff(places) < 1).any():
        raise InputError(
            f"the sample at {log.times[worst]:.9g} is {exact[worst]:.6g} intervals of {period:.6g} after the first: "
            "expected samples at equal intervals for a spectrum: sample the log again, or use `compare`"
        )
    times: FloatArray = log.times[0] + period * np.arange(count + 1)
    states = np.full((count + 1, *log.states.shape[1:]), np.nan)
    times[places], states[places] = log.times, log.states
    return replace(log, times=times, states=states), period


def _density(log: Log, period: float) -> LoggedDensity:
    from scipy.signal import welch  # here, since it takes long to import

    away = log.states - log.law.reference
    if log.law.problem == "consensus":
        away = away - away.mean(axis=1, keepdims=True)
    window = min(max(8, min(len(away) // 16, MOST_WINDOW)), len(away))
    frequencies, found = welch(away, fs=1.0 / period, nperseg=window, detrend=False, axis=0)
    return LoggedDensity(frequencies, found.sum(axis=1).mean(axis=1))
