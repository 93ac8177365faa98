"""What a step adds that its mean does not explain: e(k) = x(k+1) - W_g(k) x(k) - offset_g(k).

Under the model the e(k) are independent N(0, N_g(k)), whatever the graphs do; so these tests are exact or
nearly so, and find what the time means hardly see. With noise or loss on the air, and in real time, what the agents
heard takes the place of others' states (see ``reception``), and the same holds given that, whoever was late.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from msg_analysis.inference.gaussian import covariance_statistic
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.reception import (
    NO_NOISE,
    Equalizer,
    HeardRegression,
    Reception,
    full_reception_noise,
)
from msg_analysis.model.step import StepModel
from msg_analysis.types import FloatArray, IntArray

LAGS = 10
MAX_REGRESSORS = 400
ROUNDING = 1e-9
"""Relative size of what counts as rounding in such directions."""


@dataclass(frozen=True, slots=True)
class InnovationTests:
    """p-values; None where there is nothing to test.

    Attributes
    ----------
    p_covariance : covariance of the innovations against N_g; 0 if anything moves where there is no noise
    p_whiteness : correlation in time (lags 1..10) and between replicas
    p_gain : regression on what the agents heard: wrong gains, references, offsets
    """

    p_covariance: float | None
    p_whiteness: float | None
    p_gain: float | None


@dataclass(slots=True, eq=False)
class _Sums:
    """Sums over the steps and replicas of each graph.

    Attributes
    ----------
    samples : (n,)
    noise : (n, m, m) sum of e e^T
    quiet : largest |e| in directions without noise
    largest : largest |x|
    """

    samples: IntArray
    noise: FloatArray
    quiet: float = 0.0
    largest: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Directions:
    """Directions of the noise of one graph: N_g = (basis * variances) basis^T, largest variance first.

    Attributes
    ----------
    whitener : (r, m)
    quiet : (m, m - r) orthonormal basis of the directions without noise
    """

    whitener: FloatArray
    quiet: FloatArray


def innovation_tests(observation: Observation, position: IntArray | None = None) -> InnovationTests:
    """Test the innovations of a run.

    Parameters
    ----------
    position : (N, m) in real time, when the states were made (``events.Order.position``)
    """
    step, noise = observation.step, observation.prediction.experiment.noise
    noises = full_reception_noise(observation) if noise.on_air else step.noise
    directions = [_directions(noise) for noise in noises]
    regression: _StateRegression | HeardRegression = (
        HeardRegression(observation, MAX_REGRESSORS, position if _correlated(step) else None)
        if noise.on_air or observation.timers
        else _StateRegression(observation)
    )
    varies = step.loss > 0.0 and noise.link > 0.0
    if observation.timers:
        varies = bool((step.noise_gain != step.noise_gain[0]).any())
    equalizer = Equalizer(step, noises) if varies else None
    sums, p_whiteness = _pass(observation, directions, regression, equalizer)
    # What NO_NOISE hides may be there: ten standard deviations of it.
    hidden = 10 * np.sqrt(NO_NOISE * max(np.linalg.norm(noise, 2) for noise in noises))
    if sums.quiet > max(ROUNDING * sums.largest, hidden):
        p_covariance: float | None = 0.0
    elif equalizer and not equalizer.possible:
        p_covariance = equalizer.p_size()
    else:
        p_covariance = _covariance_p(noises, directions, sums)
    chi2, dof = quadratic_form(*regression.statistic())
    return InnovationTests(p_covariance, p_whiteness, float(stats.chi2.sf(chi2, dof)) if dof else None)


def innovations(observation: Observation, first: int, last: int, reception: Reception | None = None) -> FloatArray:
    """(last - first, m, R): e of the steps first..last-1, given what was heard, if that was not the states."""
    step, now = observation.step, observation.states[first:last]
    after = observation.states[first + 1 : last + 1].copy()
    if reception is not None:
        offsets = step.offsets[reception.graphs, np.arange(step.agents)]
        return np.asarray(after - reception.mean() - offsets[:, :, None])
    for mode in range(step.modes):
        at = np.flatnonzero(observation.modes[first:last] == mode)
        after[at] -= step.weights[mode] @ now[at] + step.offsets[mode][:, None]
    return after


def _correlated(step: StepModel) -> bool:
    """Whether the process noise of an agent says something about that of another, whichever graphs they use."""
    together = np.einsum("gik,hjk->ij", np.abs(step.noise_gain), np.abs(step.noise_gain))
    return bool((together - np.diag(np.diag(together))).any())


def _directions(noise: FloatArray) -> _Directions:
    values, vectors = np.linalg.eigh(noise)
    values, vectors = values[::-1], vectors[:, ::-1]
    rank = int((values > NO_NOISE * values[0]).sum()) if values[0] > 0.0 else 0
    return _Directions((vectors[:, :rank] / np.sqrt(values[:rank])).T, vectors[:, rank:])


def _pass(
    observation: Observation,
    directions: list[_Directions],
    regression: _StateRegression | HeardRegression,
    equalizer: Equalizer | None,
) -> tuple[_Sums, float | None]:
    """One pass over the run: the sums of each graph, the regression, and the whiteness test."""
    n, m = observation.step.modes, observation.step.agents
    sums = _Sums(np.zeros(n, np.int64), np.zeros((n, m, m)))
    # Graphs may differ in the number of noisy directions; the strongest ones that all have are iid N(0, I) in
    # any case.
    whitened = _Whiteness(min(len(d.whitener) for d in directions))
    for first, last in observation.blocks(max(observation.states[0].size, regression.numbers_per_step)):
        modes = observation.modes[first:last]
        if isinstance(regression, HeardRegression):
            reception = Reception.of(observation, first, last)
            e = innovations(observation, first, last, reception)
            regression.add(reception, e, first)
            if equalizer:
                e = equalizer.equalize(e, reception)
                sums.quiet = max(sums.quiet, equalizer.quiet)
        else:
            e = innovations(observation, first, last)
            regression.add(modes, observation.states[first:last], e)
        sums.largest = max(sums.largest, float(np.abs(observation.states[first:last]).max()))
        white = np.empty((last - first, whitened.rank, observation.replicas))
        for mode, direction in enumerate(directions):
            at = np.flatnonzero(modes == mode)
            if not at.size:
                continue
            flat = e[at].transpose(1, 0, 2).reshape(m, -1)
            sums.samples[mode] += flat.shape[1]
            sums.noise[mode] += flat @ flat.T
            sums.quiet = max(sums.quiet, float(np.abs(direction.quiet.T @ flat).max(initial=0.0)))
            white[at] = direction.whitener[: whitened.rank] @ e[at]
        whitened.add(white)
    return sums, None if equalizer and not equalizer.possible else whitened.p_value()


class _Whiteness:
    """Portmanteau test of iid N(0, I) vectors: lags 1..LAGS, and lag 0 between replicas."""

    def __init__(self, rank: int) -> None:
        self.rank = rank
        self._tail: FloatArray | None = None
        self._products = np.zeros((LAGS, rank, rank))
        self._counts = np.zeros(LAGS)
        self._squares = np.zeros(rank)
        self._pairs = np.zeros(rank)
        self._steps, self._replicas = 0, 1

    def add(self, white: FloatArray) -> None:
        """Take the next (b, rank, R) block."""
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

    def p_value(self) -> float | None:
        """None without noise. Each coordinate is divided by its own size: that is another test's matter."""
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
        return float(stats.chi2.sf(chi2, dof))


def _covariance_p(noises: FloatArray, directions: list[_Directions], sums: _Sums) -> float | None:
    """Of all steps together when the noise is the same in every graph, else per graph and added up."""
    modes = range(len(noises))
    groups = [list(modes)] if (noises == noises[0]).all() else [[g] for g in modes]
    statistic, dof = 0.0, 0.0
    for group in groups:
        whitener = directions[group[0]].whitener
        samples = int(sums.samples[group].sum())
        if len(whitener) and samples:
            scatter = whitener @ sums.noise[group].sum(axis=0) @ whitener.T
            part = covariance_statistic(scatter, samples)
            statistic, dof = statistic + part[0], dof + part[1]
    return float(stats.chi2.sf(statistic, dof)) if dof else None


class _StateRegression:
    """Score test: the innovations of row i do not depend on what row i of W_g uses.

    The scores U_a = sum_k e_i(a)(k) phi_a(k) are martingales, Cov(U_a, U_b) = sum_k (N_g)_i(a)i(b) phi_a
    phi_b given the inputs; so U^T Cov^+ U is chi-square with rank(Cov) degrees of freedom, for correlated
    noise too. All regressors are linear in z, the deviations of the agents and a constant 1.
    """

    def __init__(self, observation: Observation) -> None:
        self._step = step = observation.step
        self._centred = observation.prediction.experiment.problem == "consensus"
        size = step.agents + 1
        self._scores = np.zeros((step.modes, step.agents, size))  # sum of e z^T
        self._inputs = np.zeros((step.modes, size, size))  # sum of z z^T

    @property
    def numbers_per_step(self) -> int:
        """Size of the largest temporary array."""
        return 0

    def add(self, modes: IntArray, states: FloatArray, innovations: FloatArray) -> None:
        """Take a block of steps: graphs (b,), states and innovations (b, m, R)."""
        m = self._step.agents
        z = np.ones((len(modes), m + 1, states.shape[2]))
        z[:, :m] = states - (states.mean(axis=1, keepdims=True) if self._centred else self._step.reference)
        for mode in range(self._step.modes):
            at = np.flatnonzero(modes == mode)
            flat_e = innovations[at].transpose(1, 0, 2).reshape(m, -1)
            flat_z = z[at].transpose(1, 0, 2).reshape(m + 1, -1)
            self._scores[mode] += flat_e @ flat_z.T
            self._inputs[mode] += flat_z @ flat_z.T

    def statistic(self) -> tuple[FloatArray, FloatArray]:
        """U (K,) and Cov (K, K)."""
        rows, inputs = _regressors(self._step)
        score = np.einsum("gac,gac->a", self._scores[:, rows], inputs)
        covariance = np.zeros((len(rows), len(rows)))
        for mode in range(self._step.modes):
            products = inputs[mode] @ self._inputs[mode] @ inputs[mode].T
            covariance += self._step.noise[mode][np.ix_(rows, rows)] * products
        return score, covariance


def _regressors(step: StepModel) -> tuple[IntArray, FloatArray]:
    """What the innovations are regressed on: phi_a(k) = inputs[g, a] . z(k) for row rows[a].

    rows : (K,), inputs : (n, K, m + 1).

    One for every graph and difference x_j - x_i that row i uses, every graph and leader (x_i - reference),
    and every agent (1, which finds a wrong reference or offset). When these are more than MAX_REGRESSORS: the
    whole pull (W_g x - x)_i of a row instead of each of its terms; when that is still too many, without
    telling graphs apart.
    """
    n, m = step.modes, step.agents
    rows: list[int] = list(range(m))
    parts: list[tuple[int | None, FloatArray]] = [(None, np.eye(m + 1)[m]) for _ in range(m)]
    pulls = np.zeros((n, m, m + 1))
    pulls[:, :, :m] = step.weights - np.eye(m)
    terms = sum(int((step.weights[g] != 0.0).sum()) for g in range(n))
    for mode in range(n):
        for i in range(m):
            if terms + m > MAX_REGRESSORS:
                rows.append(i)
                parts.append((mode, pulls[mode, i]))
                continue
            own = np.eye(m + 1)[i]
            for j in step.inputs(mode, i):
                if j != i:
                    rows.append(i)
                    parts.append((mode, np.eye(m + 1)[j] - own))
            if abs(1.0 - step.weights[mode, i].sum()) > 1e-12:
                rows.append(i)
                parts.append((mode, own))
    if len(rows) > MAX_REGRESSORS:
        constants = np.broadcast_to(np.eye(m + 1)[m], (n, m, m + 1))
        return np.tile(np.arange(m), 2), np.concatenate([constants, pulls], axis=1)
    inputs = np.zeros((n, len(rows), m + 1))
    for a, (mode_of, part) in enumerate(parts):
        inputs[slice(None) if mode_of is None else mode_of, a] = part
    return np.array(rows), inputs


def quadratic_form(vector: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """(v^T C^+ v, rank C), with the rank judged on the correlations, whatever the units of the entries.

    Parameters
    ----------
    vector : (q,)
    covariance : (q, q)
    """
    variances = np.diag(covariance)
    alive = np.flatnonzero(variances > 1e-24 * variances.max(initial=0.0))
    deviation = np.sqrt(variances[alive])
    values, vectors = np.linalg.eigh(covariance[np.ix_(alive, alive)] / np.outer(deviation, deviation))
    keep = values > 1e-10
    scores = vectors[:, keep].T @ (vector[alive] / deviation)
    return float((scores**2 / values[keep]).sum()), int(keep.sum())
