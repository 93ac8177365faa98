# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Counted transitions of the graphs and counted losses of messages, and their tests (docs/statistics.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.inference.observation import Measurement, Observation
from msg_analysis.inference.statistics import add_sums, chi2_quantile, chi2_tail
from msg_analysis.model.reception import neighbour_tables

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
        """Test of the paths against the transition matrix P (n, n), by the likelihood-ratio statistic G.

        Its law is chi-square where every possible transition is expected often enough; else it is simulated: paths of
        the same length from the same first graph (fixed seed), with a gamma fit where none of them is as extreme.
        """
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
        # With 6 expected switches each way, 2.3 % of Pearson's p-values are below 0.01, and 0.9 % of these.
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
        return float(min(1 / (number + 1), special.gammaincc(shape, observed / (drawn.mean() / shape))))


def likelihood_ratio(counts: IntArray, transition: FloatArray) -> FloatArray:
    """(...): G = 2 sum c log(c / e) of transitions c (..., n, n), e being the visits of a row times P (n, n)."""
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


MIN_EXPECTED_LOSSES = 25.0  # smallest expected count for which a chi-square law is used


@dataclass(frozen=True, slots=True)
class LossTest:
    """The logged losses against the law of every link."""

    lost: int  # messages
    expected: float  # sum over the messages of the probability of their link
    p: float | None  # None where there was no message


def loss_test(observation: Observation | Measurement) -> LossTest | None:
    """Test that messages are lost with the probability of their link, as the law says; None without (logged) loss.

    The statistic adds one chi-square per link, in bursts one for the messages after a lost one and one for those after
    another, and two for products of (lost - expected) in standard errors: of messages of one link in successive steps,
    and of pairs of messages in one step. What has too few messages for a chi-square law is pooled, with all of the same
    probability, and tested by the exact binomial law; products that are too rare are left out.
    """
    tally = LossTally.of(observation)
    return tally.test() if tally else None


class LossTally:
    """Sums over the messages of a run with ``noise.loss``."""

    def __init__(self, observation: Observation | Measurement) -> None:
        step = observation.step
        self.pairs: IntArray = np.argwhere(step.listens())  # (links, 2) receiver and sender of links in any graph
        links = len(self.pairs)
        self.probability = step.losses[self.pairs[:, 0], self.pairs[:, 1]]  # (links,)
        after_lost, after_kept = self.probability, self.probability
        if step.burst is not None:
            after_lost = np.where(self.probability > 0.0, 1.0 - 1.0 / step.burst, 0.0)
            after_kept = self.probability / (step.burst * (1.0 - self.probability))
        # Correlation of the losses of two successive messages of a link.
        self.persistence = after_lost - after_kept
        self._bursts = step.burst is not None
        self._products = observation.timers is None
        self.split = 0  # links of which only one direction was lost, where a loss takes both
        self.messages, self.lost = np.zeros(links, np.int64), np.zeros(links, np.int64)
        self.repeated = np.zeros(links, np.int64)  # in real time: uses of a message that was used before
        # Of messages after a lost one, after one that was not, and without one just before: chance, number, lost ones.
        self._chances = np.stack([after_lost, after_kept, self.probability])
        self._tried, self._failed = np.zeros((3, links), np.int64), np.zeros((3, links), np.int64)
        # Sums of products of standardised losses, of successive messages of a link and of pairs in one step: number of
        # products, and how many are expected to be of two rare events.
        self._successive, self._same_step = np.zeros(3), np.zeros(3)
        before = np.zeros((1, links), np.bool_), np.zeros((1, links), np.bool_)
        for first, last in observation.blocks(4 * links, "loss"):
            sent, lost, again = _uses(observation, links, first, last)
            if step.whole_link:
                self._join(sent, lost)
            before = self._add(sent, lost, again, before)

    @classmethod
    def of(cls, observation: Observation | Measurement) -> LossTally | None:
        """Tally of a run; None where no message can be lost, or no loss was logged."""
        if not observation.step.loss:
            return None
        if observation.timers is not None:
            # With the last value received in place of a lost one, the log does not tell lost messages from late ones.
            return None if observation.step.holds or observation.step.burst is not None else cls(observation)
        return cls(observation) if observation.lost is not None else None

    def merge(self, other: LossTally) -> None:
        """Add the tally of another run of the same experiment, with another seed."""
        add_sums(self, other, "messages", "lost", "repeated", "split", "_tried", "_failed", "_successive", "_same_step")

    def _join(self, sent: BoolArray, lost: BoolArray) -> None:
        """Count a link once, in place, whose directions (b, links) are lost together."""
        places = {(i, j): place for place, (i, j) in enumerate(self.pairs.tolist())}
        for (i, j), one in places.items():
            if i < j and (other := places.get((j, i))) is not None:
                both = sent[:, one] & sent[:, other]
                self.split += int((both & (lost[:, one] != lost[:, other])).sum())
                sent[both, other] = lost[both, other] = False

    def score(self) -> tuple[FloatArray, FloatArray]:
        """(links,) each: losses beyond the expected ones, and their information, of what says most about the chance."""
        # In bursts, whose mean length is given, the messages after one that was not lost.
        if self._bursts:
            chance, tried, failed = self._chances[1], self._tried[1], self._failed[1]
        else:
            chance, tried, failed = self.probability, self.messages, self.lost
        excess, variance = failed - chance * tried, tried * chance * (1.0 - chance)
        # Where messages are counted several times, each counts for less.
        return (excess, variance) if self._bursts else (excess / self.inflation, variance / self.inflation)

    def after_losses(self, chosen: BoolArray) -> tuple[float, float] | None:
        """Share of the messages after a lost one that were lost, too, and its expectation; None without bursts."""
        tried = int(self._tried[0][chosen].sum())
        if not self._bursts or not tried:
            return None
        failed, expected = self._failed[0][chosen].sum(), self._chances[0][chosen] @ self._tried[0][chosen]
        return float(failed / tried), float(expected / tried)

    @property
    def inflation(self) -> FloatArray:
        """(links,): variance of the number of losses over that of independent ones."""
        again = self.repeated.sum() / max(int((self.messages - self.lost).sum()), 1)
        return np.asarray((1.0 + self.persistence) / (1.0 - self.persistence) + 2.0 * again)

    def test(self) -> LossTest:
        """See ``loss_test``."""
        if not self.messages.any():
            return LossTest(0, 0.0, None)
        expected = float(self.probability @ self.messages)
        lost = int(self.lost.sum())
        if self.split or self.lost[self.probability == 0.0].any():
            return LossTest(lost, expected, 0.0)
        chi2, dof = self._counts()
        if self._products:
            for product, pairs, rare in (self._successive, self._same_step):
                if rare >= MIN_EXPECTED_LOSSES:
                    chi2, dof = chi2 + product**2 / pairs, dof + 1
        return LossTest(lost, expected, float(chi2_tail(chi2, dof)) if dof else None)

    def _counts(self) -> tuple[float, int]:
        """Chi-square, and its degrees of freedom, of the numbers of losses."""
        if self._bursts:
            chance, tried, failed, widened = self._chances.ravel(), self._tried.ravel(), self._failed.ravel(), 1.0
        else:
            chance, tried, failed = self.probability, self.messages, self.lost
            widened = float(self.inflation.max())
        used = (tried > 0) & (chance > 0.0)
        chance, tried, failed = chance[used], tried[used], failed[used]
        often = tried * np.minimum(chance, 1.0 - chance) >= MIN_EXPECTED_LOSSES
        parts = (failed - chance * tried)[often] ** 2 / (tried * chance * (1.0 - chance))[often]
        chi2, dof = float(parts.sum()) / widened, int(often.sum())
        for one in np.unique(chance[~often]).tolist():
            from scipy.stats import binomtest  # here, since it takes longer to import than all the rest

            same = ~often & (chance == one)
            p = float(binomtest(int(failed[same].sum()), int(tried[same].sum()), one).pvalue)
            chi2, dof = chi2 + float(chi2_quantile(p, 1)), dof + 1
        return chi2, dof

    def _add(
        self, sent: BoolArray, lost: BoolArray, again: BoolArray, before: tuple[BoolArray, BoolArray]
    ) -> tuple[BoolArray, BoolArray]:
        """Add a block of steps, given the last step before it; returns the last step of the block."""
        self.messages += sent.sum(axis=0)
        self.lost += lost.sum(axis=0)
        self.repeated += again.sum(axis=0)
        all_sent, all_lost = np.concatenate([before[0], sent]), np.concatenate([before[1], lost])
        known, failed = all_sent[:-1], all_lost[:-1]
        kinds = (sent & failed, sent & known & ~failed, sent & ~known)
        chance = np.zeros(sent.shape)
        for kind, here in enumerate(kinds):
            self._tried[kind] += here.sum(axis=0)
            self._failed[kind] += (here & lost).sum(axis=0)
            chance += here * self._chances[kind]
        spread = np.sqrt(chance * (1.0 - chance))
        xi = np.divide(lost - chance, spread, out=np.zeros(sent.shape), where=sent & (spread > 0.0))
        rare = np.where(sent, np.minimum(chance, 1.0 - chance), 0.0)
        drawn = sent & (spread > 0.0)
        self._same_step += [
            float((xi.sum(axis=1) ** 2 - (xi**2).sum(axis=1)).sum()) / 2,
            int((drawn.sum(axis=1) * (drawn.sum(axis=1) - 1) // 2).sum()),
            float((rare.sum(axis=1) ** 2 - (rare**2).sum(axis=1)).sum()) / 2,
        ]
        if not self._bursts:
            follows = drawn & known
            was = np.divide(failed - self.probability, spread, out=np.zeros(sent.shape), where=follows)
            self._successive += [float((xi * was).sum()), int(follows.sum()), float((follows * rare**2).sum())]
        return sent[-1:], lost[-1:]


def _uses(
    observation: Observation | Measurement, links: int, first: int, last: int
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """(b, links) of the steps first..last-1: whether there was a message, whether it was lost, or used before."""
    # In real time a message that is used again counts again: the share of the lost ones stays right, not its variance.
    step, timers, agents = observation.step, observation.timers, np.arange(observation.step.agents)
    tables = neighbour_tables(step)
    if timers is not None:
        graphs, used = timers.graphs[first:last], timers.used[first:last]
    else:
        assert observation.lost is not None
        graphs = np.repeat(observation.modes[first:last, None], step.agents, axis=1)
        used = np.where(observation.lost[first:last], -1, 0)
    numbers = (np.cumsum(step.listens().ravel()) - 1).reshape(step.agents, step.agents)
    number = numbers[agents[:, None], tables.senders[graphs, agents]]
    there = np.arange(step.most_neighbours) < tables.count[graphs, agents][:, :, None]
    # The message with x(0) is used several times where there is a delay, and never lost where values are held.
    there &= np.arange(first, last)[:, None, None] >= observation.sure_messages
    sent, lost, again = (np.zeros((len(used), links), np.bool_) for _ in range(3))
    k, i, d = np.nonzero(there)
    sent[k, number[k, i, d]] = True
    lost[k, number[k, i, d]] = used[k, i, d] < 0
    if timers is not None:
        newest = np.full((len(used), links), -1)
        newest[k, number[k, i, d]] = used[k, i, d]
        again[1:] = (newest[1:] >= 0) & (newest[1:] == newest[:-1])
    return sent, lost, again
