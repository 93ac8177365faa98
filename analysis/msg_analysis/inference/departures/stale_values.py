# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Stale values: an agent uses the value that a neighbour published one step before the one that the log says."""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from msg_analysis.inference.departures.departure import Block, Departure, Finding, Law, Question
from msg_analysis.inference.evidence.mixture_evidence import coefficient_evidence
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.types import FloatArray

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
