# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Candidate causes of a disagreement, and their words.

Every group has parameters with a score s and its information J, so that a change c of them gives s the mean J c.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.common.text import HALF_WIDTH_95, percent
from msg_analysis.experiment.markov_chain import MarkovChain
from msg_analysis.inference.counts import LossTally
from msg_analysis.inference.regression import Term
from msg_analysis.inference.residuals import ResidualSums
from msg_analysis.inference.statistics import chi2_quantile, log_normal_tail, pseudo_inverse

MOST = 6  # causes searched for in one group
SAME = 1e-9  # share of a candidate's information that must be left after removing what the others explain


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A change of the law along one direction."""

    part: str  # with ``what``, the meaning, for the caller
    what: Any
    direction: FloatArray  # (K,) change of the parameters for a change by 1


@dataclass(frozen=True, slots=True)
class Selected:
    """A change that was found."""

    part: str  # of the candidate, as ``what``
    what: Any
    estimate: float  # of the change, given all others that were found
    standard_error: float
    log_p: float  # logarithm of the p-value, adjusted for all candidates

    @property
    def interval(self) -> tuple[float, float]:
        """95 %."""
        half = HALF_WIDTH_95 * self.standard_error
        return self.estimate - half, self.estimate + half

    @property
    def factor(self) -> tuple[float, tuple[float, float]]:
        """Estimate and interval of a change of a logarithm, as factors."""
        low, high = self.interval
        return math.exp(self.estimate), (math.exp(low), math.exp(high))


def select(
    score: FloatArray, information: FloatArray, classes: Sequence[Sequence[Candidate]], families: int, level: float
) -> tuple[list[Selected], FloatArray]:
    """The changes that explain a score (K,), the smallest p-value first, each given the others; and their sum (K,).

    A candidate's p-value is multiplied by the number of candidates of its class and by the number of classes of all
    scores, ``families`` (Bonferroni): so a class of one (all messages alike) needs less evidence than one of many
    links. The probability of finding anything where nothing is wrong is at most ``level``.
    """
    candidates, penalties = _distinct(classes, families)
    if not candidates:
        return [], np.zeros(len(score))
    directions = np.array([candidate.direction for candidate in candidates])
    moved = directions @ information
    scores, full = directions @ score, moved @ directions.T
    chosen: list[int] = []
    while len(chosen) < MOST:
        log_p = _log_p(scores, full, chosen) + penalties
        best = int(np.argmin(log_p))
        if log_p[best] >= math.log(level):
            break
        chosen.append(best)
        # A cause that later ones explain better is dropped.
        for old in list(chosen[:-1]):
            others = [c for c in chosen if c != old]
            if (_log_p(scores, full, others) + penalties)[old] >= math.log(level):
                chosen = others
                break
    if not chosen:
        return [], np.zeros(len(score))
    inverse = np.linalg.pinv(full[np.ix_(chosen, chosen)], hermitian=True)
    values, errors = inverse @ scores[chosen], np.sqrt(np.diag(inverse).clip(0.0))
    found = []
    for place, c in enumerate(chosen):
        others = [other for other in chosen if other != c]
        surprise = float((_log_p(scores, full, others) + penalties)[c])
        part, what = candidates[c].part, candidates[c].what
        found.append(Selected(part, what, float(values[place]), float(errors[place]), min(surprise, 0.0)))
    return sorted(found, key=lambda one: one.log_p), values @ directions[chosen]


def _log_p(scores: FloatArray, full: FloatArray, chosen: list[int]) -> FloatArray:
    """(C,): of all candidates, given the chosen ones."""
    own = np.diag(full).copy()
    rest, left = scores, own.copy()
    if chosen:
        shared = full[:, chosen] @ np.linalg.pinv(full[np.ix_(chosen, chosen)], hermitian=True)
        rest = scores - shared @ scores[chosen]
        left = own - np.einsum("cs,cs->c", shared, full[:, chosen])
    possible: BoolArray = left > SAME * np.maximum(own, own.max(initial=0.0) * SAME)
    z = np.zeros(len(scores))
    z[possible] = rest[possible] / np.sqrt(left[possible])
    return np.where(possible, math.log(2.0) + log_normal_tail(np.abs(z)), 0.0)


def _distinct(classes: Sequence[Sequence[Candidate]], families: int) -> tuple[list[Candidate], FloatArray]:
    """Candidates that differ from all earlier ones, and the logarithm of the factor of each p-value."""
    seen: set[bytes] = set()
    kept: list[Candidate] = []
    penalties = []
    for candidates in classes:
        for candidate in candidates:
            key = np.round(candidate.direction, 12).tobytes()
            if key in seen or not candidate.direction.any():
                continue
            seen.add(key)
            kept.append(candidate)
            penalties.append(math.log(len(candidates) * families))
    return kept, np.array(penalties)


@dataclass(frozen=True, slots=True)
class Cause:
    """One thing that is wrong."""

    kind: str  # such as "gain"; of a diagnostic, its ``kind``
    words: str  # a sentence
    agent: int | None = None  # from 1; None where the cause is not one agent
    link: tuple[int, int] | None = None  # from 1: sender and receiver, or the two ends of an edge or of a correlation
    graph: str | list[str] | None = None  # name; for switching [from, to] or [from]; None: all graphs
    estimate: float | None = None  # measured: factor of a gain or variance, share, rate, correlation or value
    interval: tuple[float, float] | None = None  # 95 %, for this cause alone
    expected: float | None = None  # the same according to the experiment; 1 for a factor
    p: float | None = None  # adjusted for all candidate causes; 0 where the law makes it impossible
    steps: tuple[int, int] | None = None  # first and last, where the cause is a stretch of the run
    log_p: float | None = None  # natural logarithm of ``p``, which may be too small for a number; None where p is 0

    @property
    def order(self) -> float:
        """The smaller, the clearer."""
        return -math.inf if self.log_p is None else self.log_p


def numbers_text(value: float, interval: tuple[float, float]) -> str:
    """A number and its interval."""
    return f"{value:#.3g} ({interval[0]:#.3g} to {interval[1]:#.3g})"


def share_text(share: float, interval: tuple[float, float]) -> str:
    """A share and its interval, in percent."""
    return f"{percent(share)} ({100 * interval[0]:.3g} to {100 * interval[1]:.3g} %)"


MIN_SAMPLES = 30  # fewest residuals for a variance
MAX_PARAMETERS = 600  # most parameters whose information is inverted


@dataclass(frozen=True, slots=True, eq=False)
class ParameterGroup:
    """A group of parameters that may be wrong."""

    score: FloatArray  # (K,)
    information: FloatArray  # (K, K)
    classes: list[list[Candidate]]  # candidates, class by class; the more specific of equal ones first


def frozen(sums: ResidualSums) -> list[tuple[int, int, int]]:
    """(agent, steps in which it did not move, steps) of agents that cannot have did not move with their noise."""
    noisy = np.sqrt(np.diagonal(sums.noises, axis1=1, axis2=2)) > 1e-12 * sums.largest
    still, steps = (sums.still * noisy).sum(axis=0), (sums.steps[:, None] * noisy).sum(axis=0)
    # One or two unmoved steps may be a coincidence of rounding.
    return [(i, int(still[i]), int(steps[i])) for i in np.flatnonzero(still >= 3).tolist()]


def gains(sums: ResidualSums, excluded: Iterable[int]) -> ParameterGroup | None:
    """Of the regression on received values, without the ``excluded`` agents; None where it is not available."""
    if sums.gram is None or len(sums.terms) > MAX_PARAMETERS:
        return None
    out = set(excluded)
    kept = np.array([a for a, term in enumerate(sums.terms) if term.agent not in out], dtype=np.int64)
    if not kept.size:
        return None
    # Of the regression's score U, covariance C and gram G: G C^-1 U, G C^-1 G. Changes of gains are relative, those of
    # the reference and of offsets (per step) absolute.
    square = np.ix_(kept, kept)
    inverse = pseudo_inverse(sums.covariance[square])
    back = sums.gram[square] @ inverse
    score, information = np.zeros(len(sums.terms)), np.zeros_like(sums.gram)
    score[kept], information[square] = back @ sums.score[kept], back @ sums.gram[square]
    return ParameterGroup(score, information, gain_classes(sums.terms))


def gain_classes(terms: Sequence[Term]) -> list[list[Candidate]]:
    """Changes of gains, reference and offsets, by the coefficients of the terms."""
    weights = np.array([term.weight for term in terms])
    leaders = sorted({term.agent for term in terms if term.kind == "lead"})

    def group(kind: str, part: str, of: Callable[[Term], Hashable]) -> list[Candidate]:
        """One candidate for each value of ``of`` over the terms of a kind."""
        found: dict[Hashable, FloatArray] = {}
        for a, term in enumerate(terms):
            if term.kind == kind:
                found.setdefault(of(term), np.zeros(len(terms)))[a] = weights[a]
        return [Candidate(part, key, direction) for key, direction in found.items()]

    def pair(term: Term) -> Hashable:
        return frozenset((term.agent, term.sender))

    classes = [
        group("link", "link", lambda t: (t.sender, t.agent, None)),
        group("link", "link", lambda t: (t.sender, t.agent, t.graph)),
        group("link", "edge", lambda t: (pair(t), None)),
        group("link", "edge", lambda t: (pair(t), t.graph)),
        group("link", "receiver", lambda t: t.agent),
        group("link", "sender", lambda t: t.sender),
        group("link", "graph", lambda t: t.graph),
        group("link", "all", lambda _: None),
        group("lead", "leader", lambda t: t.agent),
        group("lead", "leaders", lambda _: None),
        group("pull", "receiver", lambda t: t.agent),
        group("pull", "receiver in graph", lambda t: (t.agent, t.graph)),
        group("pull", "graph", lambda t: t.graph),
        group("pull", "all", lambda _: None),
        [Candidate("reference", None, _reference(terms))],
        [Candidate("reference", i, _reference(terms, i)) for i in leaders],
        group("constant", "offset", lambda t: t.agent),
    ]
    return [found for found in classes if any(candidate.direction.any() for candidate in found)]


def _reference(terms: Sequence[Term], leader: int | None = None) -> FloatArray:
    """(K,): effect of a reference that is larger by 1: leaders, or one of them, are pulled that much higher."""
    pulls: dict[int, list[float]] = {}
    for term in terms:
        if term.kind == "lead" and leader in (None, term.agent):
            pulls.setdefault(term.agent, []).append(-term.weight)
    return np.array(
        [np.mean(pulls[term.agent]) if term.kind == "constant" and term.agent in pulls else 0.0 for term in terms]
    )


def noise(sums: ResidualSums, excluded: Iterable[int], change: FloatArray) -> ParameterGroup | None:
    """Log noise variances by graph and agent, less what the ``change`` (K,) of gains explains; None without any."""
    n, m = sums.still.shape
    out = np.zeros(m, np.bool_)
    out[list(excluded)] = True
    should = np.diagonal(sums.noises, axis1=1, axis2=2)
    squares = np.diagonal(sums.scatter, axis1=1, axis2=2) - _explained(sums, change)
    usable: BoolArray = (should > sums.floor) & (sums.samples >= MIN_SAMPLES)[:, None] & ~out
    usable &= squares > 0.0
    cells = np.argwhere(usable)
    if not 0 < len(cells) <= MAX_PARAMETERS:
        return None
    graph, agent = cells.T
    ratios = np.log(squares[graph, agent] / (sums.samples[graph] * should[graph, agent]))
    root = np.sqrt(should[graph, agent])
    # Cells of different graphs are independent; their entries here are not used.
    correlation = sums.noises[graph[:, None], agent[:, None], agent] / (root[:, None] * root)
    covariance = np.where(graph[:, None] == graph, 2.0 * correlation**2 / sums.samples[graph][:, None], 0.0)
    information = pseudo_inverse(covariance)
    classes = [
        [Candidate("agent", int(i), (agent == i) * 1.0) for i in np.unique(agent)],
        [Candidate("agent in graph", (int(i), int(g)), np.eye(len(cells))[c]) for c, (g, i) in enumerate(cells)],
        [Candidate("graph", int(g), (graph == g) * 1.0) for g in np.unique(graph)],
        [Candidate("all", None, np.ones(len(cells)))],
    ]
    return ParameterGroup(information @ ratios, information, classes if n > 1 else [classes[0], classes[3]])


def variances(squares: FloatArray, samples: int) -> ParameterGroup:
    """Logarithms of variances, nominally 1, from sums of squares (m,) of so many normal ``samples`` each."""
    information = np.eye(len(squares)) * samples / 2.0
    classes = [
        [Candidate("agent", i, row) for i, row in enumerate(np.eye(len(squares)))],
        [Candidate("all", None, np.ones(len(squares)))],
    ]
    return ParameterGroup(information @ np.log(np.maximum(squares, 1e-300) / samples), information, classes)


def losses(tally: LossTally) -> ParameterGroup:
    """Log-odds of losing a message, link by link."""
    pairs = tally.pairs
    score, information = tally.score()
    # Other links say nothing; one that should lose nothing, but does, is all but impossible.
    usable = (tally.probability > 0.0) | (tally.lost > 0)
    information = np.where(usable & (information == 0.0), 1e-9 * tally.messages, information)
    identity = np.eye(len(pairs))
    classes = [
        [Candidate("link", (int(j), int(i)), identity[a]) for a, (i, j) in enumerate(pairs) if usable[a]],
        [Candidate("receiver", int(i), (pairs[:, 0] == i) * usable.astype(float)) for i in np.unique(pairs[usable, 0])],
        [Candidate("sender", int(j), (pairs[:, 1] == j) * usable.astype(float)) for j in np.unique(pairs[usable, 1])],
        [Candidate("all", None, usable.astype(float))],
    ]
    return ParameterGroup(np.asarray(score), np.diag(information), classes)


def _explained(sums: ResidualSums, change: FloatArray) -> FloatArray:
    """(n, m): how much smaller the sums of squares are with this change of the law."""
    n, m = sums.still.shape
    explained = np.zeros((n, m))
    touched = np.flatnonzero(change)
    if sums.gram is None or not touched.size:
        return explained
    shares = sums.samples / max(int(sums.samples.sum()), 1)
    gram = sums.gram[np.ix_(touched, touched)]
    for place, a in enumerate(touched.tolist()):
        term, c = sums.terms[a], change[touched]
        less = c[place] * (2.0 * sums.score[a] - gram[place] @ c)
        explained[:, term.agent] += less * (shares if term.graph is None else np.arange(n) == term.graph)
    return explained


MAX_NOISE_PAIRS = 1225  # pairs of agents whose noise is tested for correlation, at most: 50 agents


@dataclass(frozen=True, slots=True)
class Correlated:
    """Two agents whose noise is not as much correlated as it should be."""

    link: tuple[int, int]  # from 1
    correlation: float
    interval: tuple[float, float]  # 95 %
    expected: float
    log_p: float  # adjusted, see ``select``


def correlations(sums: ResidualSums, excluded: Sequence[int], families: int, level: float) -> list[Correlated]:
    """Pairs whose noise correlation differs from the expected one (Fisher's z)."""
    agents = [i for i in range(sums.still.shape[1]) if i not in excluded]
    pairs = list(combinations(agents, 2))
    samples = int(sums.samples.sum())
    if not 0 < len(pairs) <= MAX_NOISE_PAIRS or samples < MIN_SAMPLES:
        return []
    should, scatter = np.tensordot(sums.samples, sums.noises, axes=1), sums.scatter.sum(axis=0)
    found = []
    for j, i in pairs:
        size, expected_size = scatter[i, i] * scatter[j, j], should[i, i] * should[j, j]
        if size <= 0.0 or expected_size <= 0.0:
            continue
        seen, expected = float(scatter[i, j] / math.sqrt(size)), float(should[i, j] / math.sqrt(expected_size))
        if 1.0 - expected**2 < 1e-6 or 1.0 - seen**2 < 1e-12:
            continue
        z = (math.atanh(seen) - math.atanh(expected)) * math.sqrt(samples - 3)
        log_p = math.log(2.0 * len(pairs) * families) + float(log_normal_tail(abs(z)))
        if log_p < math.log(level):
            half = HALF_WIDTH_95 / math.sqrt(samples - 3)
            interval = math.tanh(math.atanh(seen) - half), math.tanh(math.atanh(seen) + half)
            found.append(Correlated((j + 1, i + 1), seen, interval, expected, log_p))
    return found


WIDEST = math.log(1e3)  # largest change of a rate, either way, as a logarithm
MAX_JUMPS = 400  # kinds of jumps; with more, no rates are tested


@dataclass(frozen=True, slots=True)
class Rate:
    """Rates, or in discrete time probabilities, that are all wrong by one factor."""

    jumps: tuple[tuple[int, int], ...]  # (from, to) from 0
    origin: int | None  # the graph that is left, where it is all jumps from one; else None
    factor: float  # measured over nominal
    interval: tuple[float, float]  # 95 %, by the likelihood ratio
    log_p: float  # adjusted, see ``select``


def find_rates(counts: IntArray, chain: MarkovChain, dt: float, families: int, level: float) -> list[Rate]:
    """Rates that explain the transitions ``counts`` (n, n): score tests, then maximum likelihood of their factors.

    ``dt``: length of a step [units of simulated time]; nothing is found with more than ``MAX_JUMPS`` kinds of jumps.
    """
    n = chain.modes
    transition = chain.transition(dt)
    jumps = [(g, h) for g, h in np.argwhere(chain.matrix > 0.0).tolist() if g != h]
    if not jumps or len(jumps) > MAX_JUMPS:
        return []
    origin, target = np.array(jumps).T
    visits = counts.sum(axis=1)
    stay = np.diag(transition)
    # Log-likelihood of e^theta P_gh, with P_gg making up the difference: multinomial, row by row.
    odds = np.divide(transition[origin, target], stay[origin], out=np.zeros(len(jumps)), where=stay[origin] > 0.0)
    score = counts[origin, target] - counts[origin, origin] * odds
    expected = visits[origin] * transition[origin, target]
    information = np.diag(expected) + np.where(origin[:, None] == origin, expected[:, None] * odds, 0.0)
    identity = np.eye(len(jumps))
    classes = [
        [Candidate("jump", (g, h), identity[a]) for a, (g, h) in enumerate(jumps)],
        [Candidate("leaving", g, (origin == g) * 1.0) for g in range(n)],
        [Candidate("all", None, np.ones(len(jumps)))],
    ]
    selected, _ = select(score, information, classes, families, level)
    rates, matrix = [], chain.matrix
    for one in selected:
        chosen: BoolArray = np.zeros((n, n), np.bool_)
        if one.part == "jump":
            chosen[one.what] = True
        else:
            chosen[origin, target] = True if one.part == "all" else origin == one.what
        theta, interval = _likeliest(counts, MarkovChain(chain.time, matrix), dt, chosen)
        matrix = _scaled(matrix, chain, chosen, theta)
        where = tuple((g, h) for g, h in jumps if chosen[g, h])
        leaves = one.what if one.part == "leaving" else None
        rates.append(Rate(where, leaves, math.exp(theta), (math.exp(interval[0]), math.exp(interval[1])), one.log_p))
    return rates


def _likeliest(counts: IntArray, chain: MarkovChain, dt: float, chosen: BoolArray) -> tuple[float, tuple[float, float]]:
    """Logarithm of the factor of the chosen jumps, and the interval in which 2 log L falls by less than 3.84."""
    from scipy import optimize  # here, since few comparisons come this far

    highest = WIDEST
    if chain.time == "discrete":  # the diagonal must not become negative
        given = (chain.matrix * chosen).sum(axis=1)
        room = np.diag(chain.matrix) + given
        highest = min(highest, float(np.log(room[given > 0.0] / given[given > 0.0]).min()) - 1e-9)

    def less(theta: float) -> float:
        """Negative log-likelihood."""
        law = MarkovChain(chain.time, _scaled(chain.matrix, chain, chosen, theta)).transition(dt)
        with np.errstate(divide="ignore"):
            terms = np.where(counts > 0, counts * np.log(np.maximum(law, 1e-300)), 0.0)
        return -float(terms.sum())

    bounds = (-WIDEST, highest)
    theta = float(optimize.minimize_scalar(less, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)
    allowed = less(theta) + float(chi2_quantile(0.05, 1)) / 2.0
    ends = []
    for bound in bounds:
        inside = less(bound) <= allowed
        ends.append(
            bound
            if inside
            else float(optimize.brentq(lambda t: less(t) - allowed, min(theta, bound), max(theta, bound)))
        )
    return theta, (ends[0], ends[1])


def _scaled(matrix: FloatArray, chain: MarkovChain, chosen: BoolArray, theta: float) -> FloatArray:
    """Generator or transition matrix with the chosen jumps e^theta times as frequent."""
    scaled = np.where(chosen, matrix * math.exp(theta), matrix)
    np.fill_diagonal(scaled, 0.0)
    np.fill_diagonal(scaled, (1.0 if chain.time == "discrete" else 0.0) - scaled.sum(axis=1))
    return scaled
