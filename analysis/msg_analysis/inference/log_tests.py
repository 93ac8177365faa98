# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Tests of the innovations of a log, of its path, and of its errors given the path; and the causes of a rejection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.inference.candidates import Candidate, Cause, Selected, gain_classes, numbers_text, select
from msg_analysis.inference.counts import Transitions
from msg_analysis.inference.estimates import Estimate, estimate
from msg_analysis.inference.innovations import Filter, Innovations, Variance
from msg_analysis.inference.messages import whose_gain
from msg_analysis.inference.residuals import LAGS
from msg_analysis.inference.statistics import (
    chi2_below,
    chi2_tail,
    covariance_statistic,
    direction_p,
    log_normal_tail,
    pseudo_inverse,
    quadratic_form,
)

FEWEST_PAIRS = 20  # of innovations that a lag is tested with
SWAP_WORK = 40_000  # samples filtered with exchanged agents
MISSING = 0.3  # factor of the gain of a link below which it is said to be missing
MOST_SWAPS = 400  # pairs of agents


def covariance_p(found: Innovations) -> float | None:
    """All second moments of the innovations of samples with all agents, likelihood-ratio test."""
    used = [i for i in range(found.white.shape[1]) if not np.isnan(found.white[:, i]).all()]
    white = found.white[:, used]
    whole = white[~np.isnan(white).any(axis=(1, 2))]
    samples = whole.shape[0] * whole.shape[2]
    if not used or samples <= 2 * len(used):
        return None
    flat = whole.transpose(1, 0, 2).reshape(len(used), -1)
    statistic, dof = covariance_statistic(flat @ flat.T, samples)
    return float(chi2_tail(statistic, dof))


def size_p(found: Innovations) -> list[tuple[float, float] | None]:
    """For each agent the mean square of its standardised innovations, and its p-value; None: never measured."""
    results: list[tuple[float, float] | None] = []
    for i in range(found.marginal.shape[1]):
        values = found.marginal[:, i][~np.isnan(found.marginal[:, i])]
        if not values.size:
            results.append(None)
            continue
        total = float(values @ values)
        p = 2.0 * float(min(chi2_tail(total, values.size), chi2_below(total, values.size)))
        results.append((total / values.size, min(p, 1.0)))
    return results


def whiteness_p(found: Innovations) -> float | None:
    """Correlation of innovations up to ``LAGS`` samples apart, of all agents, and between coordinates, chi-square."""
    # As ``WhitenessSums``, where agents may be missing.
    there = np.asarray(~np.isnan(found.white).any(axis=2))
    white = np.where(there[:, :, None], found.white, 0.0)
    counts = there.sum(axis=0) * found.white.shape[2]
    usable = np.flatnonzero(counts > FEWEST_PAIRS)
    if not len(usable):
        return None
    white, both = white[:, usable], there[:, usable].astype(float)
    size = np.einsum("kir,kir->i", white, white) / counts[usable]
    chi2, dof = 0.0, 0
    for lag in range(1, min(LAGS, len(white) - 1) + 1):
        products = np.tensordot(white[lag:], white[:-lag], axes=([0, 2], [0, 2]))
        pairs = both[lag:].T @ both[:-lag] * found.white.shape[2]
        tested = pairs > FEWEST_PAIRS
        chi2 += float((products**2 / np.outer(size, size))[tested] @ (1.0 / pairs[tested]))
        dof += int(tested.sum())
    replicas = white.shape[2]
    if replicas > 1:
        together = ((white.sum(axis=2) ** 2 - (white**2).sum(axis=2)) / 2.0).sum(axis=0)
        chi2 += float((together**2 / size**2 / (both.sum(axis=0) * replicas * (replicas - 1) / 2.0)).sum())
        dof += len(usable)
    return float(chi2_tail(chi2, dof)) if dof else None


def largest_p(found: Innovations) -> tuple[float, int, int] | None:
    """Of the largest standardised innovation, for all together; its sample and agent."""
    sizes = np.nan_to_num(np.abs(found.marginal)).max(axis=2)
    count = int((~np.isnan(found.marginal)).sum())
    if not count:
        return None
    k, i = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    log_p = math.log(2.0 * count) + float(log_normal_tail(sizes[k, i]))
    return min(1.0, math.exp(min(log_p, 0.0))), int(k), int(i)


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Score and information of the gains (K) and variances (V), without what an estimated noise may explain."""

    found: Innovations
    score: FloatArray  # (K + V,)
    information: FloatArray  # (K + V, K + V)

    @classmethod
    def of(cls, found: Innovations, *, estimated: bool) -> Parameters:
        """``estimated``: the common measurement noise is that of the largest likelihood, and no parameter."""
        score, information = found.score.copy(), found.information.copy()
        common = Variance("measurement")
        if estimated and common in found.variances:
            r = len(found.terms) + found.variances.index(common)
            if information[r, r] > 0.0:
                column = information[:, r].copy() / information[r, r]
                score -= column * score[r]
                information -= np.outer(column, information[r])
            score[r], information[r], information[:, r] = 0.0, 0.0, 0.0
        return cls(found, score, information)

    @property
    def gains(self) -> FloatArray:
        """(K + V,): all gains larger by the share 1."""
        weights = [term.weight if term.kind in ("link", "pull") else 0.0 for term in self.found.terms]
        return np.array(weights + [0.0] * len(self.found.variances))

    def variance(self, *wanted: Variance) -> FloatArray:
        """(K + V,): the logarithms of these variances larger by 1."""
        return np.array([0.0] * len(self.found.terms) + [float(one in wanted) for one in self.found.variances])

    @property
    def process(self) -> FloatArray:
        """(K + V,): the logarithms of all noise variances larger by 1."""
        return self.variance(*(one for one in self.found.variances if one.kind == "process"))

    @property
    def explained(self) -> float:
        """How much the logarithm of the likelihood grows with all of them, in quadratic approximation."""
        return 0.5 * quadratic_form(self.score, self.information)[0]

    def joint_p(self, part: slice) -> float | None:
        """Of all gains, or of all variances."""
        chi2, dof = quadratic_form(self.score[part], self.information[part, part])
        return float(chi2_tail(chi2, dof)) if dof else None

    def direction_p(self, direction: FloatArray) -> float | None:
        """Of a change along one direction."""
        return direction_p(direction, self.score, self.information)

    def factor(self, directions: Sequence[FloatArray]) -> list[tuple[float, float] | None]:
        """One more than the change along each of some directions together, and its standard error."""
        d = np.array(directions)
        information = d @ self.information @ d.T
        inverse = pseudo_inverse(information)
        values, errors = inverse @ (d @ self.score), np.sqrt(np.diag(inverse).clip(0.0))
        both = zip(values.tolist(), errors.tolist(), strict=True)
        return [(1.0 + value, error) if error > 0.0 else None for value, error in both]

    def classes(self) -> list[list[Candidate]]:
        """Candidates of causes."""
        found, m = self.found, self.found.white.shape[1]
        more = np.zeros(len(found.variances))
        gains = [
            [Candidate(one.part, one.what, np.concatenate([one.direction, more])) for one in each]
            for each in gain_classes(found.terms)
        ]
        rates = Candidate("switching", None, self.variance(Variance("switching")))
        process = [Candidate("process", i, self.variance(Variance("process", i))) for i in range(m)]
        measured = [
            Candidate("measurement", one.agent, self.variance(one))
            for one in found.variances
            if one.kind == "measurement" and one.agent is not None
        ]
        variances = [
            process,
            [Candidate("process", None, self.process)],
            measured,
            [Candidate("measurement", None, self.variance(Variance("measurement")))],
            [rates],
        ]
        return [*gains, *(each for each in variances if any(one.direction.any() for one in each))]


def gain_words(one: Selected, law: Experiment, unit: float) -> Cause:
    """The cause of a change that was found; ``unit``: of time, in which an offset acts once."""
    part, what = one.part, one.what
    (low, high), p = one.interval, math.exp(one.log_p)
    factor, interval = 1.0 + one.estimate, (1.0 + low, 1.0 + high)
    if part in ("process", "measurement"):
        agent = None if what is None else what + 1
        kind = "noise" if part == "process" else "measurement_noise"
        name = "noise variance" if part == "process" else "variance of the measurement noise"
        whose = f"the {name} of all agents" if agent is None else f"agent {agent}'s {name}"
        file = "law" if part == "process" else "map"
        interval = max(interval[0], 0.0), interval[1]
        words = f"{whose} is {numbers_text(factor, interval)} times what the {file} says"
        return Cause(kind, words, agent, None, None, factor, interval, 1.0, p, log_p=one.log_p)
    if part == "switching":
        interval = max(interval[0], 0.0), interval[1]
        words = f"the hidden graphs seem to switch {numbers_text(factor, interval)} times as often as the law says"
        return Cause("rate", words, None, None, None, factor, interval, 1.0, p, log_p=one.log_p)
    if part == "reference":
        at = law.reference
        value, interval = at + one.estimate, (at + low, at + high)
        agent, which = (None, "the leaders are") if what is None else (what + 1, f"agent {what + 1} is")
        words = f"{which} pulled to {numbers_text(value, interval)}, not to the reference {at:g}"
        return Cause("reference", words, agent, None, None, value, interval, at, p, log_p=one.log_p)
    if part == "offset":
        value, interval = one.estimate / unit, (low / unit, high / unit)
        words = f"agent {what + 1} has an additional drift of {numbers_text(value, interval)} per unit of time"
        return Cause("offset", words, what + 1, None, None, value, interval, 0.0, p, log_p=one.log_p)
    whose, agent, link, graph = whose_gain(part, what)
    where_to = None if graph is None else law.graph_list[graph].name
    where = "" if where_to is None else f" in graph {where_to}"
    words = f"{whose}{where} is {numbers_text(factor, interval)} times what the law says"
    if part in ("link", "edge") and interval[1] < MISSING:
        words += ": it seems to be missing"
    return Cause("gain", words, agent, link, where_to, factor, interval, 1.0, p, log_p=one.log_p)


def parameter_causes(
    parameters: Parameters, law: Experiment, unit: float, families: int, level: float
) -> tuple[list[Cause], FloatArray]:
    """What is wrong with gains and variances, and (K,) by how much the gains are larger, all causes together."""
    classes = parameters.classes()
    selected, change = select(parameters.score, parameters.information, classes, families + len(classes), level)
    return [gain_words(one, law, unit) for one in selected], change[: len(parameters.found.terms)]


def swapped(of: Filter, noise: FloatArray, families: int) -> tuple[Cause, float] | None:
    """Two agents that the log has exchanged, and the growth of the logarithm of the likelihood, for all samples.

    The ratio of two likelihoods has the mean 1 under the law, so its inverse bounds a p-value.
    """
    m = of.law.agents
    pairs = [(i, j) for i in range(m) for j in range(i + 1, m)]
    if not 0 < len(pairs) <= MOST_SWAPS or (of.present.sum(axis=0) == 0).any():
        return None
    count = min(len(of.times), max(200, SWAP_WORK // len(pairs)))

    def likelihood(order: list[int]) -> float:
        return of.exchanged(order).run(noise[order], variances=False, most=count).log_likelihood

    here = likelihood(list(range(m)))
    best, pair = -math.inf, pairs[0]
    for i, j in pairs:
        order = list(range(m))
        order[i], order[j] = j, i
        found = likelihood(order) - here
        if found > best:
            best, pair = found, (i, j)
    log_p = math.log(len(pairs) * families) - best
    a, b = pair[0] + 1, pair[1] + 1
    words = f"agents {a} and {b} are exchanged: the map gives each the states of the other"
    cause = Cause("swapped", words, link=(a, b), p=math.exp(min(log_p, 0.0)), log_p=min(log_p, 0.0))
    return cause, best * len(of.times) / count


@dataclass(frozen=True, slots=True, eq=False)
class PathTest:
    """The switches of a path next to the chain."""

    counts: IntArray  # (n, n) switches
    expected: FloatArray  # (n, n) given the time in each graph
    p: float | None
    cause: Cause | None = None

    @property
    def switches(self) -> int:
        """Of all kinds."""
        return int(self.counts.sum())


def path_test(
    law: Experiment, starts: FloatArray, graphs: IntArray, span: tuple[float, float], steps: bool
) -> PathTest | None:
    """Test of the switches between two times; None where the law has no chain, or only one graph."""
    chain, n = law.switching_law, len(law.graph_list)
    if not isinstance(chain, MarkovChain) or n < 2:
        return None
    first = max(int(np.searchsorted(starts, span[0], side="right")) - 1, 0)
    last = int(np.searchsorted(starts, span[1], side="left"))
    order, begins = graphs[first:last], np.maximum(starts[first:last], span[0])
    if steps:
        dt = law.step_length
        edges = np.rint((np.append(begins, span[1]) - span[0]) / dt).astype(np.int64)
        modes = np.repeat(order, np.diff(edges))
        tested = Transitions.of(modes, n).test(chain.transition(dt))
        moved = ~np.eye(n, dtype=bool)
        return PathTest(tested.counts * moved, tested.expected * moved, tested.p)
    held = np.bincount(order, np.diff(np.append(begins, span[1])), n)
    counts = np.zeros((n, n), np.int64)
    np.add.at(counts, (order[:-1], order[1:]), 1)
    expected = np.asarray(held[:, None] * np.where(np.eye(n, dtype=bool), 0.0, chain.matrix), dtype=float)
    possible = expected > 0.0
    if counts[~possible].any():
        return PathTest(counts, expected, 0.0, _rate_cause(counts, expected, law, np.argwhere(counts * ~possible)[0]))
    # Given the time in the graphs, the switches of a kind are Poisson in good approximation.
    cells = np.argwhere(possible)
    p = [_poisson_p(int(counts.sum()), float(expected.sum()))]
    p += [_poisson_p(int(counts[g, h]), float(expected[g, h])) for g, h in cells] if len(cells) > 1 else []
    alone = p[1:] or p
    joint = min(1.0, 2.0 * min(p[0], len(alone) * min(alone)))
    whole = p[0] <= len(alone) * min(alone)
    cause = _rate_cause(counts, expected, law, None if whole else cells[int(np.argmin(alone))], joint)
    return PathTest(counts, expected, joint, cause)


def _poisson_p(count: int, mean: float) -> float:
    """Two-sided, of a Poisson number: twice the smaller tail, of which the count itself is half."""
    here = math.exp(count * math.log(mean) - mean - special.gammaln(count + 1)) if mean > 0 else float(count == 0)
    below = float(special.pdtr(count, mean)) - here / 2.0
    above = 1.0 - below if below < 0.5 else float(special.pdtrc(count, mean)) + here / 2.0
    return min(1.0, 2.0 * max(min(below, above), 0.0))


def _rate_cause(
    counts: IntArray, expected: FloatArray, law: Experiment, cell: IntArray | None, p: float = 0.0
) -> Cause:
    count, mean = (counts.sum(), expected.sum()) if cell is None else (counts[tuple(cell)], expected[tuple(cell)])
    names = [graph.name for graph in law.graph_list]
    what = "switches of the graphs" if cell is None else f"switches from {names[cell[0]]} to {names[cell[1]]}"
    graph = None if cell is None else [names[cell[0]], names[cell[1]]]
    if mean == 0.0:
        words = f"{what} happen, which the law excludes"
        return Cause("rate", words, graph=graph, expected=0.0, p=0.0)
    low, high = special.gammaincinv(count, 0.025) if count else 0.0, special.gammaincinv(count + 1, 0.975)
    factor, interval = float(count / mean), (float(low / mean), float(high / mean))
    words = f"{what} are {numbers_text(factor, interval)} times as frequent as the law says"
    log_p = math.log(p) if p > 0.0 else -700.0
    return Cause("rate", words, None, None, graph, factor, interval, 1.0, p, log_p=log_p)


def system_error(of: Filter, found: Innovations) -> Estimate | None:
    """Mean of E[error(k) | log up to k] over the samples, and its expectation given the path; None: too few samples.

    The filtered states x(k) move by x(k) = Phi x(k-1) + w, w ~ N(0, G(k)) with known G, so the sum over k of
    x(k)^T H x(k) differs from its expectation by the sum of martingale differences D(k) = 2 (Phi x)^T Y w + w^T Y w -
    tr(Y G), with Y(k-1) = H + Phi^T Y(k) Phi backwards from the end.
    """
    assert found.maps is not None
    assert found.gains is not None
    count, m, replicas = found.filtered.shape
    begin = int(np.argmax(np.logical_or.accumulate(of.present | of.law.held, axis=0).all(axis=1)))
    if count - begin < 3:
        return None
    consensus = of.law.experiment.problem == "consensus"
    form = np.eye(m) - (1.0 / m if consensus else 0.0)
    value, total, variance = form, 0.0, 0.0
    for k in range(count - 1, begin, -1):
        phi, gain = found.maps[k], found.gains[k]
        expected = form @ (phi @ found.filtered[k - 1])
        w = form @ (found.filtered[k] - phi @ found.filtered[k - 1])
        pushed = value @ expected
        spread = value @ gain
        total += float(2.0 * np.vdot(pushed, w) + np.vdot(w, value @ w)) - replicas * float(np.trace(spread))
        square = float(np.vdot(spread, spread.T))
        variance += 4.0 * float(np.vdot(pushed, gain @ pushed)) + 2.0 * replicas * square
        value = form + phi.T @ value @ phi
    samples = (count - begin) * replicas
    deviation = form @ found.filtered[begin:]
    measured = float((deviation**2).sum()) / samples + float(found.uncertainty[begin:].sum()) / (count - begin)
    return estimate(measured, measured - total / samples, math.sqrt(max(variance, 0.0)) / samples, measured)
