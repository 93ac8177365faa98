# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Tests of one-step residuals (innovations) e(k) = x(k+1) - W_g(k) x(k) - offset_g(k): what a step adds to its mean.

Under the model the e(k) are independent N(0, N_g(k)), for any path of the graphs; so these tests are exact or nearly
so, and find what the time means hardly show. With noise or loss of messages, and in real time, the same holds given the
values that the agents received (``received_values``), for any timing. See docs/statistics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.received_values import (
    DIGITS,
    Correlations,
    Equalizer,
    ReceivedValues,
    RepeatedNoise,
    full_reception_noise,
    state_rounding,
)
from msg_analysis.inference.regression import MAX_REGRESSORS, Regression
from msg_analysis.inference.statistics import (
    add_sums,
    chi2_below,
    chi2_tail,
    covariance_statistic,
    direction_p,
    quadratic_form,
)
from msg_analysis.model.step_model import StepModel

if TYPE_CHECKING:
    from msg_analysis.inference.evidence_sums import WatchedEvidence

LAGS = 10
PULLED = 1e-12  # difference of the sum of an agent's weights from 1, above which it is not rounding


@dataclass(frozen=True, slots=True)
class ResidualTests:
    """p-values; None where there is nothing to test."""

    p_covariance: float | None = None  # of their covariance being N_g; 0 if anything moves in a direction without noise
    p_whiteness: float | None = None  # correlation in time (lags 1..10) and between replicas
    p_gain: float | None = None  # regression on what the agents received: wrong gains, references, offsets
    p_common_gain: float | None = None  # the same for one factor of all gains: ignored messages
    # (m,) measured over nominal variance; NaN where an agent has no noise in some graph
    ratios: tuple[float, ...] | None = None
    samples: int | None = None  # of each agent, replicas counted; samples * ratio is chi-square(samples)


class ResidualSums:
    """Sums over residuals of runs, for the tests and the search for causes; ``follower`` is given every step."""

    def __init__(
        self,
        observation: Observation,
        position: IntArray | None = None,
        follower: WatchedEvidence | None = None,
        most_regressors: int = MAX_REGRESSORS,
    ) -> None:
        step = observation.step
        n, m = step.modes, step.agents
        # (n, m, m) nominal covariances
        self.noises: FloatArray = full_reception_noise(step)
        self.floor = (DIGITS * state_rounding(observation.prediction)) ** 2  # variances up to this are rounding
        self.replicas = observation.replicas
        # Number of residuals, replicas counted, and sum of e e^T, by graph.
        self.samples, self.scatter = np.zeros(n, np.int64), np.zeros((n, m, m))
        self.still = np.zeros((n, m), np.int64)  # steps in which no replica of an agent changed
        self.largest = 0.0  # |x|
        self._whiteners = [Correlations(matrix, self.floor).whitener() for matrix in self.noises]
        # Graphs may differ in the number of noisy directions; the strongest ones that all graphs have are iid N(0, I).
        self._whiteness = WhitenessSums(min(len(whitener) for whitener in self._whiteners))
        self._repeated = RepeatedNoise.of(observation)
        # False where residuals depend on each other in a way that is not followed here.
        self.independent = self._repeated is None or not _correlated(step)
        self._equalizer = Equalizer(step, self.noises, self.floor)
        regression = Regression(observation, most_regressors, position if _correlated(step) else None)
        if self.independent:
            self._add(observation, regression, follower)
        elif follower:
            follower.follow(observation)
        self.terms = regression.terms
        score, covariance = regression.statistic()
        noises = np.diagonal(self.noises, axis1=1, axis2=2)
        rounded = np.asarray(((noises > 0.0) & (noises <= self.floor)).any(axis=0))
        told = ~rounded[[term.agent for term in self.terms]]  # not of agents whose noise is rounding
        self.score, self.covariance = score * told, covariance * np.outer(told, told)  # (K,), (K, K)
        self.gram = regression.gram()  # (K, K), see ``Regression.gram``; None where it is not available

    @property
    def steps(self) -> IntArray:
        """(n,): steps of each graph."""
        return self.samples // self.replicas

    def merge(self, other: ResidualSums) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        add_sums(self, other, "samples", "scatter", "still", "score", "covariance")
        self.largest = max(self.largest, other.largest)
        self._whiteness.merge(other._whiteness)
        self._equalizer.merge(other._equalizer)
        self.gram = None if self.gram is None or other.gram is None else self.gram + other.gram

    def tests(self) -> ResidualTests:
        """All tests of the residuals."""
        if not self.independent:
            return ResidualTests()
        ratios: tuple[float, ...] | None = None
        p_whiteness = self._whiteness.p_value()
        if not self._equalizer.possible:
            chi2, dof, p_whiteness = self._equalizer.chi2, self._equalizer.dof, None  # two-sided, of the total size
            p_covariance = min(1.0, 2.0 * float(min(chi2_tail(chi2, dof), chi2_below(chi2, dof)))) if dof else None
        else:
            p_covariance, ratios = self._covariance_p(), self._ratios()
        if self._equalizer.quiet > 1.0:
            p_covariance = 0.0
        chi2, dof = quadratic_form(self.score, self.covariance)
        p_gain = float(chi2_tail(chi2, dof)) if dof else None
        p_common_gain = self._common_gain_p() if dof else None
        return ResidualTests(p_covariance, p_whiteness, p_gain, p_common_gain, ratios, int(self.samples.sum()))

    def _ratios(self) -> tuple[float, ...]:
        """(m,): see ``ResidualTests``."""
        seen = self.samples > 0
        noise = np.diagonal(self.noises, axis1=1, axis2=2)[seen]
        scatter = np.diagonal(self.scatter, axis1=1, axis2=2)[seen]
        noisy = noise > self.floor
        parts = np.divide(scatter, noise, out=np.full_like(scatter, np.nan), where=noisy)
        return tuple((parts.sum(axis=0) / max(int(self.samples.sum()), 1)).tolist())

    def _common_gain_p(self) -> float | None:
        """Score test of one direction of the regression: every message counts for less, or more, than it should."""
        agents = np.array([term.agent for term in self.terms])
        size = np.diagonal(self.noises, axis1=1, axis2=2).mean(axis=0)[agents]
        weights = np.array([term.weight if term.kind in ("link", "pull") else 0.0 for term in self.terms])
        weights = np.divide(weights, size, out=np.zeros_like(weights), where=size > self.floor)
        return direction_p(weights, self.score, self.covariance)

    def _add(self, observation: Observation, regression: Regression, follower: WatchedEvidence | None) -> None:
        """One pass over the run."""
        m = observation.step.agents
        numbers = max(observation.states[0].size, regression.numbers_per_step)
        if follower:
            numbers = max(numbers, follower.sums.numbers_per_step)
        for first, last in observation.blocks(numbers, "residuals"):
            modes, reception = observation.modes[first:last], ReceivedValues.of(observation, first, last)
            e = residuals(observation, first, last, reception)
            if follower:
                follower.add(observation, first, last, (reception, e))
            if self._repeated:
                e, reception = self._repeated.free(first, e, reception)
            regression.add(reception, e, first)
            e = self._equalizer.equalize(e, reception)
            states = observation.states[first : last + 1]
            self.largest = max(self.largest, float(np.abs(states[:-1]).max()))
            unmoved = (states[1:] == states[:-1]).all(axis=2)
            white = np.empty((last - first, self._whiteness.rank, observation.replicas))
            for mode, whitener in enumerate(self._whiteners):
                at = np.flatnonzero(modes == mode)
                if not at.size:
                    continue
                flat = e[at].transpose(1, 0, 2).reshape(m, -1)
                self.samples[mode] += flat.shape[1]
                self.scatter[mode] += flat @ flat.T
                self.still[mode] += unmoved[at].sum(axis=0)
                white[at] = whitener[: self._whiteness.rank] @ e[at]
            self._whiteness.add(white)

    def _covariance_p(self) -> float | None:
        """Of all steps together when the noise is the same in every graph, else added up over the graphs."""
        modes = range(len(self.noises))
        groups = [list(modes)] if (self.noises == self.noises[0]).all() else [[g] for g in modes]
        statistic, dof = 0.0, 0.0
        for group in groups:
            whitener = self._whiteners[group[0]]
            samples = int(self.samples[group].sum())
            if len(whitener) and samples:
                scatter = whitener @ self.scatter[group].sum(axis=0) @ whitener.T
                part = covariance_statistic(scatter, samples)
                statistic, dof = statistic + part[0], dof + part[1]
        return float(chi2_tail(statistic, dof)) if dof else None


def residuals(observation: Observation, first: int, last: int, reception: ReceivedValues | None = None) -> FloatArray:
    """(last - first, m, R): residuals e(k) of steps first..last-1; ``reception``: in these, where it is known."""
    reception = reception or ReceivedValues.of(observation, first, last)
    return received_residuals(observation.step, reception, observation.states[first + 1 : last + 1])


def _centred(step: StepModel, now: FloatArray) -> tuple[FloatArray | float, FloatArray]:
    """What is subtracted of states (b, m, R), and the offsets (n, m) then: large common numbers would cost digits."""
    pull = step.nominal.sum(axis=2) - 1.0
    if (np.abs(pull) > PULLED).any():
        return step.reference, step.offsets + pull * step.reference
    return now.mean(axis=1, keepdims=True), step.offsets


def received_residuals(step: StepModel, reception: ReceivedValues, after: FloatArray) -> FloatArray:
    """(b, m, R): residuals of steps, given what was received in them, and the states after them (b, m, R)."""
    centre, offsets = _centred(step, reception.states)
    offsets = offsets[reception.graphs, np.arange(step.agents)]
    return np.asarray(after - centre - reception.mean(centre) - offsets[:, :, None])


def _correlated(step: StepModel) -> bool:
    """Whether the process noise of two agents can be correlated, under any graphs that they use."""
    any_graph = np.abs(step.noise_gain).sum(axis=0)
    together = any_graph @ any_graph.T
    return bool((together - np.diag(np.diag(together))).any())


class WhitenessSums:
    """Portmanteau test of iid N(0, I) vectors of length r: lags 1..LAGS, and lag 0 between replicas."""

    def __init__(self, rank: int) -> None:
        self.rank = rank
        self._tail: FloatArray | None = None
        self._products = np.zeros((LAGS, rank, rank))
        self._counts = np.zeros(LAGS)
        self._squares = np.zeros(rank)
        self._pairs = np.zeros(rank)
        self._steps, self._replicas = 0, 1

    def add(self, white: FloatArray) -> None:
        """Add the next block (b, r, R), which is standard normal if the law holds."""
        self._steps += len(white)
        self._replicas = white.shape[2]
        squares = (white**2).sum(axis=2)
        self._squares += squares.sum(axis=0)
        self._pairs += ((white.sum(axis=2) ** 2 - squares) / 2).sum(axis=0)
        joined = white if self._tail is None else np.concatenate([self._tail, white])
        old = len(joined) - len(white)
        for lag in range(1, LAGS + 1):
            begin = max(old, lag)
            if begin >= len(joined):
                continue
            late, early = joined[begin:], joined[begin - lag : len(joined) - lag]
            self._products[lag - 1] += np.tensordot(late, early, axes=([0, 2], [0, 2]))
            self._counts[lag - 1] += len(late) * self._replicas
        self._tail = joined[-LAGS:]

    def merge(self, other: WhitenessSums) -> None:
        """Add the sums of another run with another seed; no lags are counted across runs."""
        add_sums(self, other, "_products", "_counts", "_squares", "_pairs", "_steps")

    def p_value(self) -> float | None:
        """None without noise or with at most LAGS steps. Coordinates are scaled by their size, tested elsewhere."""
        size = self._squares / (self._steps * self._replicas)
        if not self.rank or self._steps <= LAGS or not (size > 0.0).all():
            return None
        correlations = self._products**2 / np.outer(size, size)
        chi2 = float((correlations.sum(axis=(1, 2)) / self._counts).sum())
        dof = LAGS * self.rank**2
        if self._replicas > 1:
            pairs = self._steps * self._replicas * (self._replicas - 1) / 2
            chi2 += float((self._pairs**2 / size**2).sum() / pairs)
            dof += self.rank
        return float(chi2_tail(chi2, dof))


class BroadcastSums:
    """Sums over the noise in published values, in units of its nominal standard deviation."""

    def __init__(self, observation: Observation) -> None:
        assert observation.published is not None
        deviation = observation.prediction.experiment.noise.broadcast
        agents = observation.step.agents
        self.scatter = np.zeros((agents, agents))  # sum of the products of the agents' noise
        length = observation.steps + 1
        self.samples = length * observation.replicas  # published values of each agent
        for first, last in chain(
            observation.blocks(observation.states[0].size, "broadcast noise"), [(length - 1, length)]
        ):
            noise = (observation.published[first:last] - observation.states[first:last]) / deviation
            flat = noise.transpose(1, 0, 2).reshape(agents, -1)
            self.scatter += flat @ flat.T

    @classmethod
    def of(cls, observation: Observation) -> BroadcastSums | None:
        """Sums of a run; None without broadcast noise."""
        noisy = observation.prediction.experiment.noise.broadcast
        return cls(observation) if noisy and observation.published is not None else None

    def merge(self, other: BroadcastSums) -> None:
        """Add the sums of another run of the same experiment, with another seed."""
        add_sums(self, other, "scatter", "samples")

    def p_value(self) -> float:
        """p-value of published - state being N(0, s^2 I), s = ``noise.broadcast``."""
        statistic, dof = covariance_statistic(self.scatter, self.samples)
        return float(chi2_tail(statistic, dof))
