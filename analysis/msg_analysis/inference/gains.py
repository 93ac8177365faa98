# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about the gains of links and of leaders' pulls: regression of the residuals on what was received."""

from __future__ import annotations

import math
from typing import Any

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import percent
from msg_analysis.inference.candidates import Cause, Selected, numbers_text
from msg_analysis.inference.e_values import coefficient_evidence
from msg_analysis.inference.question import Question, RunningSums, Search, Statistics, Test, one_test


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

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of one direction of the regression."""
        return one_test(cls.name, run.residuals.p_common_gain)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """One row, where the agents' residuals are independent."""
        if not self.law.apart:
            return super().evidence(sums)
        return coefficient_evidence(sums.common_score, sums.common_information)[:, None]

    def about(self, row: int) -> str:
        """One row."""
        del row
        return "all gains"


def _gain_words(one: Selected, search: Search) -> Cause:
    part, what = one.part, one.what
    names, p = search.names, math.exp(one.log_p)
    low, high = one.interval
    if part == "reference":
        at = search.reference
        numbers = numbers_text(at + one.estimate, (at + low, at + high))
        words = f"the leaders are pulled to {numbers}, not to the reference {at:g}"
        return Cause("reference", words, None, None, None, at + one.estimate, (at + low, at + high), at, p)
    if part == "offset":
        value, interval = one.estimate / search.dt, (low / search.dt, high / search.dt)
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
