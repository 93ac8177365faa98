# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Innovations of a log: what a Kalman filter that knows the law and the path of the graphs did not expect.

Under the law e(k) = y(k) - E[y(k) | y(0), ..., y(k-1)] are independent N(0, S(k)), whatever the intervals between the
samples, the measurement noise, and the agents that are missing. The start is diffuse: the first value of every agent
is known by its measurement only, so the mean of a consensus, which is not stationary, needs no law. Derivatives of the
filter give the score and the Fisher information of the gains and variances (Harvey, Forecasting, structural time series
models and the Kalman filter (1989), 3.4); a change of a gain acts on the innovations through their mean.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.errors import InputError
from msg_analysis.inference.intervals import TINY, IntervalLaw, block_size
from msg_analysis.inference.regression import Term

DIFFUSE = 3e3  # standard deviation of an agent that was not measured yet, in units of the largest deviation in the log
MOST_EACH = 8  # agents, up to which each has a parameter of its measurement noise
WORK = 6e10  # floating-point operations for the derivatives by the variances; samples beyond have none
MOST_STEPS, CONVERGED = 40, 1e-5  # of Fisher's scoring: their number, and the relative change that ends it
NOTHING = 1e-8  # relative to the squares of the changes between samples: measurement variance that counts as 0
HELD = 1e-9  # relative to the largest state: deviation of a held leader that is rounding


@dataclass(frozen=True, slots=True)
class Variance:
    """A parameter beside the gains: the logarithm of a variance, or of all rates of the switching."""

    kind: Literal["process", "measurement", "switching"]
    agent: int | None = None  # None: of all


@dataclass(slots=True, eq=False)
class Innovations:
    """What the filter found in N samples of m agents and R coordinates."""

    white: FloatArray  # (N, m, R) normalised innovations, independent N(0, 1); NaN: not measured, or the first value
    marginal: FloatArray  # (N, m, R) innovations over their own standard deviation: of one agent independent over time
    filtered: FloatArray  # (N, m, R) E[x(k) | y(0), ..., y(k)], deviations as ``Filter.values``
    uncertainty: FloatArray  # (N, m) diagonal of their covariance, less its mean over agents in consensus
    terms: list[Term]  # the first K parameters
    variances: list[Variance]  # the others
    score: FloatArray  # (K + V,)
    information: FloatArray  # (K + V, K + V)
    log_likelihood: float  # of all but the first values
    samples: int  # N - 1, of which intervals end in
    scored: int  # samples with derivatives by the variances
    off_reference: tuple[int, int, float] | None = None  # sample, agent, deviation of a held leader that is not held
    maps: FloatArray | None = None  # (N, m, m): Phi of the interval before each sample
    gains: FloatArray | None = None  # (N, m, m): covariance of what each sample adds to ``filtered``
    # Of a hidden path: (N, n, m, m) E[x x^T; graph | y(0), ..., y(k)], all coordinates, and (N, n) P(graph | ...).
    moments: FloatArray | None = None
    probabilities: FloatArray | None = None


class Filter:
    """A Kalman filter of the deviations from the reference, given the path."""

    def __init__(
        self,
        law: IntervalLaw,
        times: FloatArray,
        states: FloatArray,
        starts: FloatArray,
        graphs: IntArray,
    ) -> None:
        self.law, self.times = law, times
        # (N, m, R) deviations; a consensus has no place, and a large common number would cost digits.
        consensus = law.experiment.problem == "consensus"
        self.values = states - (float(np.nanmedian(states)) if consensus else law.reference)
        self.present: BoolArray = np.asarray(~np.isnan(self.values).any(axis=2))
        self.stretches = law.stretches(times, starts, graphs)
        self.spread = float(np.nanmax(np.abs(self.values), initial=0.0)) or 1.0

    def terms(self) -> list[Term]:
        """The gains that are tested."""
        return self.law.terms()

    def exchanged(self, order: Sequence[int]) -> Filter:
        """The same with the states of agent ``order[i]`` as those of agent i."""
        other = copy.copy(self)
        other.values, other.present = self.values[:, order], self.present[:, order]
        return other

    def under(self, law: IntervalLaw) -> Filter:
        """The same log with another law."""
        other = copy.copy(self)
        other.law = law
        return other

    def run(
        self,
        noise: FloatArray,
        *,
        terms: list[Term] | None = None,
        variances: bool = True,
        keep: bool = False,
        most: int | None = None,
    ) -> Innovations:
        """Filter with standard deviations (m,) of the measurement noise.

        ``terms``: gains with derivatives; ``keep``: the matrices for the means of errors; ``most``: samples used.
        """
        return self._pass(noise, terms or [], variances, keep, most or len(self.times))

    def _pass(self, noise: FloatArray, terms: list[Term], variances: bool, keep: bool, most: int) -> Innovations:
        return _Pass(self, noise, terms, variances, keep, most).run()

    def singular(self, variances: FloatArray, rows: IntArray, k: int) -> InputError:
        """The error of a sample whose expected variances are 0 in some direction."""
        agent = int(rows[int(np.argmin(variances))]) + 1
        return InputError(
            f"the law leaves agent {agent}, or a combination of agents, without any noise in the interval before the "
            f"sample at {self.times[k]:g}, so nothing can be tested: give `measurement_noise` > 0"
        )


class _Pass:
    """One pass over the samples."""

    def __init__(
        self, of: Filter, noise: FloatArray, terms: list[Term], variances: bool, keep: bool, most: int
    ) -> None:
        self.of, self.law, self.terms = of, of.law, terms
        m, self.noise = of.law.agents, noise**2
        self.variances = parameters_of(m, self.noise) if variances else []
        self.count, replicas = most, of.values.shape[2]
        self.measured = np.zeros((len(self.variances), m))  # derivatives of the measurement variances
        for place, one in enumerate(self.variances):
            if one.kind == "measurement":
                self.measured[place] = self.noise if one.agent is None else self.noise * (np.arange(m) == one.agent)
        self.silent = of.law.held & (noise == 0.0)  # always exactly at the reference
        flops = 12.0 * len(self.variances) * m**3
        self.scored = min(most, int(WORK / flops) + 1) if flops else most
        shape = most, m, replicas
        parameters = len(terms) + len(self.variances)
        self.out = Innovations(
            white=np.full(shape, np.nan),
            marginal=np.full(shape, np.nan),
            filtered=np.zeros(shape),
            uncertainty=np.zeros((most, m)),
            terms=terms,
            variances=self.variances,
            score=np.zeros(parameters),
            information=np.zeros((parameters, parameters)),
            log_likelihood=0.0,
            samples=most - 1,
            scored=min(self.scored, most) - 1,
            maps=np.zeros((most, m, m)) if keep else None,
            gains=np.zeros((most, m, m)) if keep else None,
        )
        self.rows = [of.law.rows(terms, graph) for graph in range(of.law.modes)]
        self.target = np.array([term.agent for term in terms], dtype=np.int64)
        self.centre = np.eye(m) - (1.0 / m if of.law.experiment.problem == "consensus" else 0.0)

    def run(self) -> Innovations:
        self._begin()
        stretches = self.of.stretches
        size, done = block_size(self.law, len(self.terms)), 0
        while done < self.count - 1:
            tell("innovations", done, self.count)
            last = min(done + size, self.count - 1)
            first, end = np.searchsorted(stretches.interval, [done, last])
            while end - first > 4 * size and last > done + 1:  # many switches within the intervals
                last = done + max(1, (last - done) // 2)
                first, end = np.searchsorted(stretches.interval, [done, last])
            self._block(done, last, int(first), int(end))
            done = last
        return self.out

    def _begin(self) -> None:
        """The state after the first sample, and its derivatives."""
        of, m = self.of, self.law.agents
        there = of.present[0] | self.law.held
        self.seen = there.copy()
        self.x = np.where(of.present[0][:, None] & ~self.law.held[:, None], of.values[0], 0.0)
        variance = np.where(there, self.noise, (DIFFUSE * of.spread) ** 2) * ~self.law.held
        self.p = np.diag(variance)
        self.dp = np.zeros((len(self.variances), m, m))
        self.dp[:, range(m), range(m)] = self.measured * (there & ~self.law.held)
        self.dx = np.zeros((m, len(self.variances) * of.values.shape[2]))
        self.d = np.zeros((m, len(self.terms) * of.values.shape[2]))
        self.out.filtered[0] = self.x
        self.out.uncertainty[0] = np.einsum("ij,jk,ik->i", self.centre, self.p, self.centre)
        self._check_held(0)

    def _matrices(
        self, done: int, last: int, first: int, end: int, apart: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Phi, Q and its parts, where wanted, of the intervals done..last-1, of stretches first..end-1."""
        stretches, part = self.of.stretches, slice(first, end)
        interval, graph, length = stretches.interval[part], stretches.graph[part], stretches.length[part]
        m, count = self.law.agents, len(interval)
        phi, q, parts = np.empty((count, m, m)), np.empty((count, m, m)), np.empty((count, m * apart, m, m))
        for g in np.unique(graph).tolist():
            at = np.flatnonzero(graph == g)
            phi[at], q[at], parts[at] = self.law.over(g, length[at], apart)
        self.before = np.broadcast_to(np.eye(m), (count, m, m))  # of the interval, before each stretch
        self.after = self.before
        if count == last - done:
            return phi, q, parts
        self.before, self.after = np.array(self.before), np.array(self.after)
        start = np.searchsorted(interval, np.arange(done, last))
        number = np.diff(np.append(start, count))
        for place in range(1, int(number.max())):
            at = start[number > place] + place
            self.before[at] = phi[at - 1] @ self.before[at - 1]
        for place in range(int(number.max()) - 1, 0, -1):
            at = start[number > place] + place
            self.after[at - 1] = self.after[at] @ phi[at]
        ends = start + number - 1
        whole = phi[ends] @ self.before[ends]
        right = self.after.transpose(0, 2, 1)
        total = np.add.reduceat(self.after @ q @ right, start)
        return whole, total, np.add.reduceat(self.after[:, None] @ parts @ right[:, None], start)

    def _block(self, done: int, last: int, first: int, end: int) -> None:
        """Samples done + 1..last."""
        m, count, out, replicas = self.law.agents, last - done, self.out, self.of.values.shape[2]
        phi, q, parts = self._matrices(done, last, first, end, bool(self.variances) and done + 1 < self.scored)
        keeps, whiteners = np.zeros((count, m, m)), np.zeros((count, m, m))
        white = np.zeros((count, m, replicas))  # 0 where not measured
        tangents = np.zeros((count, m, len(self.variances) * replicas))
        states, moments = np.empty((count + 1, m, replicas)), np.empty((count, m, m))
        errors, expected = np.zeros((count, m, replicas)), np.ones((count, m))  # innovations, and their variances
        states[0] = self.x
        present = self.of.present[done + 1 : last + 1] & ~self.silent
        whole = present.all(axis=1)
        everything, identity, noise = np.arange(m), np.eye(m), np.diag(self.noise)
        for b in range(count):
            k = done + 1 + b
            scoring = bool(self.variances) and k < self.scored
            full = bool(whole[b])
            rows = everything if full else np.flatnonzero(present[b])
            map_, right = phi[b], phi[b].T
            x, p = map_ @ self.x, map_ @ self.p @ right + q[b]
            if scoring:
                self.dp = map_ @ self.dp @ right
                self.dp[:m] += parts[b]
                self.dx = map_ @ self.dx
            keeps[b] = identity
            if len(rows):
                here = b if full else (b, rows)
                columns = p if full else p[:, rows]
                s = p + noise if full else columns[rows] + np.diag(self.noise[rows])
                # The routines themselves: with matrices as small as these, what numpy has around them takes longer.
                factor, failed = scipy.linalg.lapack.dpotrf(s, lower=1)
                if failed:
                    raise self.of.singular(np.diag(s), rows, k)
                inverse = scipy.linalg.lapack.dtrtri(factor, lower=1)[0]
                gain = columns @ inverse.T @ inverse
                e = self.of.values[k][rows] - x[rows]
                z = inverse @ e
                errors[here], white[here], expected[here] = e, z, s.diagonal()
                keeps[b][:, rows] -= gain
                keep = keeps[b]
                if full:
                    whiteners[b] = inverse
                else:
                    whiteners[b][np.ix_(rows, rows)] = inverse
                if scoring:
                    tangents[here] = inverse @ self.dx[rows]
                    self._score(z, inverse, gain, keep, rows)
                x = x + gain @ e
                p = keep @ p @ keep.T + (gain * self.noise[rows]) @ gain.T
                if out.gains is not None:
                    out.gains[k] = gain @ s @ gain.T
            self.x, self.p = x, (p + p.T) / 2.0
            states[b + 1], moments[b] = x, self.p
        self._record(done, last, present, white, errors / np.sqrt(expected)[:, :, None], whiteners)
        out.filtered[done + 1 : last + 1] = states[1:]
        out.uncertainty[done + 1 : last + 1] = np.einsum("kij,ij->ki", self.centre @ moments, self.centre)
        if out.maps is not None:
            out.maps[done + 1 : last + 1] = phi
        if self.silent.any():
            for k in range(done + 1, last + 1):
                self._check_held(k)
        regressors = self._regressors(done, last, first, end, states[:-1])
        self._gain_scores(phi, keeps, whiteners, white, tangents, regressors)

    def _record(
        self,
        done: int,
        last: int,
        present: BoolArray,
        white: FloatArray,
        marginal: FloatArray,
        whiteners: FloatArray,
    ) -> None:
        """Add a block of innovations, and their likelihood; the first value of an agent is none."""
        seen = np.logical_or.accumulate(np.concatenate([self.seen[None], present]))
        self.seen = seen[-1]
        usual = present & seen[:-1]
        part = slice(done + 1, last + 1)
        self.out.white[part] = np.where(usual[:, :, None], white, np.nan)
        self.out.marginal[part] = np.where(usual[:, :, None], marginal, np.nan)
        counted = (usual == present).all(axis=1)
        scales = np.diagonal(whiteners, axis1=1, axis2=2)[counted][present[counted]]
        chosen = white[counted]
        self.out.log_likelihood += float(np.log(scales).sum() * white.shape[2] - 0.5 * np.vdot(chosen, chosen))

    def _score(self, z: FloatArray, inverse: FloatArray, gain: FloatArray, keep: FloatArray, rows: IntArray) -> None:
        """Add what a sample says about the variances by its own size, and move the derivatives past it."""
        count, replicas, full = len(self.variances), z.shape[1], len(rows) == len(gain)
        ds, columns = (self.dp, self.dp) if full else (self.dp[:, rows[:, None], rows], self.dp[:, :, rows])
        measured = self.measured[:, rows]
        ds = ds + measured[:, :, None] * np.eye(len(rows))
        size = inverse @ ds @ inverse.T
        flat = size.reshape(count, -1)
        first = len(self.terms)
        self.out.score[first:] += 0.5 * (flat @ (z @ z.T).reshape(-1) - replicas * size.trace(axis1=1, axis2=2))
        self.out.information[first:, first:] += 0.5 * replicas * (flat @ flat.T)
        u = inverse.T @ z
        moved = columns @ u - gain @ (ds @ u)  # (V, m, R)
        self.dx = self.dx - gain @ self.dx[rows] + moved.transpose(1, 0, 2).reshape(len(gain), -1)
        self.dp = keep @ self.dp @ keep.T + (gain * measured[:, None]) @ gain.T

    def _regressors(self, done: int, last: int, first: int, end: int, starts: FloatArray) -> FloatArray:
        """(intervals, m, K, R): derivatives of the prediction by the gains, given the state before each interval."""
        of, m, replicas = self.of, self.law.agents, starts.shape[2]
        found = np.zeros((last - done, m, len(self.terms), replicas))
        if not self.terms:
            return found
        interval, graph = of.stretches.interval[first:end] - done, of.stretches.graph[first:end]
        for g in np.unique(graph).tolist():
            at = np.flatnonzero(graph == g)
            linear, constant = self.rows[g]
            active = np.flatnonzero(linear.any(axis=1) | (constant != 0.0))
            before, after, weights = self.law.nodes(g, of.stretches.length[first:end][at])
            x = before @ (self.before[at] @ starts[interval[at]])[:, None]  # (B, q, m, R)
            pushed = linear[active] @ x + constant[active][:, None]  # (B, q, K, R)
            columns = (self.after[at][:, None] @ after)[:, :, :, self.target[active]] * weights[:, :, None, None]
            parts = np.einsum("bqik,bqkr->bikr", columns, pushed, optimize=True)
            _, again = np.unique(interval[at], return_index=True)
            number = np.arange(len(at)) - np.repeat(again, np.diff(np.append(again, len(at))))
            for place in range(int(number.max()) + 1):  # a graph may come several times in an interval
                here = np.flatnonzero(number == place)
                found[interval[at][here][:, None, None], np.arange(m)[:, None], active] += parts[here]
        found[np.abs(found) < TINY * of.spread] = 0.0
        return found

    def _gain_scores(
        self,
        phi: FloatArray,
        keeps: FloatArray,
        whiteners: FloatArray,
        white: FloatArray,
        tangents: FloatArray,
        pushed: FloatArray,
    ) -> None:
        """Add what a block of samples says about the gains, and about the variances by the mean of the innovations."""
        count, m = white.shape[:2]
        replicas, terms = white.shape[2], len(self.terms)
        predicted = np.empty((count, m, terms * replicas))
        flat = pushed.reshape(count, m, -1)
        for b in range(count):
            self.d = phi[b] @ self.d + flat[b]
            predicted[b] = self.d
            self.d = keeps[b] @ self.d
        predicted[np.abs(predicted) < TINY * self.of.spread] = 0.0
        self.d[np.abs(self.d) < TINY * self.of.spread] = 0.0
        both = np.concatenate(
            [
                (whiteners @ predicted).reshape(count, m, terms, replicas),
                tangents.reshape(count, m, len(self.variances), replicas),
            ],
            axis=2,
        ).transpose(0, 1, 3, 2)
        both = both.reshape(count * m * replicas, -1)
        self.out.score += white.reshape(-1) @ both
        self.out.information += both.T @ both

    def _check_held(self, k: int) -> None:
        """Note a held leader that is not at the reference though nothing disturbs its measurement."""
        off = np.abs(self.of.values[k]).max(axis=1) * (self.silent & self.of.present[k])
        size = HELD * max(self.of.spread, abs(self.law.reference))
        if self.out.off_reference is None and np.nanmax(off, initial=0.0) > size:
            agent = int(np.nanargmax(off))
            self.out.off_reference = k, agent, float(off[agent])


def parameters_of(m: int, noise: FloatArray) -> list[Variance]:
    """The variances of m agents with measurement noise of this size (m,)."""
    found = [Variance("process", i) for i in range(m)]
    if noise.any():
        found.append(Variance("measurement"))
        found += [Variance("measurement", i) for i in range(m) if m <= MOST_EACH]
    return found


def estimate_noise(of: Filter, most: int) -> tuple[float, float]:
    """Standard deviation of the measurement noise of all agents by maximum likelihood, and its standard error.

    Fisher's scoring on ``most`` samples, then one step on all; 0 and an upper bound's scale where the likelihood is
    largest at 0.
    """
    m = of.law.agents
    # Of each agent, from value to value: no two agents need to be measured at the same time.
    differences = np.concatenate(
        [np.diff(of.values[there, i], axis=0).ravel() for i, there in enumerate(of.present.T) if there.any()]
    )
    scale = (float(np.median(differences**2)) if len(differences) else 0.0) / 0.455 or of.spread**2
    variance = 0.25 * scale
    count = min(most, len(of.times))

    def scoring(samples: int) -> tuple[float, float]:
        """The step of the logarithm, and its information."""
        found = of.run(np.full(m, np.sqrt(variance)), most=samples)
        place = len(found.terms) + found.variances.index(Variance("measurement"))
        information = float(found.information[place, place])
        return (float(found.score[place]) / information if information else -1.0), information

    for _ in range(MOST_STEPS):
        step, information = scoring(count)
        variance *= float(np.clip(1.0 + step, 0.1, 10.0))
        if abs(step) < CONVERGED or variance < NOTHING * scale:
            break
    if variance < NOTHING * scale:
        return 0.0, float(np.sqrt(variance / np.sqrt(information))) if information else 0.0
    if count < len(of.times):
        step, information = scoring(len(of.times))
        variance *= float(np.clip(1.0 + step, 0.5, 2.0))
    return float(np.sqrt(variance)), float(np.sqrt(variance) / (2.0 * np.sqrt(information)))
