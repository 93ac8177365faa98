# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of dependence in time: long lags, constant states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.fft

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.inference.diagnostics import Block, Departure, Finding, Law, Place, Question
from msg_analysis.inference.e_values import EventEvidence, Looks, coefficient_evidence
from msg_analysis.inference.statistics import log_normal_tail

LAGS = 100
MIN_SAMPLES = 100  # fewest products for the normal law of their sum


@dataclass(frozen=True, slots=True)
class Lag:
    """The clearest dependence on earlier numbers."""

    log_p: float  # of all lags and columns together
    column: int
    steps: int
    coefficient: float
    standard_error: float


class LagSums:
    """Regression of N(0, 1) numbers on those of the same column 1 to 100 steps before; expected coefficient 0.

    Given the past, the sum of the products is a martingale whose variance is the sum of the squares of the earlier
    numbers.
    """

    def __init__(self, columns: int, samples: int) -> None:
        self._tail = np.empty((0, columns, samples))
        shape = (LAGS, columns)
        self.score, self.information, self.products = np.zeros(shape), np.zeros(shape), np.zeros(LAGS, np.int64)

    def add(self, numbers: FloatArray, looks: Looks) -> tuple[FloatArray, FloatArray]:
        """Add the products of numbers (b, columns, samples) with the earlier ones.

        (T, 100, columns) each: ``score`` and ``information`` after each look.
        """
        joined = np.concatenate([self._tail, numbers])
        old, lags = len(self._tail), np.arange(1, LAGS + 1)
        # (T, lags): between the looks, the numbers that have one so many steps before them, in ``joined``.
        ends = np.repeat(old + looks.ends[:, None], LAGS, axis=1)
        begins = np.minimum(np.maximum(old + looks.begins[:, None], lags), ends)
        sums = np.vstack([np.zeros(joined.shape[1]), (joined**2).sum(axis=2).cumsum(axis=0)])
        information = sums[np.maximum(ends - lags, 0)] - sums[np.maximum(begins - lags, 0)]
        information = self.information + information.cumsum(axis=0)
        score = self.score + _products(joined, old, looks).cumsum(axis=0)
        self.score, self.information = score[-1], information[-1]
        self.products += (ends - begins).sum(axis=0) * numbers.shape[2]
        self._tail = joined[-LAGS:].copy()
        return score, information

    def merge(self, other: Self) -> None:
        """No lag goes over from one run to another."""
        self.score += other.score
        self.information += other.information
        self.products += other.products

    def pooled(self) -> LagSums:
        """Of all columns together, where these are independent of each other."""
        whole = LagSums(1, 0)
        whole.score, whole.information = (each.sum(axis=1, keepdims=True) for each in (self.score, self.information))
        whole.products = self.products
        return whole

    def clearest(self) -> Lag | None:
        """Of all lags and columns (Bonferroni); None where there are too few numbers."""
        lags = np.flatnonzero(self.products >= MIN_SAMPLES)
        # Of numbers that all are 0 there is no information, and nothing to see.
        score, information = self.score[lags], np.maximum(self.information[lags], np.finfo(float).tiny)
        if not score.size:
            return None
        z = score / np.sqrt(information)
        row, column = np.unravel_index(int(np.argmax(np.abs(z))), z.shape)
        log_p = math.log(2.0 * z.size) + float(log_normal_tail(abs(z[row, column])))
        coefficient = float(score[row, column] / information[row, column])
        return Lag(
            log_p, int(column), int(lags[row]) + 1, coefficient, 1.0 / math.sqrt(float(information[row, column]))
        )


def _products(joined: FloatArray, old: int, looks: Looks) -> FloatArray:
    """(T, LAGS, columns): sums of numbers between the looks times those 1 to 100 steps before.

    ``joined`` (old + b, columns, samples): the numbers, after ``old`` earlier ones.
    """
    found, columns = np.empty((looks.count, LAGS, joined.shape[1])), joined.transpose(1, 2, 0)
    # By Fourier transforms so long that no two products overlap; stretches of about the same length together.
    classes = np.frexp(looks.lengths + LAGS)[1]
    for each in np.unique(classes):
        rows = np.flatnonzero(classes == each)
        length = scipy.fft.next_fast_len(int(looks.lengths[rows].max()) + LAGS, real=True)
        every = np.zeros((len(rows), *joined.shape[1:], length))
        for part, begin, end in zip(every, old + looks.begins[rows], old + looks.ends[rows], strict=True):
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


class LongLags(Departure):
    """Regression of every innovation on that of the same agent 1 to 100 steps before.

    The test takes the clearest lag: of an agent, or of all together where they are independent, with half of the
    level each.
    """

    test = "innovations: lags to 100"

    def __init__(self, law: Law) -> None:
        self._agents, self._together = np.flatnonzero(law.noisy), bool(law.apart and law.noisy.sum() > 1)
        self.sums = LagSums(len(self._agents), law.replicas)

    def add(self, block: Block) -> FloatArray:
        """Add the innovations of a block."""
        return self._evidence(*self.sums.add(block.white[:, self._agents], block.looks))

    def merge(self, other: Self) -> None:
        """Add the sums of other runs."""
        self.sums.merge(other.sums)

    def finding(self) -> Finding | None:
        """The clearest lag."""
        each, whole = self.sums.clearest(), self.sums.pooled().clearest() if self._together else None
        if each is None:
            return None
        best = min((lag for lag in (each, whole) if lag), key=lambda lag: lag.log_p)
        return Finding(
            self.test,
            min(0.0, best.log_p + math.log(1.0 + self._together)),
            agent=None if best is whole else int(self._agents[best.column]),
            span=(best.steps, best.steps),
            estimate=best.coefficient,
            standard_error=best.standard_error,
            expected=0.0,
        )

    def evidence(self) -> FloatArray:
        """(100 (agents + 1), K): lags of each agent, and of all together."""
        return self._evidence(self.sums.score, self.sums.information)

    def _evidence(self, score: FloatArray, information: FloatArray) -> FloatArray:
        """(..., 100 (agents + 1), K), from sums (..., LAGS, agents)."""
        if self._together:
            both = score, information
            score, information = (np.append(each, each.sum(axis=-1, keepdims=True), axis=-1) for each in both)
        found = lag_evidence(score, information)
        return found.reshape(*found.shape[:-3], -1, found.shape[-1])

    def questions(self) -> list[Question]:
        """A lag of an agent, or of all."""
        whose = [f"agent {agent + 1}" for agent in self._agents.tolist()] + ["all agents"] * self._together
        return [(f"noise of {who} and {lag} steps before", ()) for who in whose for lag in range(1, LAGS + 1)]


ROUNDINGS = 4.0  # of the largest state, in the computation of a state, at most
EPSILON = float(np.finfo(np.float64).eps)


class StandingStill(Departure):
    """Steps in which no replica of an agent moves.

    The density of a normal number is below 0.4 over its standard deviation, so the probability q of such a step is at
    most that of hitting an interval of a few roundings, for every replica. The mean of 1 / q over the steps that stood
    still, 0 for the others and 1 for those to come, is evidence; half of the whole always counts 1. Its inverse is the
    p of the test (Markov).
    """

    test = "innovations: standing still"

    def __init__(self, law: Law) -> None:
        self._agents = np.flatnonzero(law.noisy)
        self._evidence = EventEvidence(law.planned * len(self._agents))
        self._since = np.full(len(self._agents), -1)  # first step of what may go on, from 0; -1: moved
        self._longest: tuple[int, int, Place] | None = None  # steps, agent, place
        self._runs = 1

    def add(self, block: Block) -> FloatArray:
        """Look at the steps of a block."""
        looks = block.looks
        if not len(self._agents):
            return np.empty((looks.count, 0, 1))
        before, after = block.reception.states, block.after
        still: BoolArray = (after[:, self._agents] == before[:, self._agents]).all(axis=2)
        at, which = np.nonzero(still)
        size = np.spacing(np.abs(before[at]).max(axis=1))  # (s, R)
        chance = ROUNDINGS * (size / block.scale[at, self._agents[which]][:, None] + EPSILON)
        seen, logarithms = looks.lengths * len(self._agents), -np.log(np.minimum(chance, 1.0)).sum(axis=1)
        for place in np.unique(which).tolist():
            self._stretches(place, block.first, block.first + at[which == place])
        moved = ~still[-1]
        self._since[moved] = -1
        return self._evidence.add(seen, logarithms, looks.after(at))[:, None, None]

    def _stretches(self, place: int, first: int, steps: IntArray) -> None:
        """The longest stretch of an agent that stood still in ``steps`` from ``first`` on, ascending."""
        begins = steps[np.append(True, np.diff(steps) > 1)]
        ends = steps[np.append(np.diff(steps) > 1, True)]
        if self._since[place] >= 0 and begins[0] == first:
            begins[0] = self._since[place]
        longest = int(np.argmax(ends - begins))
        length = int(ends[longest] - begins[longest]) + 1
        if self._longest is None or length > self._longest[0]:
            found = Place(int(begins[longest]) + 1, int(ends[longest]) + 1)
            self._longest = (length, int(self._agents[place]), found)
        self._since[place] = begins[-1]

    def merge(self, other: Self) -> None:
        """Nothing goes on from one run to another."""
        self._evidence.merge(other._evidence)
        if other._longest and (self._longest is None or other._longest[0] > self._longest[0]):
            length, agent, place = other._longest
            self._longest = (length, agent, place.later(self._runs))
        self._runs += other._runs

    def finding(self) -> Finding | None:
        """The longest stretch."""
        if not len(self._agents):
            return None
        log_p = min(0.0, -self._evidence.logarithm())
        if self._longest is None:
            return Finding(self.test, log_p)
        length, agent, place = self._longest
        return Finding(self.test, log_p, agent=agent, place=place, estimate=float(length), expected=0.0)

    def evidence(self) -> FloatArray:
        """(1, 1)."""
        return np.array([[self._evidence.logarithm()]]) if len(self._agents) else np.empty((0, 1))

    def questions(self) -> list[Question]:
        """One, about all agents."""
        return [("agents that stand still", ())]
