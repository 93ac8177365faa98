# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Variance of the time mean of the system error, and the effect of the start, by sampling.

States go forward through sparse steps, P paths of graphs and losses with R replicas of the noise each. From the means
of batches of T steps, T times their variance is nearly path + replica / R (``MeanVariance``), less by the share of the
correlation time in T; T is doubled until that changes it by less than the factor ``CHANGE``, and once more.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from msg_analysis.common.arrays import FloatArray
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.experiment.links import expanded
from msg_analysis.theory.sparse_walks import Law, Walk
from msg_analysis.theory.time_mean_variance import MeanVariance

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment

PATHS, REPLICAS, BATCHES = 32, 8, 16  # of every path, an even number of batches of T steps
SHORTEST = 32  # steps of a batch
CHANGE = 1.1
WALKS = 512  # that say how long the start has an effect
LONG = 60.0  # s after which it is not known


def _law_of(experiment: Experiment) -> tuple[Law, Experiment]:
    """The law, and the experiment with a chain of graphs."""
    experiment = experiment if experiment.links else expanded(experiment)
    law = Law(experiment)
    if not law.plain:
        raise NotAvailableError(
            "plan: without an exact prediction, the variance of time means is sampled only where messages are neither "
            "noisy, late nor held, in lockstep: leave these out, or use fewer agents or links"
        )
    return law, experiment


def sampled_mean_variance(experiment: Experiment, seed: int = 0) -> MeanVariance:
    """The same as ``mean_variance``, sampled. InputError: not known in ``LONG`` s."""
    began, steps, enough = time.monotonic(), SHORTEST, False
    forward = _Forward(*_law_of(experiment), np.random.default_rng(seed))
    series = forward.series(2 * BATCHES * steps)
    while True:
        # Twice as many steps: those before were the warm-up.
        steps *= 2
        series = forward.series(BATCHES * steps)
        shorter, longer = (_of_batches(series, length) for length in (steps // 2, steps))
        if enough:
            return longer
        enough = longer.of(REPLICAS) <= CHANGE * shorter.of(REPLICAS)
        if time.monotonic() - began > LONG:
            raise InputError(
                f"plan: errors of {steps * experiment.step_length:g} units of time apart are still correlated, "
                f"expected that this many are simulated within {LONG:g} s: use fewer agents or links"
            )


def _of_batches(series: FloatArray, steps: int) -> MeanVariance:
    """From a series (N, P, R), with batches of so many steps."""
    means = series.reshape(-1, steps, *series.shape[1:]).mean(axis=1)
    within = means.var(axis=2, ddof=1)
    share = 1.0 - 1.0 / means[..., 0].size  # of the scatter about the true mean, which that of all batches has
    between = (means.mean(axis=2) - means.mean()) ** 2 / share - within / REPLICAS
    samples = steps * np.stack([between.mean(axis=0), within.mean(axis=0)], axis=1)
    path, replica = samples.mean(axis=0).tolist()
    return MeanVariance(max(path, 0.0), replica, samples)


def sampled_warm_up(experiment: Experiment, sought: float, seed: int = 0) -> int:
    """Steps until the effect of the start on the system error stays below ``sought`` of its steady value."""
    # After k steps from x(0) it is the sum of the first k terms of the walks backwards, plus (z^T x(0))^2.
    place = experiment.known_start
    if place is None:
        return 0
    (law, _), rng, began = _law_of(experiment), np.random.default_rng(seed), time.monotonic()
    z: FloatArray = np.asarray(2.0 * rng.integers(0, 2, (law.agents, WALKS)) - 1.0)
    start: FloatArray = np.asarray(place - (place.mean() if law.consensus else experiment.reference))
    if law.consensus:
        z = z - z.mean(axis=0)
    walk, size = Walk(law, z, rng), float((z**2).sum())
    of_start, terms = [float(((start @ z) ** 2).mean())], []
    while (walk.z**2).sum() > 1e-3 * sought * size:
        terms.append(float(walk.back().mean()))
        of_start.append(float(((start @ walk.z) ** 2).mean()))
        if time.monotonic() - began > LONG:
            raise InputError(f"plan: the start has an effect for more than {walk.steps} steps: raise run.dt")
    steady = math.fsum(terms)
    effect = np.abs(np.array(of_start) - (steady - np.append(0.0, np.cumsum(terms))))
    return int(1 + np.flatnonzero(effect > sought * steady).max(initial=-1))


class _Forward:
    """States (m, P, R), which go forward through the steps of P paths, from zero."""

    def __init__(self, law: Law, experiment: Experiment, rng: np.random.Generator) -> None:
        self._law, self._rng = law, rng
        if not law.links:  # its chain goes backwards
            chain = experiment.chain.transition(experiment.step_length)
            np.fill_diagonal(chain, 0.0)
            law.jumps = np.cumsum(chain, axis=1) / np.maximum(law.leave, 1e-300)[:, None]
        self._path = Walk(law, np.zeros((law.agents, PATHS)), rng)
        self._x = np.zeros((law.agents, PATHS, REPLICAS))
        arcs = np.arange(len(law.targets))
        self._into = sparse.csr_array((np.ones(len(arcs)), (law.targets, arcs)), (law.agents, len(arcs)))
        self._gains: list[Any] = [sparse.csr_array(gain.T) for gain in law.gains]

    def series(self, steps: int) -> FloatArray:
        """(steps, P, R) of the system error."""
        found = np.empty((steps, PATHS, REPLICAS))
        for k in range(steps):
            away = self._x - self._x.mean(axis=0) if self._law.consensus else self._x
            found[k] = np.einsum("ipr,ipr->pr", away, away)
            self._advance()
        return found

    def _advance(self) -> None:
        law, x = self._law, self._x
        self._path.switch()
        weights, modes = self._path.weights(), self._path.modes
        flow = weights[:, :, None] * (x[law.sources] - x[law.targets])
        pull: FloatArray = np.asarray(self._into @ flow.reshape(len(flow), -1))
        moved = self._path.rows()[:, :, None] * x + pull.reshape(x.shape)
        for mode, gain in enumerate(self._gains):
            there = modes == mode if len(self._gains) > 1 else np.ones(PATHS, dtype=np.bool_)
            normal = self._rng.standard_normal((gain.shape[1], int(there.sum()) * REPLICAS))
            felt = np.reshape(gain @ normal, (law.agents, -1, REPLICAS))
            moved[:, there] += felt * self._path.up[:, there, None] if law.leaves_out_steps else felt
        self._x = moved
