# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The question about links, or steps of agents: whether each comes and goes as often as the file says.

Given the past, what a link does in a step is a coin with a known probability, whatever the other links do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from msg_analysis.common.arrays import AnyArray, FloatArray
from msg_analysis.experiment.links import LinkSchedule
from msg_analysis.inference.e_values import proportion_evidence
from msg_analysis.inference.graphs import MIN_EXPECTED
from msg_analysis.inference.question import Block, Finding, Law, SummedDiagnostic, agent_words
from msg_analysis.inference.statistics import binomial_interval, log_chi2_tail


class LinkRates(SummedDiagnostic):
    """Steps counted by link and by whether it was up, and those after which it was not any more, or was."""

    name = "links"
    meaning = "a link, or the steps of an agent, do not come and go as often as the file says"
    kind = "link"
    about_chain = True

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        path = law.step.switching
        self._links = path.law if isinstance(path, LinkSchedule) else None
        self._there = path.there if isinstance(path, LinkSchedule) else np.zeros((0, 0), dtype=np.bool_)
        count = self._there.shape[1]
        self._chance = np.stack([self._links.rise, self._links.fall], axis=1) if self._links else np.zeros((0, 2))
        self.sums = list(np.zeros((2, count, 2), np.int64))  # steps of links that are down and up, and their changes

    def between(self, block: Block) -> list[AnyArray]:
        """(T, E, 2) each."""
        steps, changes = np.zeros((2, block.analyses.count, *self._chance.shape), np.int64)
        if self._links and len(block.graphs) > 1:
            there = self._there[block.graphs]
            now, changed = there[:-1], there[1:] != there[:-1]
            after = block.analyses.after(np.arange(len(now)))
            for up, state in enumerate((~now, now)):
                np.add.at(steps[..., up], after, state)
                np.add.at(changes[..., up], after, state & changed)
        return [steps, changes]

    def finding(self) -> Finding | None:
        """The link whose changes are furthest from what the file says."""
        if self._links is None:
            return None
        steps, changes = (each.astype(float) for each in self.sums)
        excess, variance = changes - steps * self._chance, steps * self._chance * (1.0 - self._chance)
        # What the law gives, not what was seen, decides which links have a term of their own; the others have one.
        share = np.stack([1.0 - self._links.shares, self._links.shares], axis=1)
        planned = steps.sum(axis=1, keepdims=True) * share * self._chance * (1.0 - self._chance)
        alone = (planned >= MIN_EXPECTED) & (variance > 0.0)
        z = np.divide(excess, np.sqrt(variance), out=np.zeros_like(excess), where=variance > 0.0)
        terms = z[alone] ** 2
        if planned[~alone].sum() >= MIN_EXPECTED and variance[~alone].any():
            terms = np.append(terms, excess[~alone].sum() ** 2 / variance[~alone].sum())
        # One link that is far off, or many that are a little.
        log_p = None
        if len(terms):
            largest = math.log(len(terms)) + log_chi2_tail(float(terms.max()), 1)
            log_p = min(0.0, math.log(2.0) + min(largest, log_chi2_tail(float(terms.sum()), len(terms))))
        impossible = (variance == 0.0) & (excess != 0.0)
        link, up = np.unravel_index(int(np.argmax(np.where(impossible, np.inf, np.abs(z)))), z.shape)
        if impossible.any():
            log_p = -math.inf
        elif log_p is None:
            return None
        source, target, _ = self._links.ends[link]
        chance, seen, tried = float(self._chance[link, up]), int(changes[link, up]), int(steps[link, up])
        scale = chance or 1.0
        low, high = binomial_interval(seen, tried) if tried else (0.0, 1.0)
        return Finding(
            log_p,
            agent=target,
            sender=None if source == target else source,
            held=bool(up),
            estimate=seen / max(tried, 1) / scale,
            expected=1.0 if chance else 0.0,
            ends=(low / scale, high / scale),
        )

    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., E + 1, K): of each link, and of all."""
        steps, changes = sums
        certain = (self._chance == 0.0) | (self._chance == 1.0)
        each = proportion_evidence(changes, steps, np.where(certain, 0.5, self._chance))
        wrong = changes != np.where(self._chance == 1.0, steps, 0)
        each = np.where(certain[..., None], np.where(wrong, np.inf, 0.0)[..., None], each).sum(axis=-2)
        return np.concatenate([each, each.sum(axis=-2, keepdims=True)], axis=-2) if self._links else each

    def about(self, row: int) -> str:
        """A link, or all."""
        if self._links is None or row >= len(self._links):
            return f"the {self._links.noun}s" if self._links else "the links"
        return f"{self._links.noun} {self._links.words(row, None)}"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """How often a link, or the steps of an agent, come or go, next to the file."""
        del names
        assert found.agent is not None
        if found.sender is None:
            who, what = agent_words(found.agent), "makes a step after one that it left out"
            what = "leaves out a step after one that it made" if found.held else what
        else:
            who, what = f"link {found.sender + 1}-{found.agent + 1}", "goes down" if found.held else "comes up"
        if not found.expected:
            return f"{who} {what}, which the file excludes"
        return f"{who} {what} {found.numbers} times as often as the file says"
