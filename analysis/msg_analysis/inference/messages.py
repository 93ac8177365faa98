# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Tests of messages: losses, stale values, messages that came too late.

Tests of the logged message losses, link by link: their number, their runs, and losses of links at the same time.

Given the graphs, the losses of a link are independent, or with ``noise.burst`` a Markov chain with two states. In
lockstep the log has the fate of every message of an active link. In real time it has that of every use: a message that
is used again counts again, which leaves the share of the lost ones right, but not its variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray, column
from msg_analysis.common.text import percent
from msg_analysis.inference.diagnostics import Block, Departure, Finding, Law, Question
from msg_analysis.inference.e_values import coefficient_evidence
from msg_analysis.inference.observation import Measurement, Observation
from msg_analysis.inference.received_values import mode_links
from msg_analysis.inference.statistics import binomial_interval, chi2_quantile, chi2_tail, log_normal_tail
from msg_analysis.model.reception import neighbour_tables

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
        self._products = observation.timers is None if isinstance(observation, Observation) else True
        self.messages, self.lost = np.zeros(links, np.int64), np.zeros(links, np.int64)
        self.repeated = np.zeros(links, np.int64)  # in real time: uses of a message that was used before
        # Of messages after a lost one, after one that was not, and without one just before: chance, number, lost ones.
        self._chances = np.stack([after_lost, after_kept, self.probability])
        self._tried, self._failed = np.zeros((3, links), np.int64), np.zeros((3, links), np.int64)
        # Sums of products of standardised losses, of successive messages of a link and of pairs in one step: number of
        # products, and how many are expected to be of two rare events.
        self._successive, self._same_step = np.zeros(3), np.zeros(3)
        numbers = np.cumsum(step.listens().ravel()).reshape(step.agents, step.agents) - 1
        graphs = []
        for mode in range(step.modes):
            receiver, sender, which = mode_links(step, mode)
            graphs.append((numbers[receiver, sender], receiver, which))
        before = np.zeros((1, links), np.bool_), np.zeros((1, links), np.bool_)
        for first, last in observation.blocks(4 * links, "loss"):
            before = self._add(*_block(observation, graphs, links, first, last), before)

    @classmethod
    def of(cls, observation: Observation | Measurement) -> LossTally | None:
        """Tally of a run; None where no message can be lost, or no loss was logged."""
        if not observation.step.loss:
            return None
        if isinstance(observation, Observation) and observation.timers is not None:
            # With the last value heard in place of a lost one, the log does not tell lost messages from late ones.
            return None if observation.step.holds or observation.step.burst is not None else cls(observation)
        return cls(observation) if observation.lost is not None else None

    def merge(self, other: LossTally) -> None:
        """Add the tally of another run of the same experiment, with another seed."""
        self.messages += other.messages
        self.lost += other.lost
        self.repeated += other.repeated
        self._tried += other._tried
        self._failed += other._failed
        self._successive += other._successive
        self._same_step += other._same_step

    def score(self) -> tuple[FloatArray, FloatArray]:
        """(links,) each: losses beyond the expected ones, and their information, of what says most about the chance.

        In bursts, whose mean length is given, that are the messages after one that was not lost.
        """
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
        if self.lost[self.probability == 0.0].any():
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


def _block(
    observation: Observation | Measurement,
    graphs: list[tuple[IntArray, IntArray, IntArray]],
    links: int,
    first: int,
    last: int,
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """(b, links) of the steps first..last-1: whether there was a message, whether it was lost, or used before."""
    if isinstance(observation, Observation) and observation.timers is not None:
        return _uses(observation, links, first, last)
    assert observation.lost is not None
    modes, logged = observation.modes[first:last], observation.lost[first:last]
    sent, lost = np.zeros((len(modes), links), np.bool_), np.zeros((len(modes), links), np.bool_)
    for mode, (number, receiver, which) in enumerate(graphs):
        at = np.flatnonzero(modes == mode)[:, None]
        sent[at, number] = True
        lost[at, number] = logged[at, receiver, which]
    # The message with x(0) is used several times where there is a delay, and never lost where values are held.
    early = np.arange(first, last) < observation.sure_messages
    sent[early], lost[early] = False, False
    return sent, lost, np.zeros_like(sent)


def _uses(observation: Observation, links: int, first: int, last: int) -> tuple[BoolArray, BoolArray, BoolArray]:
    """The same of a run in real time."""
    step, timers = observation.step, observation.timers
    assert timers is not None
    tables, agents = neighbour_tables(step), np.arange(step.agents)
    graphs, used = timers.graphs[first:last], timers.used[first:last]
    numbers = (np.cumsum(step.listens().ravel()) - 1).reshape(step.agents, step.agents)
    number = numbers[agents[:, None], tables.senders[graphs, agents]]
    there = np.arange(step.most_neighbours) < tables.count[graphs, agents][:, :, None]
    there &= np.arange(first, last)[:, None, None] >= observation.sure_messages
    sent, lost, again = (np.zeros((len(used), links), np.bool_) for _ in range(3))
    k, i, d = np.nonzero(there)
    sent[k, number[k, i, d]] = True
    lost[k, number[k, i, d]] = used[k, i, d] < 0
    newest = np.full((len(used), links), -1)
    newest[k, number[k, i, d]] = used[k, i, d]
    again[1:] = (newest[1:] >= 0) & (newest[1:] == newest[:-1])
    return sent, lost, again


MIN_SAMPLES = 100  # fewest steps of all replicas for the normal law of a score


class StaleValues(Departure):
    """Regression of the innovations on weight * (neighbour's previous value - the one that was used).

    The coefficient is the share of stale values, expected 0. The test takes the clearest link, or all links together
    where agents are independent, with half of the level each and the number of coefficients as a factor (Bonferroni).
    """

    test = "innovations: stale values"

    def __init__(self, law: Law) -> None:
        m = law.step.agents
        self._links, self._together = law.links, law.apart and len(law.links) > 1
        self._used = np.zeros((m, m), np.bool_)
        self._used[law.links[:, 0], law.links[:, 1]] = True
        self.score, self.information, self.samples = np.zeros((m, m)), np.zeros((m, m)), 0

    def add(self, block: Block) -> FloatArray:
        """Scores and information of all links."""
        heard, looks = block.reception, block.looks
        steps, agents, neighbours = heard.used.shape
        if not len(self._links):
            return np.empty((looks.count, 0, 1))
        shape = looks.count, agents, agents
        score, information = np.zeros((2, *shape))
        look = looks.after(np.arange(steps))
        self.samples += steps * block.white.shape[2]
        receivers = np.broadcast_to(np.arange(agents), (steps, agents))
        for d in range(neighbours):
            senders, used = heard.senders[:, :, d], heard.used[:, :, d]
            there = self._used[receivers, senders] & (heard.weights[:, :, d] != 0.0) & (used > 0)
            at, who = np.nonzero(there)
            sender, newest = senders[at, who], used[at, who]
            older = heard.published[newest - 1, sender] - heard.published[newest, sender]
            part = (heard.weights[at, who, d] / block.scale[at, who])[:, None] * older
            place = np.ravel_multi_index((look[at], who, sender), shape)
            for total, values in ((score, part * block.white[at, who]), (information, part**2)):
                total += np.bincount(place, values.sum(axis=1), minlength=total.size).reshape(shape)
        score, information = self.score + score.cumsum(axis=0), self.information + information.cumsum(axis=0)
        self.score, self.information = score[-1], information[-1]
        return self._evidence(score, information)

    def merge(self, other: Self) -> None:
        """Sums over steps."""
        self.score += other.score
        self.information += other.information
        self.samples += other.samples

    def finding(self) -> Finding | None:
        """The clearest link, or all."""
        score, information = (each[self._links[:, 0], self._links[:, 1]] for each in (self.score, self.information))
        if self.samples < MIN_SAMPLES or not (information > 0.0).any():
            return None
        z = score / np.sqrt(np.where(information > 0.0, information, np.inf))
        row = int(np.argmax(np.abs(z)))
        groups = 2.0 if self._together else 1.0
        log_p = math.log(2.0 * len(z) * groups) + float(log_normal_tail(abs(z[row])))
        receiver, sender = self._links[row].tolist()
        best = (log_p, receiver, sender, float(score[row]), float(information[row]))
        if self._together:
            s, j = float(score.sum()), float(information.sum())
            log_p = math.log(2.0 * groups) + float(log_normal_tail(abs(s) / math.sqrt(j)))
            best = min(best, (log_p, None, None, s, j), key=lambda candidate: candidate[0])
        log_p, agent, sender, s, j = best
        return Finding(
            self.test,
            min(0.0, log_p),
            agent=agent,
            sender=sender,
            estimate=s / j,
            standard_error=1.0 / math.sqrt(j),
            expected=0.0,
        )

    def evidence(self) -> FloatArray:
        """(links + 1, K): of each link, and of all together."""
        return self._evidence(self.score, self.information)

    def _evidence(self, *sums: FloatArray) -> FloatArray:
        """(..., links + 1, K), from score and information (..., m, m)."""
        rows = [each[..., self._links[:, 0], self._links[:, 1]] for each in sums]
        if self._together:
            rows = [np.concatenate([each, each.sum(axis=-1, keepdims=True)], axis=-1) for each in rows]
        return coefficient_evidence(*rows)

    def questions(self) -> list[Question]:
        """A link, or all."""
        links = (self._links + 1).tolist()
        named = [f"stale values from agent {sender} to agent {receiver}" for receiver, sender in links]
        return [(words, ()) for words in [*named, "stale values"]]


SHOWN_LINKS = 20
LEAST_EXCESS = 0.01  # smallest difference of shares that is put into words: a busy machine has a few late messages


@dataclass(frozen=True, slots=True)
class UnheardMessages:
    """By directed link.

    A message is judged at the first step of its receiver after it was published and at the next one, if the link is
    active in both and no newer message was published before the first: it was heard in time if one of them used it.
    With timers that keep their periods, and messages faster than a period, those that were not are the lost ones.
    """

    links: IntArray  # (L, 2) receiver and sender
    messages: IntArray  # (L,) that could be judged
    unheard: IntArray  # (L,) of these
    probability: FloatArray  # (L,) that the experiment loses a message
    inflation: float  # variance of the number of losses over that of independent ones (bursts)

    @property
    def expected(self) -> FloatArray:
        """(L,): messages that the experiment loses."""
        return self.messages * self.probability

    def share(self, which: Any = slice(None)) -> tuple[float, tuple[float, float], float]:
        """Share of some links' messages, its 95 % interval, and what the experiment loses; 0 where there was none."""
        messages, unheard = int(self.messages[which].sum()), int(self.unheard[which].sum())
        if not messages:
            return 0.0, (0.0, 1.0), 0.0
        interval = binomial_interval(round(unheard / self.inflation), max(round(messages / self.inflation), 1))
        return unheard / messages, interval, float(self.expected[which].sum()) / messages

    def words(self) -> str | None:
        """What differs from the experiment, without a full stop; None where nothing does."""
        share, (low, high), expected = self.share()
        if low <= expected <= high or abs(share - expected) < LEAST_EXCESS:
            return None
        text = (
            f"{percent(share)} ({100 * low:.3g} to {100 * high:.3g} %) of the messages between agents were not heard "
            f"in time, while the experiment loses {percent(expected)}: "
        )
        text += "the network lost them or was late" if share > expected else "the experiment's losses were not made"
        place = int(self._order[0])
        worst = self.share(place)[0]
        receiver, sender = (self.links[place] + 1).tolist()
        return f"{text}; most different: {percent(worst)} of those from agent {sender} to agent {receiver}"

    def to_json(self) -> dict[str, Any]:
        """The JSON document: all links together, and those that differ most from the experiment."""
        share, interval, expected = self.share()
        rows = []
        for place in self._order[:SHOWN_LINKS].tolist():
            found, around, should = self.share(place)
            receiver, sender = self.links[place].tolist()
            row = {"sender": sender + 1, "receiver": receiver + 1, "messages": int(self.messages[place])}
            row |= {"unheard": int(self.unheard[place]), "share": found, "interval": list(around), "expected": should}
            rows.append(row)
        return {
            "messages": int(self.messages.sum()),
            "unheard": int(self.unheard.sum()),
            "share": share,
            "interval": list(interval),
            "expected": expected,
            "words": self.words(),
            "links": rows,
        }

    @property
    def _order(self) -> IntArray:
        """(L,): places of the links, those first that differ most, in standard errors."""
        spread = np.sqrt(np.maximum(self.expected * (1.0 - self.probability), 1.0))
        return np.argsort(-np.abs(self.unheard - self.expected) / spread, kind="stable")


def unheard_messages(observation: Observation) -> UnheardMessages:
    """Judge the messages of a run in real time, see ``UnheardMessages``; with a delay, so many steps later."""
    timers, step = observation.timers, observation.step
    assert timers is not None
    tables = neighbour_tables(step)
    links = np.argwhere(step.listens())
    messages, unheard = np.zeros(len(links), np.int64), np.zeros(len(links), np.int64)
    late = step.delay
    steps = len(timers.graphs) - 1 - late  # that can be the first one after a message was published
    for receiver in np.unique(links[:, 0]).tolist() if steps >= 1 else ():
        graphs, made = column(timers.graphs, receiver), column(timers.made, receiver)
        there = np.arange(step.most_neighbours) < tables.count[graphs, receiver][:, None]
        senders, heard = tables.senders[graphs, receiver], column(timers.used, receiver)
        for number in np.flatnonzero(links[:, 0] == receiver).tolist():
            sender = int(links[number, 1])
            chosen = there & (senders == sender)  # (N, D): at most one of a step
            active = chosen.any(axis=1)
            used = np.where(chosen, heard, -1).max(axis=1, initial=-1)
            first, second = used[late : late + steps], used[late + 1 : late + 1 + steps]
            newest = np.searchsorted(column(timers.made, sender), made[1 : steps + 1], side="left") - 1
            newest = np.maximum(newest, first)  # of equal times, a value comes before the steps that use it
            judged = active[late : late + steps] & active[late + 1 : late + 1 + steps]
            judged &= np.diff(newest, prepend=newest[0]) > 0
            judged[: observation.sure_messages] = False
            messages[number] = judged.sum()
            unheard[number] = (judged & (first != newest) & (second != newest)).sum()
    probability = step.losses[links[:, 0], links[:, 1]] if step.loss else np.zeros(len(links))
    persistence = 0.0
    if step.burst is not None and probability.any():
        chance = float(probability.max())
        persistence = 1.0 - 1.0 / step.burst - chance / (step.burst * (1.0 - chance))
    inflation = (1.0 + persistence) / (1.0 - persistence)
    return UnheardMessages(links, messages, unheard, np.asarray(probability), inflation)
