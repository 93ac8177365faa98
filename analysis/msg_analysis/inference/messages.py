# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about messages, and about the gains with which received values are used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import percent
from msg_analysis.inference.candidates import Cause, Selected, numbers_text
from msg_analysis.inference.counts import LossTally
from msg_analysis.inference.e_values import coefficient_evidence, proportion_evidence, variance_evidence
from msg_analysis.inference.question import (
    Block,
    Diagnostic,
    Finding,
    Law,
    Question,
    RunningSums,
    Search,
    Statistics,
    Test,
    one_test,
)
from msg_analysis.inference.statistics import binomial_interval, log_normal_tail


class Losses(Question):
    """Whether messages are lost as often as the experiment says."""

    name = "loss"
    meaning = "messages are lost more or less often, or in other sequences, than the file says"
    main = True

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of all links."""
        return one_test(cls.name, run.loss.p) if run.loss else []

    def number_of_tests(self) -> int:
        """None where no message is lost."""
        return int(self.law.step.loss > 0.0)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each link that loses messages independently."""
        i, j = self.law.lossy.T
        return proportion_evidence(sums.lost[:, i, j], sums.messages[:, i, j], self.law.step.losses[i, j])

    def about(self, row: int) -> str:
        """A link."""
        agent, other = (self.law.lossy[row] + 1).tolist()
        return f"losses from agent {other} to agent {agent}"

    @classmethod
    def classes(cls, search: Search) -> int:
        """Links, receivers, senders, all."""
        return len(search.losses.classes) if search.losses else 0

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Probabilities that explain the counted losses."""
        tally = search.loss_tally
        return [_loss_words(one, tally) for one in search.select(search.losses)] if tally else []


class Broadcast(Question):
    """Whether the noise in published values is as the experiment says."""

    name = "broadcast"
    meaning = "the noise in published values is larger, smaller, or correlated otherwise than in the file"

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of the covariance of all agents' noise."""
        return one_test(cls.name, run.p_broadcast)

    def number_of_tests(self) -> int:
        """None without this noise."""
        return int(self.law.step.broadcast > 0.0)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each agent."""
        if not sums.broadcast_samples.any():
            return super().evidence(sums)
        samples = np.broadcast_to(sums.broadcast_samples[:, None], sums.broadcast_squares.shape)
        return variance_evidence(samples, sums.broadcast_squares)

    def about(self, row: int) -> str:
        """An agent."""
        return f"broadcast noise of agent {row + 1}"

    @classmethod
    def classes(cls, search: Search) -> int:
        """Agents, all."""
        return len(search.broadcast.classes) if search.broadcast else 0

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """Variances that explain the squares of the noise."""
        return [_broadcast_words(one) for one in search.select(search.broadcast)]


def _loss_words(one: Selected, tally: LossTally) -> Cause:
    part, what = one.part, one.what
    receiver, sender = tally.pairs.T
    chosen = np.ones(len(receiver), dtype=np.bool_)
    agent, link, whose = None, None, "all messages"
    if part == "link":
        chosen = (sender == what[0]) & (receiver == what[1])
        link, whose = (what[0] + 1, what[1] + 1), f"the messages from agent {what[0] + 1} to agent {what[1] + 1}"
    elif part in ("receiver", "sender"):
        chosen = (receiver if part == "receiver" else sender) == what
        agent, whose = what + 1, f"the messages {'to' if part == 'receiver' else 'of'} agent {what + 1}"
    lost, messages = int(tally.lost[chosen].sum()), int(tally.messages[chosen].sum())
    weights = tally.messages[chosen] / messages
    expected = float(weights @ tally.probability[chosen])
    # In bursts, so many messages say as much as fewer independent ones.
    alike = float(weights @ tally.inflation[chosen])
    share, interval = lost / messages, binomial_interval(round(lost / alike), round(messages / alike))
    words = (
        f"{percent(share)} ({100 * interval[0]:.3g} to {100 * interval[1]:.3g} %) of {whose} are lost, "
        f"not {percent(expected)}"
    )
    again = tally.after_losses(chosen)
    if again:
        words += f"; after a lost one, {percent(again[0])} are, not {percent(again[1])}"
    return Cause("loss", words, agent, link, None, share, interval, expected, math.exp(one.log_p))


def _broadcast_words(one: Selected) -> Cause:
    part, what = one.part, one.what
    factor, interval = math.exp(one.estimate), (math.exp(one.interval[0]), math.exp(one.interval[1]))
    agent = what + 1 if part == "agent" else None
    whose = "all agents publish" if agent is None else f"agent {agent} publishes"
    words = f"the variance of the noise in what {whose} is {numbers_text(factor, interval)} times what the file says"
    return Cause("broadcast", words, agent, None, None, factor, interval, 1.0, math.exp(one.log_p))


MIN_SAMPLES = 100  # fewest steps of all replicas for the normal law of a score


class StaleValues(Diagnostic):
    """Regression of the residuals on weight * (neighbour's previous value - the one that was used).

    The coefficient is the share of stale values, expected 0. The test takes the clearest link, or all links together
    where agents are independent, with half of the level each and the number of coefficients as a factor (Bonferroni).
    """

    name = "residuals: stale values"
    meaning = "agents use values that are one step older than the log says"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        m = law.step.agents
        self._links, self._together = law.links, law.apart and len(law.links) > 1
        self._used = np.zeros((m, m), np.bool_)
        self._used[law.links[:, 0], law.links[:, 1]] = True
        self.score, self.information, self.samples = np.zeros((m, m)), np.zeros((m, m)), 0

    def add(self, block: Block) -> FloatArray:
        """Scores and information of all links."""
        received, analyses = block.reception, block.analyses
        steps, agents, neighbours = received.used.shape
        if not len(self._links):
            return np.empty((analyses.count, 0, 1))
        shape = analyses.count, agents, agents
        score, information = np.zeros((2, *shape))
        analysis = analyses.after(np.arange(steps))
        self.samples += steps * block.white.shape[2]
        receivers = np.broadcast_to(np.arange(agents), (steps, agents))
        for d in range(neighbours):
            senders, used = received.senders[:, :, d], received.used[:, :, d]
            there = self._used[receivers, senders] & (received.weights[:, :, d] != 0.0) & (used > 0)
            at, who = np.nonzero(there)
            sender, newest = senders[at, who], used[at, who]
            older = received.published[newest - 1, sender] - received.published[newest, sender]
            part = (received.weights[at, who, d] / block.scale[at, who])[:, None] * older
            place = np.ravel_multi_index((analysis[at], who, sender), shape)
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
            min(0.0, log_p),
            agent=agent,
            sender=sender,
            estimate=s / j,
            standard_error=1.0 / math.sqrt(j),
            expected=0.0,
        )

    def logarithms(self) -> FloatArray:
        """(links + 1, K): of each link, and of all together."""
        return self._evidence(self.score, self.information)

    def _evidence(self, *sums: FloatArray) -> FloatArray:
        """(..., links + 1, K), from score and information (..., m, m)."""
        rows = [each[..., self._links[:, 0], self._links[:, 1]] for each in sums]
        if self._together:
            rows = [np.concatenate([each, each.sum(axis=-1, keepdims=True)], axis=-1) for each in rows]
        return coefficient_evidence(*rows)

    def about(self, row: int) -> str:
        """A link, or all."""
        if row == len(self._links):
            return "stale values"
        receiver, sender = (self._links[row] + 1).tolist()
        return f"stale values from agent {sender} to agent {receiver}"

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], p: float) -> Cause:
        """The share of the values of a link, or of all."""
        del names
        agent, sender = found.agent, found.sender
        link = None if sender is None or agent is None else (sender + 1, agent + 1)
        which = f"the values of agent {link[0]} that agent {link[1]} uses" if link else "the values that agents use"
        value, (low, high) = found.estimate or 0.0, found.interval
        share = f"{percent(value)} ({100 * low:.3g} to {100 * high:.3g} %)"
        words = f"{share} of {which} are one step older than the log says"
        return Cause("stale", words, None, link, None, value, found.interval, found.expected, p)


class Gains(Question):
    """Whether residuals depend on the values that the agents used."""

    name = "residuals: gains"
    meaning = "a gain, a reference or an offset is not that of the file, or received values are not used as they should"
    main = True

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of all coefficients together."""
        return one_test(cls.name, run.residuals.p_gain)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each link and each leader."""
        i, j = self.law.gains.T
        return coefficient_evidence(sums.link_score[:, i, j], sums.link_information[:, i, j])

    def about(self, row: int) -> str:
        """A link or a leader."""
        agent, other = (self.law.gains[row] + 1).tolist()
        return f"gain of leader {agent}" if agent == other else f"gain of the link from agent {other} to agent {agent}"

    @classmethod
    def classes(cls, search: Search) -> int:
        """Links, edges, receivers, senders, graphs, leaders, offsets, the reference."""
        return len(search.gains.classes) if search.gains else 0

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """The changes of gains that explain the residuals."""
        return [_gain_words(one, search) for one in search.selected_gains[0]]


class CommonGain(Question):
    """Whether all gains are wrong by one factor, as where messages are ignored; its causes are those of the gains."""

    name = "residuals: common gain"
    meaning = "all gains are too small or too large by one factor, or messages have no effect"
    subject = "all gains"

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of one direction of the regression."""
        return one_test(cls.name, run.residuals.p_common_gain)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row, where the agents' residuals are independent."""
        if not self.law.apart:
            return super().evidence(sums)
        return coefficient_evidence(sums.common_score, sums.common_information)[:, None]


def _gain_words(one: Selected, search: Search) -> Cause:
    part, what = one.part, one.what
    names, p = search.names, math.exp(one.log_p)
    low, high = one.interval
    if part == "reference":
        at = search.experiment.reference
        numbers = numbers_text(at + one.estimate, (at + low, at + high))
        words = f"the leaders are pulled to {numbers}, not to the reference {at:g}"
        return Cause("reference", words, None, None, None, at + one.estimate, (at + low, at + high), at, p)
    if part == "offset":
        value, interval = (
            one.estimate / search.experiment.step_length,
            (low / search.experiment.step_length, high / search.experiment.step_length),
        )
        words = f"agent {what + 1} has an additional drift of {numbers_text(value, interval)} per unit of time"
        return Cause("offset", words, what + 1, None, None, value, interval, 0.0, p)
    factor, interval = 1.0 + one.estimate, (1.0 + low, 1.0 + high)
    if part in ("all", "sender") and -1.2 < one.estimate < 0.0:
        share, around = -one.estimate, (max(-high, 0.0), -low)
        whose = "all messages" if part == "all" else f"the messages of agent {what + 1}"
        shown = f"{percent(share)} ({100 * around[0]:.3g} to {100 * around[1]:.3g} %)"
        words = f"{shown} of {whose} have no effect: they are ignored, or all gains on them are too small by this share"
        return Cause("ignored", words, None if part == "all" else what + 1, None, None, share, around, 0.0, p)
    whose, agent, link, graph = _whose_gain(part, what)
    name = None if graph is None else names[graph]
    where = "" if name is None else f" in graph {name}"
    words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
    return Cause("gain", words, agent, link, name, factor, interval, 1.0, p)


def _whose_gain(part: str, what: Any) -> tuple[str, int | None, tuple[int, int] | None, int | None]:
    """In words; agent and link from 1, graph from 0."""
    if part == "link":
        sender, receiver, graph = what
        return f"the gain of agent {receiver + 1} on agent {sender + 1}", None, (sender + 1, receiver + 1), graph
    if part == "edge":
        pair, graph = what
        first, second = sorted(pair)
        return f"the gain of edge {first + 1}-{second + 1} in both directions", None, (first + 1, second + 1), graph
    if part == "receiver in graph":
        return f"agent {what[0] + 1}'s gain on all that it receives", what[0] + 1, None, what[1]
    if part == "receiver":
        return f"agent {what + 1}'s gain on all that it receives", what + 1, None, None
    if part == "leader":
        return f"agent {what + 1}'s gain as a leader", what + 1, None, None
    if part == "sender":
        return f"the gain of all others on agent {what + 1}", what + 1, None, None
    if part == "graph":
        return "every gain", None, None, what
    return ("the gain of the leaders" if part == "leaders" else "every gain"), None, None, None
