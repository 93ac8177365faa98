# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The counted transitions of the graphs, and their test against the Markov chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.inference.statistics import chi2_tail, gamma_tail

PATHS = 9999
MAX_JUMPS = 10_000_000  # simulated jumps; longer runs use fewer paths, but at least 199
MIN_EXPECTED_TRANSITIONS = 25.0  # smallest expected count of every possible transition for the chi-square law
SEED = 20_240_229


@dataclass(frozen=True, slots=True, eq=False)
class SwitchingTest:
    """Test of the N - 1 transitions."""

    counts: IntArray  # (n, n) observed
    expected: FloatArray  # (n, n) visits of the row times P
    p: float | None  # None where there is nothing to test; 0 if a transition happened that P forbids


@dataclass(frozen=True, slots=True, eq=False)
class Transitions:
    """Transition counts of the runs of one experiment."""

    counts: IntArray  # (n, n) of all runs
    paths: tuple[tuple[int, int], ...]  # first graph and number of transitions of each run

    @classmethod
    def of(cls, modes: IntArray, graphs: int) -> Transitions:
        """Counts of one run with the graphs ``modes`` (N,), from 0; ``graphs`` is their number n."""
        counts = np.zeros((graphs, graphs), dtype=np.int64)
        np.add.at(counts, (modes[:-1], modes[1:]), 1)
        return cls(counts, ((int(modes[0]), len(modes) - 1),) if len(modes) else ())

    def merged(self, other: Transitions) -> Transitions:
        """With those of other runs."""
        return Transitions(self.counts + other.counts, self.paths + other.paths)

    def test(self, transition: FloatArray) -> SwitchingTest:
        """See ``switching_test``; ``transition`` is P (n, n)."""
        counts = self.counts
        visits = counts.sum(axis=1)
        expected = visits[:, None] * transition
        possible = (transition > 0.0) & (visits[:, None] > 0)
        dof = int(possible.sum() - (visits > 0).sum())
        if counts[transition == 0.0].any():
            return SwitchingTest(counts, expected, 0.0)
        if dof == 0:
            return SwitchingTest(counts, expected, None)
        # Decided by the expectation of the chain, not by the data: a choice made from the data would be a bias.
        usual = counts.sum() * stationary_law(transition)[:, None] * transition
        if usual[transition > 0.0].min() >= MIN_EXPECTED_TRANSITIONS:
            chi2 = float(likelihood_ratio(counts, transition))
            return SwitchingTest(counts, expected, float(chi2_tail(chi2, dof)))
        return SwitchingTest(counts, expected, self._simulated_p(transition))

    def _simulated_p(self, transition: FloatArray) -> float:
        counts = self.counts
        jumps = max(1.0, float(counts.sum(axis=1) @ (1.0 - np.diag(transition))))
        number = int(np.clip(MAX_JUMPS / jumps, 199, PATHS))
        drawn = _drawn(transition.tobytes(), self.paths, number)
        observed = float(likelihood_ratio(counts, transition))
        # Ties (with few jumps there are few possible values) count as at least as extreme.
        above = int((drawn >= observed * (1 - 1e-12)).sum())
        if above or drawn.std() == 0.0:
            return (above + 1) / (number + 1)
        shape = (drawn.mean() / drawn.std()) ** 2
        return float(min(1 / (number + 1), gamma_tail(observed, shape, drawn.mean() / shape)))


def switching_test(modes: IntArray, transition: FloatArray) -> SwitchingTest:
    """Test a path of the graph against its chain, by the likelihood-ratio statistic G.

    Its law is chi-square when every possible transition is expected often enough; else it is simulated: paths of the
    same length from the same first graph (fixed seed), with a gamma fit where none of them is as extreme. With two
    graphs and 6 expected switches each way, 2.3 % of Pearson's p-values would be below 0.01 and 0.7 % below 0.001; of
    these, 0.9 % and 0.15 % (20 000 paths).

    Parameters
    ----------
    modes
        (N,) from 0
    transition
        (n, n) P
    """
    return Transitions.of(modes, len(transition)).test(transition)


def likelihood_ratio(counts: IntArray, transition: FloatArray) -> FloatArray:
    """G = 2 sum c log(c / e) of counts c, e being the visits of a row times P.

    Parameters
    ----------
    counts
        (..., n, n) of transitions
    transition
        (n, n) P

    Returns
    -------
    FloatArray
        (..., ) one G for each matrix of counts
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = counts * np.log(counts / (counts.sum(axis=-1, keepdims=True) * transition))
    return np.asarray(2.0 * np.where(counts > 0, terms, 0.0).sum(axis=(-2, -1)))


@lru_cache(maxsize=8)  # the runs of a sweep with one experiment and several seeds draw the same paths
def _drawn(law: bytes, paths: tuple[tuple[int, int], ...], number: int) -> FloatArray:
    """(number,) statistics of simulated paths, each from its first graph with so many transitions; n x n ``law``."""
    transition = np.frombuffer(law).reshape(math.isqrt(len(law) // 8), -1)
    random = np.random.default_rng(SEED)
    total = np.zeros((number, *transition.shape), dtype=np.int64)
    for first, transitions in paths:
        total += simulate_counts(transition, first, transitions, number, random)
    return likelihood_ratio(total, transition)


def simulate_counts(
    transition: FloatArray, first: int, transitions: int, paths: int, random: np.random.Generator
) -> IntArray:
    """(paths, n, n): transition counts of independent paths from the graph ``first``, by their holding times."""
    n = len(transition)
    leaving = 1.0 - np.diag(transition)
    jumps = transition - np.diag(np.diag(transition))
    total = jumps.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(np.divide(jumps, total, out=np.zeros_like(jumps), where=total > 0.0), axis=1)
    counts = np.zeros((paths, n, n), dtype=np.int64)
    mode, left, path = np.full(paths, first), np.full(paths, transitions), np.arange(paths)
    while path.size:
        stay = leaving[mode] <= 0.0
        held = np.where(stay, left, random.geometric(np.where(stay, 1.0, leaving[mode])) - 1)
        ends = held >= left
        counts[path, mode, mode] += np.where(ends, left, held)
        mode, left, path, held = (a[~ends] for a in (mode, left, path, held))
        # Guard against a cumulative law that ends just below 1.
        after = np.minimum((random.random(path.size)[:, None] >= cumulative[mode]).sum(axis=1), n - 1)
        counts[path, mode, after] += 1
        mode, left = after, left - held - 1
        mode, left, path = (a[left > 0] for a in (mode, left, path))
    return counts
