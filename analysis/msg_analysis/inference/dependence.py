# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about dependence: between agents and successive steps, at long lags, and states that do not change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Self

import numpy as np
import scipy.fft

from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.common.text import percent
from msg_analysis.inference.candidates import Cause, Correlated, numbers_text
from msg_analysis.inference.e_values import Analyses, EventEvidence, coefficient_evidence
from msg_analysis.inference.question import (
    Block,
    Diagnostic,
    Finding,
    Largest,
    Law,
    Place,
    Question,
    RunningSums,
    Search,
    SummedDiagnostic,
    agent_words,
)
from msg_analysis.inference.statistics import add_sums, binomial_interval, log_normal_tail


class Whiteness(Question):
    """Whether residuals of successive steps, of replicas, and of two agents are independent as they should be."""

    name = "residuals: whiteness"
    meaning = "the noise of successive steps, of replicas or of agents is correlated: random numbers are used twice"
    p_value = attrgetter("residuals.p_whiteness")

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each pair of agents."""
        i, j = self.law.pairs.T
        return coefficient_evidence(sums.pair_score[:, i, j], sums.pair_information[:, i, j])

    def about(self, row: int) -> str:
        """Two agents."""
        first, second = (self.law.pairs[row] + 1).tolist()
        return f"common noise of agents {first} and {second}"

    @classmethod
    def classes(cls, search: Search) -> int:
        """The pairs."""
        del search
        return 1

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Pairs of agents."""
        return [_correlation_cause(one) for one in search.correlated]


def _correlation_cause(one: Correlated) -> Cause:
    words = (
        f"the noise of agents {one.link[0]} and {one.link[1]} has correlation "
        f"{numbers_text(one.correlation, one.interval)}, not {one.expected:.3g}"
    )
    numbers = one.correlation, one.interval, one.expected, math.exp(one.log_p)
    return Cause("correlation", words, None, one.link, None, *numbers, log_p=one.log_p)


LAGS = 100
MIN_SAMPLES = 100  # fewest products for the normal law of their sum


class LagSums:
    """Regression of N(0, 1) numbers on those of the same column 1 to 100 steps before; expected coefficient 0."""

    def __init__(self, columns: int, samples: int) -> None:
        self._tail = np.empty((0, columns, samples))
        shape = (LAGS, columns)
        self.score, self.information, self.products = np.zeros(shape), np.zeros(shape), np.zeros(LAGS, np.int64)

    def add(self, numbers: FloatArray, analyses: Analyses) -> tuple[FloatArray, FloatArray]:
        """Add numbers (b, columns, samples): (T, 100, columns) ``score`` and ``information`` after each analysis."""
        # Given the past, the sum of the products is a martingale, whose variance is the sum of the earlier squares.
        joined = np.concatenate([self._tail, numbers])
        old, lags = len(self._tail), np.arange(1, LAGS + 1)
        # (T, lags): between the analyses, the numbers that have one so many steps before them, in ``joined``.
        ends = np.repeat(old + analyses.ends[:, None], LAGS, axis=1)
        begins = np.minimum(np.maximum(old + analyses.begins[:, None], lags), ends)
        sums = np.vstack([np.zeros(joined.shape[1]), (joined**2).sum(axis=2).cumsum(axis=0)])
        information = sums[np.maximum(ends - lags, 0)] - sums[np.maximum(begins - lags, 0)]
        information = self.information + information.cumsum(axis=0)
        score = self.score + _products(joined, old, analyses).cumsum(axis=0)
        self.score, self.information = score[-1], information[-1]
        self.products += (ends - begins).sum(axis=0) * numbers.shape[2]
        self._tail = joined[-LAGS:].copy()
        return score, information

    def merge(self, other: Self) -> None:
        """No lag goes over from one run to another."""
        add_sums(self, other, "score", "information", "products")

    def clearest(self, *, pooled: bool = False) -> Finding | None:
        """Of all lags and columns (as agents; Bonferroni), or of the columns together; None with too few numbers."""
        lags = np.flatnonzero(self.products >= MIN_SAMPLES)
        score, information = self.score[lags], self.information[lags]
        if not score.size:
            return None
        if pooled:
            score, information = score.sum(axis=1, keepdims=True), information.sum(axis=1, keepdims=True)
        # Of numbers that all are 0 there is no information, and nothing to see.
        information = np.maximum(information, np.finfo(float).tiny)
        z = score / np.sqrt(information)
        row, column = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
        log_p = math.log(2.0 * z.size) + float(log_normal_tail(abs(z[row, column])))
        known = float(information[row, column])
        return Finding(
            log_p,
            agent=None if pooled else int(column),
            span=(int(lags[row]) + 1, int(lags[row]) + 1),
            estimate=float(score[row, column] / known),
            standard_error=1.0 / math.sqrt(known),
            expected=0.0,
            possible=(-1.0, 1.0),
        )


def _products(joined: FloatArray, old: int, analyses: Analyses) -> FloatArray:
    """(T, LAGS, columns): sums of numbers (b, columns, samples), behind ``old`` earlier ones, times those before."""
    found, columns = np.empty((analyses.count, LAGS, joined.shape[1])), joined.transpose(1, 2, 0)
    # By Fourier transforms so long that no two products overlap; stretches of about the same length together.
    classes = np.frexp(analyses.lengths + LAGS)[1]
    for each in np.unique(classes):
        rows = np.flatnonzero(classes == each)
        length = scipy.fft.next_fast_len(int(analyses.lengths[rows].max()) + LAGS, real=True)
        every = np.zeros((len(rows), *joined.shape[1:], length))
        for part, begin, end in zip(every, old + analyses.begins[rows], old + analyses.ends[rows], strict=True):
            before = min(begin, LAGS)
            part[:, :, LAGS - before : LAGS + end - begin] = columns[:, :, begin - before : end]
        late = every.copy()
        late[..., :LAGS] = 0.0
        spectrum = np.einsum("tcsf,tcsf->tcf", scipy.fft.rfft(late), scipy.fft.rfft(every).conj())
        found[rows] = scipy.fft.irfft(spectrum, length)[..., 1 : LAGS + 1].transpose(0, 2, 1)
    return found


def lag_evidence(score: FloatArray, information: FloatArray) -> FloatArray:
    """(..., columns, LAGS, K) logarithms, from sums (..., LAGS, columns)."""
    return coefficient_evidence(score.swapaxes(-1, -2), information.swapaxes(-1, -2))


class LongLags(Diagnostic):
    """Regression of every residual on that of the same agent 1 to 100 steps before: the clearest lag."""

    name = "residuals: lags to 100"
    meaning = "the noise of a step depends on that of up to 100 steps before"
    kind = "lag"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self.lags = LagSums(len(self.agents), law.replicas)

    def add(self, block: Block) -> FloatArray:
        """Add the residuals of a block."""
        return self._evidence(*self.lags.add(block.white[:, self.agents], block.analyses))

    def merge(self, other: Self) -> None:
        """Add the sums of other runs."""
        self.lags.merge(other.lags)

    def finding(self) -> Finding | None:
        """The clearest lag."""
        each, whole = self.lags.clearest(), self.lags.clearest(pooled=True) if self.together else None
        if each is None:
            return None
        best = min((lag for lag in (each, whole) if lag), key=lambda lag: lag.log_p)
        log_p = min(0.0, best.log_p + math.log(1.0 + self.together))  # half of the level each
        return replace(best, agent=None if best.agent is None else self.agent(best.agent), log_p=log_p)

    def logarithms(self) -> FloatArray:
        """(100 (agents + 1), K): lags of each agent, and of all together."""
        return self._evidence(self.lags.score, self.lags.information)

    def _evidence(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """(..., 100 (agents + 1), K), from sums (..., LAGS, agents)."""
        found = lag_evidence(self.columns(score), self.columns(information))
        return found.reshape(*found.shape[:-3], -1, found.shape[-1])

    def about(self, row: int) -> str:
        """A lag of an agent, or of all."""
        column, lag = divmod(row, LAGS)
        return f"noise of {agent_words(self.agent(column))} and {lag + 1} steps before"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A correlation."""
        del names
        assert found.span is not None
        whose, steps = agent_words(found.agent), found.span[0]
        return f"the noise of {whose} has correlation {found.numbers} with its own {steps} steps before, not 0"


MOST_REPLICAS = 32  # of whom each two are asked about


class Replicas(SummedDiagnostic):
    """Regression of the residuals of each replica on those of earlier ones: by agent, of all, and of each two."""

    name = "residuals: replicas"
    meaning = "the noise of the replicas is not independent: random numbers are used twice"
    kind = "replicas"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        pairs = law.replicas if law.apart and 2 < law.replicas <= MOST_REPLICAS else 0
        self._pairs: IntArray = np.column_stack(np.tril_indices(pairs, -1))  # (P, 2) later and earlier
        # Score, information and squares of each agent; products of each two replicas; samples.
        agents, count = np.zeros(len(self.agents)), np.zeros((), np.int64)
        self.sums = [agents, agents, agents, np.zeros((pairs, pairs)), count]

    def between(self, block: Block) -> list[AnyArray]:
        """See ``sums``."""
        analyses, white = block.analyses, block.white[:, self.agents]
        earlier = white.cumsum(axis=2) - white
        parts = [analyses.sums(each.sum(axis=2)) for each in (white * earlier, earlier**2, white**2)]
        products = np.zeros((analyses.count, *self.sums[3].shape))
        if len(self._pairs):
            for row, begin, end in zip(products, analyses.begins.tolist(), analyses.ends.tolist(), strict=True):
                flat = white[begin:end].reshape(-1, white.shape[2])
                row += flat.T @ flat
        return [*parts, products, analyses.lengths]

    def finding(self) -> Finding | None:
        """The clearest agent, or all, or two replicas."""
        replicas, steps = self.law.replicas, int(self.sums[4])
        if replicas < 2 or not len(self.agents) or steps * replicas < MIN_SAMPLES:
            return None
        score, information = self._rows(self.sums)
        z = np.abs(score) / np.sqrt(np.maximum(information, np.finfo(float).tiny))
        squares, agents = self.columns(self.sums[2]), len(self.agents)
        ends = np.cumsum([agents, int(self.together), len(self._pairs)])
        kinds = [(begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True) if end > begin]
        begin, end = min(kinds, key=lambda kind: log_normal_tail(z[slice(*kind)].max()) + math.log(kind[1] - kind[0]))
        row = begin + int(np.argmax(z[begin:end]))
        log_p = math.log(2.0 * (end - begin) * len(kinds)) + float(log_normal_tail(z[row]))
        if row < ends[1]:  # the intraclass correlation and its error (Fisher 1925)
            among, column = replicas, self.agent(row)
            rho = float(score[row] / squares[row]) * 2.0 / (replicas - 1.0)
            numbers, which = steps * (agents if column is None else 1), ()
        else:
            among, column, numbers, which = 2, None, steps * agents, tuple(self._pairs[row - ends[1]].tolist()[::-1])
            own = np.diag(self.sums[3])[list(which)]
            rho = float(score[row] / math.sqrt(own.prod()))
        error = (1.0 - rho) * (1.0 + (among - 1.0) * rho) * math.sqrt(2.0 / (among * (among - 1.0) * numbers))
        return Finding(
            min(0.0, log_p),
            agent=column,
            replicas=which,
            estimate=rho,
            standard_error=abs(error),
            expected=0.0,
            possible=(-1.0 / (among - 1.0), 1.0),
        )

    def _rows(self, sums: Sequence[AnyArray]) -> tuple[FloatArray, FloatArray]:
        """Score and information (..., agents [+ 1] + P)."""
        later, earlier = self._pairs.T
        products = sums[3]
        score = np.concatenate([self.columns(sums[0]), products[..., later, earlier]], axis=-1)
        return score, np.concatenate([self.columns(sums[1]), products[..., earlier, earlier]], axis=-1)

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., agents [+ 1] + P, K)."""
        if self.law.replicas < 2:
            return np.empty((*sums[4].shape, 0, 1))
        return coefficient_evidence(*self._rows(sums))

    def about(self, row: int) -> str:
        """An agent, all, or two replicas."""
        columns = len(self.agents) + self.together
        if row < columns:
            return f"common noise of the replicas of {agent_words(self.agent(row))}"
        later, earlier = (self._pairs[row - columns] + 1).tolist()
        return f"common noise of replicas {earlier} and {later}"

    @classmethod
    def explains_others(cls, found: Finding) -> bool:
        """Replicas that are alike count several times in every other cause."""
        return found.estimate is not None and found.estimate > ALIKE

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """A correlation."""
        del names
        which = f"replicas {' and '.join(str(one + 1) for one in found.replicas)}" if found.replicas else "all replicas"
        whose = f"the noise of {which}" if found.agent is None else f"agent {found.agent + 1}'s noise in {which}"
        return f"{whose} has correlation {found.numbers}, not 0: the replicas are not independent"


ALIKE = 0.9  # correlation

ROUNDINGS = 4.0  # of the largest state, in the computation of a state, at most
EPSILON = float(np.finfo(np.float64).eps)


class SingleEvents(Diagnostic):
    """A diagnostic of which each event by itself is evidence; ``events``: in a step."""

    def __init__(self, law: Law, events: int, largest: Largest) -> None:
        super().__init__(law)
        self.seen = EventEvidence(law.planned * events)
        self.largest = largest

    def merge(self, other: Self) -> None:
        """The larger one."""
        self.seen.merge(other.seen)
        self.largest.merge(other.largest)

    def logarithms(self) -> FloatArray:
        """(1, 1)."""
        return self.seen.logarithms()


class ConstantState(SingleEvents):
    """Steps in which no replica of an agent moves; the less probable, the more evidence, of which 1 / it is the p."""

    name = "residuals: constant state"
    meaning = "the state of an agent with noise does not change for some steps"
    subject = "agents whose state is constant"
    kind = "frozen"

    def __init__(self, law: Law) -> None:
        agents = int(law.noisy.sum())
        super().__init__(law, agents, Largest())  # steps of an agent
        self._since = np.full(agents, -1)  # first step of what may go on, from 0; -1: moved

    def add(self, block: Block) -> FloatArray:
        """Add the steps of a block."""
        analyses = block.analyses
        if not len(self.agents):
            return np.empty((analyses.count, 0, 1))
        before, after = block.reception.states, block.after
        still: BoolArray = (after[:, self.agents] == before[:, self.agents]).all(axis=2)
        at, which = np.nonzero(still)
        # At most that of all replicas hitting an interval of a few roundings: a normal density is below 0.4 / sd.
        size = np.spacing(np.abs(before[at]).max(axis=1))  # (s, R)
        chance = ROUNDINGS * (size / block.scale[at, self.agents[which]][:, None] + EPSILON)
        seen, logarithms = analyses.lengths * len(self.agents), -np.log(np.minimum(chance, 1.0)).sum(axis=1)
        for column in np.unique(which).tolist():
            self._stretches(column, block.first, block.first + at[which == column])
        self._since[~still[-1]] = -1
        return self.seen.add(seen, logarithms, analyses.after(at))[:, None, None]

    def _stretches(self, column: int, first: int, steps: IntArray) -> None:
        """The longest stretch of an agent that did not move in ``steps`` from ``first`` on, ascending."""
        begins = steps[np.append(True, np.diff(steps) > 1)]
        ends = steps[np.append(np.diff(steps) > 1, True)]
        if self._since[column] >= 0 and begins[0] == first:
            begins[0] = self._since[column]
        longest = int(np.argmax(ends - begins))
        place = Place(int(begins[longest]) + 1, int(ends[longest]) + 1)
        self.largest.take(place.last - place.first + 1.0, (self.agents[column],), place)
        self._since[column] = begins[-1]

    def finding(self) -> Finding | None:
        """The longest stretch."""
        if not len(self.agents):
            return None
        log_p, longest = min(0.0, -float(self.logarithms()[0, 0])), self.largest
        if not longest.of:
            return Finding(log_p)
        return Finding(log_p, agent=int(longest.of[0]), place=longest.place, estimate=longest.value, expected=0.0)

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """An agent in some steps."""
        del names
        assert found.place is not None
        return f"{agent_words(found.agent)} did not move {found.place.words}, although it has noise"

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], log_p: float) -> Cause:
        """Without the length, which is that of the steps."""
        return replace(super().cause(found, names, log_p), estimate=None)

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Agents that cannot have been where they were by chance."""
        return [_frozen_cause(*entry, search.findings.get(cls.name)) for entry in search.frozen]


def _frozen_cause(agent: int, still: int, steps: int, found: Finding | None) -> Cause:
    """An agent, from 0, that did not move in so many of its steps; with the stretch if that is all of them."""
    share, interval = still / steps, binomial_interval(still, steps)
    when = "does not move in any of its steps" if still == steps else f"does not move in {percent(share)} of its steps"
    stretch = found.place if found and found.agent == agent else None
    where = None
    if stretch and still < steps and still == stretch.last - stretch.first + 1:
        when, where = f"did not move {stretch.words}", (stretch.first, stretch.last)
    words = f"agent {agent + 1} {when}, although it has noise"
    return Cause("frozen", words, agent + 1, None, None, share, interval, 0.0, 0.0, where)
