# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about messages, and about the gains with which received values are used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from msg_analysis.common.arrays import AnyArray, FloatArray
from msg_analysis.common.text import percent
from msg_analysis.inference.candidates import Cause, Selected, numbers_text, share_text
from msg_analysis.inference.e_values import coefficient_evidence, proportion_evidence, variance_evidence
from msg_analysis.inference.question import Block, Finding, Law, Question, RunningSums, Search, SummedDiagnostic
from msg_analysis.inference.statistics import binomial_interval, log_normal_tail


class MessageLosses(Question):
    """Whether messages are lost as often as the experiment says."""

    name = "loss"
    meaning = "messages are lost more or less often, or in other sequences, than the file says"
    main = True
    p_value = attrgetter("p_loss")
    parameters = "loss"

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
    def causes(cls, search: Search) -> list[Cause]:
        """Directions of links that were not lost together, though they must be; else probabilities."""
        if search.loss is None or not search.loss.split:
            return super().causes(search)
        words = f"one direction of a link was lost without the other {search.loss.split} times, where a loss takes both"
        return [Cause("loss", words, estimate=float(search.loss.split), expected=0.0, p=0.0)]

    @classmethod
    def cause_of(cls, one: Selected, search: Search) -> Cause:
        """A probability that explains the counted losses, of a link, a receiver, a sender or all."""
        part, what, tally = one.part, one.what, search.loss
        assert tally is not None
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
        words = f"{share_text(share, interval)} of {whose} are lost, not {percent(expected)}"
        again = tally.after_losses(chosen)
        if again:
            words += f"; after a lost one, {percent(again[0])} are, not {percent(again[1])}"
        return Cause("loss", words, agent, link, None, share, interval, expected, math.exp(one.log_p))


class Broadcast(Question):
    """Whether the noise in published values is as the experiment says."""

    name = "broadcast"
    meaning = "the noise in published values is larger, smaller, or correlated otherwise than in the file"
    p_value = attrgetter("p_broadcast")
    parameters = "broadcast"

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
    def cause_of(cls, one: Selected, search: Search) -> Cause:
        """A variance that explains the squares of the noise."""
        del search
        factor, interval = one.factor
        agent = one.what + 1 if one.part == "agent" else None
        whose = "all agents publish" if agent is None else f"agent {agent} publishes"
        words = (
            f"the variance of the noise in what {whose} is {numbers_text(factor, interval)} times what the file says"
        )
        return Cause("broadcast", words, agent, None, None, factor, interval, 1.0, math.exp(one.log_p))


MIN_SAMPLES = 100  # fewest steps of all replicas for the normal law of a score


class StaleValues(SummedDiagnostic):
    """Regression of residuals on weight * (neighbour's previous value - the used one): the share of stale values."""

    name = "residuals: stale values"
    meaning = "agents use values that are one step older than the log says"
    kind = "stale"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        m = law.step.agents
        self._links, self.together = law.links, law.apart and len(law.links) > 1
        self._used = np.zeros((m, m), np.bool_)
        self._used[law.links[:, 0], law.links[:, 1]] = True
        # Score and information of every link, and samples of each.
        self.sums = [np.zeros((m, m)), np.zeros((m, m)), np.zeros((), np.int64)]

    def between(self, block: Block) -> list[AnyArray]:
        """Scores and information of all links."""
        received, analyses = block.reception, block.analyses
        steps, agents, neighbours = received.used.shape
        shape = analyses.count, agents, agents
        score, information = np.zeros((2, *shape))
        samples = analyses.lengths * block.white.shape[2]
        if not len(self._links):
            return [score, information, samples]
        analysis = analyses.after(np.arange(steps))
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
        return [score, information, samples]

    def finding(self) -> Finding | None:
        """The clearest link, or all."""
        score, information = (each[self._links[:, 0], self._links[:, 1]] for each in self.sums[:2])
        if self.sums[2] < MIN_SAMPLES or not (information > 0.0).any():
            return None
        # Only positive ones are shares of stale values: one-sided.
        z = score / np.sqrt(np.where(information > 0.0, information, np.inf))
        row = int(np.argmax(z))
        groups = 2.0 if self.together else 1.0
        log_p = math.log(len(z) * groups) + float(log_normal_tail(z[row]))
        receiver, sender = self._links[row].tolist()
        s, j = float(score[row]), float(information[row])
        if self.together:
            all_s, all_j = float(score.sum()), float(information.sum())
            p_of_all = math.log(groups) + float(log_normal_tail(all_s / math.sqrt(all_j)))
            if p_of_all < log_p:
                log_p, receiver, sender, s, j = p_of_all, None, None, all_s, all_j
        error = 1.0 / math.sqrt(j)
        share = min(max(s / j, 0.0), 1.0)
        return Finding(
            min(0.0, log_p),
            receiver,
            sender,
            estimate=share,
            standard_error=error,
            expected=0.0,
            possible=(0.0, 1.0),
        )

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., links + 1, K): of each link, and of all together."""
        rows = (self.columns(each[..., self._links[:, 0], self._links[:, 1]]) for each in sums[:2])
        return coefficient_evidence(*rows)

    def about(self, row: int) -> str:
        """A link, or all."""
        if row == len(self._links):
            return "stale values"
        receiver, sender = (self._links[row] + 1).tolist()
        return f"stale values from agent {sender} to agent {receiver}"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """The share of the values of a link, or of all."""
        del names
        which = "the values that agents use"
        if found.agent is not None and found.sender is not None:
            which = f"the values of agent {found.sender + 1} that agent {found.agent + 1} uses"
        share = share_text(found.estimate or 0.0, found.interval or (0.0, 0.0))
        return f"{share} of {which} are one step older than the log says"


class Gains(Question):
    """Whether residuals depend on the values that the agents used."""

    name = "residuals: gains"
    meaning = "a gain, a reference or an offset is not that of the file, or received values are not used as they should"
    main = True
    p_value = attrgetter("residuals.p_gain")
    parameters = "gains"

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row for each link and each leader."""
        i, j = self.law.gains.T
        return coefficient_evidence(sums.link_score[:, i, j], sums.link_information[:, i, j])

    def about(self, row: int) -> str:
        """A link or a leader."""
        agent, other = (self.law.gains[row] + 1).tolist()
        return f"gain of leader {agent}" if agent == other else f"gain of the link from agent {other} to agent {agent}"

    @classmethod
    def cause_of(cls, one: Selected, search: Search) -> Cause:
        """A change of gains that explains the residuals."""
        part, what, experiment = one.part, one.what, search.experiment
        (low, high), p = one.interval, math.exp(one.log_p)
        if part == "reference":
            at = experiment.reference
            value, interval = at + one.estimate, (at + low, at + high)
            agent, which = (None, "the leaders are") if what is None else (what + 1, f"agent {what + 1} is")
            words = f"{which} pulled to {numbers_text(value, interval)}, not to the reference {at:g}"
            return Cause("reference", words, agent, None, None, value, interval, at, p)
        if part == "offset":
            dt = experiment.step_length
            value, interval = one.estimate / dt, (low / dt, high / dt)
            words = f"agent {what + 1} has an additional drift of {numbers_text(value, interval)} per unit of time"
            return Cause("offset", words, what + 1, None, None, value, interval, 0.0, p)
        if part in ("all", "sender") and -1.2 < one.estimate < 0.0:
            value, interval = min(-one.estimate, 1.0), (max(-high, 0.0), min(-low, 1.0))
            agent = None if part == "all" else what + 1
            whose = "all messages" if agent is None else f"the messages of agent {agent}"
            words = (
                f"{share_text(value, interval)} of {whose} have no effect: they are ignored, or all gains on them are "
                "too small by this share"
            )
            return Cause("ignored", words, agent, None, None, value, interval, 0.0, p)
        factor, interval = 1.0 + one.estimate, (1.0 + low, 1.0 + high)
        whose, agent, link, graph = whose_gain(part, what)
        name = None if graph is None else search.names[graph]
        where = "" if name is None else f" in graph {name}"
        words = f"{whose}{where} is {numbers_text(factor, interval)} times what the file says"
        return Cause("gain", words, agent, link, name, factor, interval, 1.0, p)


class CommonGain(Question):
    """Whether all gains are wrong by one factor, as where messages are ignored; its causes are those of the gains."""

    name = "residuals: common gain"
    meaning = "all gains are too small or too large by one factor, or messages have no effect"
    subject = "all gains"
    p_value = attrgetter("residuals.p_common_gain")

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row, where the agents' residuals are independent."""
        if not self.law.apart:
            return super().evidence(sums)
        return coefficient_evidence(sums.common_score, sums.common_information)[:, None]


def whose_gain(part: str, what: Any) -> tuple[str, int | None, tuple[int, int] | None, int | None]:
    """In words; agent and link from 1, graph from 0."""
    if part == "link":
        sender, receiver, graph = what
        return f"the gain of agent {receiver + 1} on agent {sender + 1}", None, (sender + 1, receiver + 1), graph
    if part == "edge":
        pair, graph = what
        first, second = sorted(pair)
        return f"the gain of edge {first + 1}-{second + 1} in both directions", None, (first + 1, second + 1), graph
    if part in ("graph", "leaders", "all"):
        return "the gain of the leaders" if part == "leaders" else "every gain", None, None, what
    agent, graph = what if part == "receiver in graph" else (what, None)
    whose = {
        "leader": f"agent {agent + 1}'s gain as a leader",
        "sender": f"the gain of all others on agent {agent + 1}",
    }
    return whose.get(part, f"agent {agent + 1}'s gain on all that it receives"), agent + 1, None, graph
