# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Innovations and system error of a log whose graphs are not known: interacting multiple models.

One Kalman filter for each graph (Blom and Bar-Shalom, IEEE Trans. Automatic Control 33 (1988)): given the current
graph g, x is taken to be normal, with mean x_g and covariance P_g, and g has the probability mu_g. Between samples
these move as the moments of the Markov jump linear system do, in substeps of half a change of the chain, exp(-Z_g s),
and the other half (Strang); so mean and covariance of x given the graph are exact, and only the normal shape is an
approximation. A sample's density is a mixture of n normal ones. Each value, given those before it, becomes a standard
normal number by its distribution function (Rosenblatt, Annals of Mathematical Statistics 23 (1952)).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri, stdtr

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.markov_chain import DrawnSchedule, MarkovChain
from msg_analysis.inference.estimates import Estimate, estimate
from msg_analysis.inference.innovations import DIFFUSE, WORK, Filter, Innovations, Variance, parameters_of
from msg_analysis.inference.intervals import ContinuousLaw, IntervalLaw
from msg_analysis.inference.regression import Term

MOST_GRAPHS = 16
SUBSTEP = 0.25  # most switches in a substep, in the mean, and size of what the splitting leaves out
MOST_SUBSTEPS = 400  # of an interval
MOST_PARAMETERS = 200  # gains of links times graphs; of more, each agent has one gain
STEP = 1e-6  # relative change of a parameter for its derivative
BLOCK = 256  # samples, at most
LEAST = 1e-300
BATCHES = 20  # of a log in the steady state


class HiddenFilter(Filter):
    """A filter of the deviations from the reference and of the graphs."""

    def __init__(self, law: IntervalLaw, times: FloatArray, states: FloatArray) -> None:
        super().__init__(law, times, states, times[:1], np.zeros(1, dtype=np.int64))
        self.lengths = self.stretches.length  # (N - 1,) of the intervals, in the unit of the law
        chain = law.experiment.switching_law
        assert isinstance(chain, MarkovChain)
        self.chain, self.continuous = chain, isinstance(law, ContinuousLaw)
        self.substeps = substeps(law, self.lengths)

    def _pass(self, noise: FloatArray, terms: list[Term], variances: bool, keep: bool, most: int) -> Innovations:
        return _Pass(self, noise, terms, variances, keep, most).run()

    def terms(self) -> list[Term]:
        """As ``IntervalLaw.terms``, fewer."""
        terms = self.law.terms()
        if len(terms) * self.law.modes > MOST_PARAMETERS:
            terms = self.law.terms(most=0)
        return terms

    def change(self, length: FloatArray, faster: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """(U, n, n) transitions of the graph before and after the motion in substeps of lengths (U,)."""
        n = self.law.modes
        if self.continuous:
            half = np.array([self.chain.transition(s * faster / 2.0) for s in length.tolist()])
            return half, half
        if self.chain.time == "continuous":
            after = self.chain.transition(self.law.unit * faster)
        else:
            after = np.eye(n) + faster * (self.chain.matrix - np.eye(n))
        shape = len(length), n, n
        return np.broadcast_to(np.eye(n), shape), np.broadcast_to(after, shape)

    def motion(self, law: IntervalLaw, length: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(U, n, m, m) Phi and Q of all graphs over substeps of lengths (U,)."""
        both = [law.over(g, length, apart=False)[:2] for g in range(law.modes)]
        return np.stack([phi for phi, _ in both], axis=1), np.stack([q for _, q in both], axis=1)

    def shorter(self, first: int, last: int) -> tuple[FloatArray, IntArray]:
        """Lengths (U,) of the substeps of some intervals, and which of them each has."""
        return np.unique(self.lengths[first:last] / self.substeps[first:last], return_inverse=True)


def substeps(law: IntervalLaw, lengths: FloatArray) -> IntArray:
    """(N - 1,) numbers of substeps of intervals of these lengths."""
    if not isinstance(law, ContinuousLaw):
        return lengths.astype(np.int64)
    rate = float(-np.diag(law.experiment.chain.matrix).min())
    norm = max(float(np.abs(law.drift(g)).sum(axis=1).max()) for g in range(law.modes))
    return np.asarray(np.maximum(1, np.ceil(lengths * max(rate, np.cbrt(rate * norm**2)) / SUBSTEP)), dtype=np.int64)


class _Pass:
    """One pass over the samples, for the law and B - 1 laws of which each has one parameter changed a little."""

    def __init__(
        self, of: HiddenFilter, noise: FloatArray, terms: list[Term], variances: bool, keep: bool, most: int
    ) -> None:
        self.of, self.law, self.count = of, of.law, most
        m, n, coordinates = of.law.agents, of.law.modes, of.values.shape[2]
        self.terms = terms
        self.variances = [*parameters_of(m, noise), Variance("switching")] if variances else []
        self.parameters = len(terms) + len(self.variances)
        self.size = m * coordinates
        scale = math.sqrt(float(np.abs(of.law.noise).max())) or 1.0
        weights = [scale if term.kind == "constant" else abs(term.weight) or 1.0 for term in terms]
        self.steps = STEP * np.array([*weights, *(1.0 for _ in self.variances)])
        self.laws = [
            of.law
            if term.kind == "constant"
            else of.law.changed(terms, self.steps[: len(terms)] * (np.arange(len(terms)) == k))
            for k, term in enumerate(terms)
        ]
        self.noise = np.tile(noise**2, (1 + self.parameters, 1))
        for place, one in enumerate(self.variances, start=1 + len(terms)):
            if one.kind == "measurement":
                self.noise[place, slice(None) if one.agent is None else one.agent] *= 1.0 + STEP
        self.noise = np.tile(self.noise, coordinates)  # (B, M), M = R m
        self.silent = of.law.held & (noise == 0.0)
        flops = 14.0 * (1 + self.parameters) * n * (self.size**3 + 1000) * float(np.mean(of.substeps))
        self.scored = min(most, int(WORK / flops) + 2) if self.parameters else most
        shape = most, m, coordinates
        self.out = Innovations(
            white=np.full(shape, np.nan), marginal=np.full(shape, np.nan), filtered=np.zeros(shape),
            uncertainty=np.zeros((most, m)), terms=terms, variances=self.variances, score=np.zeros(self.parameters),
            information=np.zeros((self.parameters, self.parameters)), log_likelihood=0.0, samples=most - 1,
            scored=self.scored - 1,
        )  # fmt: skip
        if keep:
            self.out.moments, self.out.probabilities = np.zeros((most, n, m, m)), np.zeros((most, n))

    def _begin(self) -> None:
        of, n, coordinates = self.of, self.law.modes, self.of.values.shape[2]
        b = 1 + self.parameters
        there = of.present[0] | self.law.held
        self.seen = there.copy()
        x = np.where(of.present[0][:, None] & ~self.law.held[:, None], of.values[0], 0.0)
        self.x: FloatArray = np.tile(x.T.reshape(-1), (b, n, 1))
        free, known = np.tile(~self.law.held, coordinates), np.tile(there, coordinates)
        self.p: FloatArray = np.zeros((b, n, self.size, self.size))
        each = np.arange(self.size)
        self.p[:, :, each, each] = (np.where(known, self.noise, (DIFFUSE * of.spread) ** 2) * free)[:, None]
        self.mu: FloatArray = np.tile(of.chain.stationary, (b, 1))
        self._keep(0)

    def run(self) -> Innovations:
        self._begin()
        block = max(8, min(BLOCK, int(4e6 / ((1 + self.parameters) * self.law.modes * self.law.agents**2))))
        done = 0
        while done < self.count - 1:
            tell("innovations", done, self.count)
            if done + 1 >= self.scored and len(self.mu) > 1:
                self.mu, self.x, self.p, self.noise = self.mu[:1], self.x[:1], self.p[:1], self.noise[:1]
            end = self.scored - 1 if done + 1 < self.scored else self.count - 1
            last = min(done + block, end)
            self._block(done, last)
            done = last
        return self.out

    def _keep(self, k: int) -> None:
        """The filtered state, and its second moments."""
        m, out = self.law.agents, self.out
        mean = self.mu[0] @ self.x[0]
        out.filtered[k] = mean.reshape(-1, m).T
        if out.moments is None or out.probabilities is None:
            return
        second = self.p[0] + self.x[0][:, :, None] * self.x[0][:, None]
        blocks = [slice(r * m, (r + 1) * m) for r in range(self.size // m)]
        out.moments[k] = self.mu[0][:, None, None] * sum(second[:, at, at] for at in blocks)
        out.probabilities[k] = self.mu[0]

    def _matrices(self, done: int, last: int) -> None:
        """Of the substeps in the intervals done..last-1, for all B laws."""
        of, b, m = self.of, len(self.mu), self.law.agents
        length, self.which = of.shorter(done, last)
        phi, q = of.motion(self.law, length)
        phi, q = np.repeat(phi[:, None], b, axis=1), np.repeat(q[:, None], b, axis=1)
        push = np.zeros((*phi.shape[:3], m))
        before, after = of.change(length)
        before, after = np.repeat(before[:, None], b, axis=1), np.repeat(after[:, None], b, axis=1)
        if b > 1:
            for place, (term, law) in enumerate(zip(self.terms, self.laws, strict=True), start=1):
                if term.kind != "constant":
                    phi[:, place], q[:, place] = of.motion(law, length)
                    continue
                for g in range(law.modes):
                    _, left, weights = law.nodes(g, np.maximum(length, 1.0) if not of.continuous else length)
                    push[:, place, g] = self.steps[place - 1] * np.einsum("uqi,uq->ui", left[..., term.agent], weights)
            for place, one in enumerate(self.variances, start=1 + len(self.terms)):
                if one.kind == "process":
                    for g in range(self.law.modes):
                        q[:, place, g] += STEP * self.law.over(g, length)[2][:, one.agent]
                elif one.kind == "switching":
                    before[:, place], after[:, place] = of.change(length, 1.0 + STEP)
        coordinates = np.eye(self.size // m)
        self.phi, self.q = np.kron(coordinates, phi), np.kron(coordinates, q)
        self.push = np.tile(push, self.size // m)
        self.before, self.after, self.both = before, after, after @ before

    def _block(self, done: int, last: int) -> None:
        """Samples done + 1..last."""
        of, m, n, b, size = self.of, self.law.agents, self.law.modes, len(self.mu), self.size
        self._matrices(done, last)
        count = last - done
        prior = np.empty((count, b, n))
        terms = np.zeros((count, b, n, size))  # logarithms of the densities of the values
        white, own = np.full((2, count, n, size), np.nan)
        usable = np.ones((count, size), bool)
        for k in range(done + 1, last + 1):
            place, u = k - done - 1, self.which[k - done - 1]
            self._move(u, int(of.substeps[k - 1]))
            prior[place] = self.mu
            there = of.present[k] & ~self.silent
            rows = np.flatnonzero(np.tile(there, size // m))
            if len(rows):
                if len(rows) == size:
                    columns, part, mean, noise = self.p, self.p, self.x, self.noise
                else:
                    columns, mean, noise = self.p[..., rows], self.x[..., rows], self.noise[:, rows]
                    part = columns[..., rows, :]
                s = part.copy()
                each = np.arange(len(rows))
                s[..., each, each] += noise[:, None]
                try:
                    inverse = np.linalg.inv(np.linalg.cholesky(s))
                except np.linalg.LinAlgError:
                    raise self.of.singular(s[0].min(axis=0), rows % m, k) from None
                e = of.values[k].T.reshape(-1)[rows] - mean
                z = (inverse @ e[..., None])[..., 0]
                gain = columns @ inverse.swapaxes(-1, -2) @ inverse
                density = np.log(np.diagonal(inverse, axis1=-2, axis2=-1)) - 0.5 * z**2
                terms[place][..., rows] = density
                white[place][:, rows] = z[0]
                own[place][:, rows] = e[0] / np.sqrt(np.diagonal(s[0], axis1=-2, axis2=-1))
                new = there & ~self.seen
                if new.any():
                    usable[place] = False
                    self.seen |= new
                    white[place][:, np.tile(new, size // m)] = own[place][:, np.tile(new, size // m)] = np.nan
                keep = np.tile(np.eye(size), (b, n, 1, 1))
                keep[..., rows] -= gain
                self.x = self.x + (gain @ e[..., None])[..., 0]
                p = keep @ self.p @ keep.swapaxes(-1, -2) + (gain * noise[:, None, None]) @ gain.swapaxes(-1, -2)
                self.p = (p + p.swapaxes(-1, -2)) / 2.0
                weight = np.log(np.maximum(self.mu, LEAST)) + density.sum(axis=-1)
                weight = np.exp(weight - weight.max(axis=-1, keepdims=True))
                self.mu = weight / weight.sum(axis=-1, keepdims=True)
            # Only now: the sample tells the graphs apart by the motion that they made.
            self._mix(self.after[u])
            self._keep(k)
        self._evaluate(done, last, prior, terms, white, own, usable)

    def _move(self, u: int, count: int) -> None:
        """The moments over an interval, before the last change of the graph."""
        phi, q, push = self.phi[u], self.q[u], self.push[u]
        right = phi.swapaxes(-1, -2)
        for step in range(count):
            if step or self.of.continuous:
                self._mix(self.both[u] if step else self.before[u])
            self.x = (phi @ self.x[..., None])[..., 0] + push
            self.p = phi @ self.p @ right + q

    def _mix(self, change: FloatArray) -> None:
        """A change of the graph by (B, n, n)."""
        joint = self.mu[..., None] * change
        self.mu = joint.sum(axis=1)
        share = (joint / np.maximum(self.mu, LEAST)[:, None]).transpose(0, 2, 1)  # (B, to, from)
        mean = share @ self.x
        off = self.x[:, None] - mean[:, :, None]
        spread = (off * share[..., None]).swapaxes(-1, -2) @ off
        b, n, size = self.x.shape
        self.p = (share @ self.p.reshape(b, n, -1)).reshape(b, n, size, size) + spread
        self.x = mean

    def _evaluate(
        self,
        done: int,
        last: int,
        prior: FloatArray,
        terms: FloatArray,
        white: FloatArray,
        own: FloatArray,
        usable: FloatArray,
    ) -> None:
        """Normalised innovations, likelihood and scores of a block."""
        out, m, count = self.out, self.law.agents, last - done
        prior = np.log(np.maximum(prior, LEAST))
        ends = prior[..., None] + np.cumsum(terms, axis=-1)
        begins = ends - terms
        part, shape = slice(done + 1, last + 1), (count, self.size // m, m)
        for into, z, weights in ((out.white, white, begins[:, 0]), (out.marginal, own, prior[:, 0, :, None])):
            weights = weights - logsumexp(weights, axis=1, keepdims=True)
            below, above = (np.exp(weights + np.log(np.maximum(ndtr(s * z), LEAST))).sum(axis=1) for s in (1, -1))
            normal = np.where(below < 0.5, ndtri(below), -ndtri(above))
            into[part] = normal.reshape(shape).transpose(0, 2, 1)
        density = np.where(usable[:, None], logsumexp(ends, axis=2) - logsumexp(begins, axis=2), 0.0)  # (count, B, M)
        out.log_likelihood += float(density[:, 0].sum())
        if density.shape[1] > 1:
            slopes = (density[:, 1:] - density[:, :1]) / self.steps[:, None]
            slopes = slopes.transpose(0, 2, 1).reshape(-1, self.parameters)
            out.score += slopes.sum(axis=0)
            out.information += slopes.T @ slopes


def hidden_system_error(of: HiddenFilter, found: Innovations) -> Estimate | None:
    """Mean of E[error(k) | log up to k], and its expectation over all paths given the first samples; None: too few.

    E[sum of the errors after k | x(k), g(k)] = x^T V_g x + c_g backwards from the end, by the adjoint of the motion of
    the moments, so what each sample adds to it is a martingale difference D(k). The variance is the sum of D(k)^2.
    """
    assert found.moments is not None
    assert found.probabilities is not None
    count, n, m, _ = found.moments.shape
    coordinates = of.values.shape[2]
    begin = int(np.argmax(np.logical_or.accumulate(of.present | of.law.held, axis=0).all(axis=1)))
    if count - begin < 3:
        return None
    form = np.eye(m) - (1.0 / m if of.law.experiment.problem == "consensus" else 0.0)
    value, constant = np.broadcast_to(form, (n, m, m)), np.zeros(n)
    errors = np.einsum("kgij,ij->k", found.moments[begin:], form)
    differences, end = [], count - 1
    while end > begin:
        first = max(begin, end - BLOCK)
        length, which = of.shorter(first, end)
        phi, q = of.motion(of.law, length)
        before, after = of.change(length)
        for k in range(end, first, -1):
            u, seen, known = which[k - 1 - first], found.moments[k], found.probabilities[k]
            reached = float(np.vdot(value, seen) + constant @ known)
            for _ in range(int(of.substeps[k - 1])):
                value, constant = np.tensordot(after[u], value, axes=1), after[u] @ constant
                constant = constant + coordinates * np.einsum("gij,gji->g", value, q[u])
                value = phi[u].transpose(0, 2, 1) @ value @ phi[u]
                value, constant = np.tensordot(before[u], value, axes=1), before[u] @ constant
            expected = float(np.vdot(value, found.moments[k - 1]) + constant @ found.probabilities[k - 1])
            differences.append(reached - expected)
            value = value + form
        end = first
    samples = (count - begin) * coordinates
    measured, martingale = float(errors.sum()) / samples, np.array(differences) / samples
    return estimate(measured, measured - float(martingale.sum()), float(np.sqrt((martingale**2).sum())), measured)


def why_no_filter(law: IntervalLaw, times: FloatArray) -> str | None:
    """Why a hidden path cannot be followed; None: it can. InputError: the law has no other path than the given one."""
    switching = law.experiment.switching_law
    if not isinstance(switching, MarkovChain):
        if not isinstance(switching, DrawnSchedule):
            raise InputError(
                f"{law.experiment.source}: switching: a given sequence of graphs is not hidden: expected a chain, or "
                "the path in the map"
            )
        return "the graphs of the law are not a chain"
    if law.modes > MOST_GRAPHS:
        return f"the path of {law.modes} hidden graphs is not followed, of at most {MOST_GRAPHS} it is"
    most = int(substeps(law, np.diff(times) / law.unit).max())
    if most > MOST_SUBSTEPS:
        return "the hidden graphs switch too often between two samples"
    return None


def long_run_error(law: Experiment, sampled: str, states: FloatArray, noise: FloatArray) -> Estimate:
    """The system error of the samples with all agents, next to its mean over all paths in the steady state.

    The standard error is that of the means of ``BATCHES`` parts of the log, with Student's distribution.
    """
    prediction = law.predict()
    predicted = (prediction.emulated if sampled == "steps" else prediction.continuous).system_error
    values = states - law.reference
    whole = values[~np.isnan(values).any(axis=(1, 2))]
    if len(whole) < 10 * BATCHES:
        raise InputError(f"{len(whole)} samples with all agents: expected at least {10 * BATCHES}: record for longer")
    form = np.eye(law.agents)
    if law.problem == "consensus":
        whole, form = whole - whole.mean(axis=1, keepdims=True), form - 1.0 / law.agents
    errors = (whole**2).sum(axis=1).mean(axis=1) - float(np.diag(form) @ noise**2)
    means = np.array([part.mean() for part in np.array_split(errors, BATCHES)])
    measured, error = float(means.mean()), float(means.std(ddof=1)) / math.sqrt(BATCHES)
    if np.ptp(errors) == 0.0:
        raise InputError("states: the same error in all samples: expected states that move")
    z = (measured - predicted) / error
    return Estimate(measured, predicted, error, z, 2.0 * float(stdtr(BATCHES - 1, -abs(z))))
