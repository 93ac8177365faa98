# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Search for the best set of leaders: enumeration, greedy choice, exchange of single leaders, and a bound of the gap.

Only E(S), the system error of a set S, is known here. Where E is supermodular, gains for a smaller set bound those for
a larger one: evaluation is then lazy (Minoux 1978; "CELF", Leskovec et al. 2007), with the result of evaluating every
candidate. Where E is not supermodular, every candidate is evaluated.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Protocol

Leaders = frozenset[int]
SearchProgress = Callable[[str, int, int, float], None]  # (stage, done, of how many, least E among the sets just tried)

TIE = 1e-9  # relative difference below which two system errors count as equal: the lower agents are preferred
STARTS = 3  # number of greedy sets from which exchanges start
_ROUNDING = 1e-10  # slack of every bound, relative to E: well above the error of a solve and well below TIE


class SetFunction(Protocol):
    """The function of a set of leaders that is minimised."""

    @property
    def agents(self) -> int:
        """Number of agents m."""

    @property
    def supermodular(self) -> bool:
        """Whether E(A) - E(A + v) >= E(B) - E(B + v) >= 0 is known for every A inside B and every v outside B."""

    def unreached(self, leaders: Leaders) -> int:
        """Number of agents that no leader reaches in the union of all graphs; E is finite only if it is 0."""

    def system_error(self, leaders: Leaders) -> float:
        """E(S) of a set that reaches all agents."""


class LeaderSearch:
    """One search, which keeps the value of every set that it has evaluated; agents count from 0."""

    def __init__(self, function: SetFunction, watch: SearchProgress | None = None) -> None:
        self._function = function
        self._watch = watch
        self._known: dict[Leaders, float] = {}
        self._bases: list[Leaders] = []
        self._stage, self._done, self._total = "", 0, 0
        self.evaluations = 0  # number of solves so far

    def exhaustive(self, count: int, top: int) -> list[tuple[float, Leaders]]:
        """The ``top`` best (E, set) of all sets of ``count`` agents with finite E, best first."""
        self._begin("all sets", math.comb(self._function.agents, count))
        least = math.inf

        def values() -> Iterable[tuple[float, tuple[int, ...]]]:
            nonlocal least
            for members in combinations(range(self._function.agents), count):
                value = self._solve(frozenset(members))
                least = min(least, value)
                self._advance(1, least)
                if math.isfinite(value):
                    yield value, members

        # Compared to 9 digits: rounding must not decide which of equal sets are among the first.
        best = heapq.nsmallest(top, values(), key=lambda entry: (float(f"{entry[0]:.8e}"), entry[1]))
        return _ranked([(value, frozenset(members)) for value, members in best])[:top]

    def greedy(self, count: int, first: int | None = None) -> list[int]:
        """Agents in the order in which they are chosen: each is the best one beside those before it, or ``first``."""
        # As long as no agent makes E finite, the one that leaves the fewest unreached is chosen: see _best_addition.
        self._begin("greedy" if first is None else f"greedy after agent {first + 1}", count * self._function.agents)
        chosen = [] if first is None else [first]
        while len(chosen) < count:
            agent, value = self._best_addition(frozenset(chosen))
            chosen.append(agent)
            self._done = len(chosen) * self._function.agents
            self._advance(0, value)
        return chosen

    def swap(self, count: int) -> list[int]:
        """The best of a few sets that no exchange of one leader improves; where none is found, the greedy one."""
        # From greedy sets begun with each of the best single leaders: the best one alone is often not in a good set.
        best = self.greedy(count)
        if self._function.unreached(frozenset(best)):
            return best
        best = self.exchange(best)
        for _, single in self.evaluated(1, STARTS)[1:]:
            other = self.exchange(self.greedy(count, *single))
            if self._value(frozenset(other)) < self._value(frozenset(best)) * (1 - TIE):
                best = other
        return best

    def exchange(self, chosen: list[int]) -> list[int]:
        """Replace single leaders by better ones until none helps; the set must reach all agents."""
        count = len(chosen)
        current = list(chosen)
        settled = position = 0
        while settled < count:
            if position % count == 0:
                self._begin(f"exchange, round {position // count + 1}", count * self._function.agents)
            here = position % count
            value = self._value(frozenset(current))
            agent, better = self._best_addition(frozenset(current) - {current[here]})
            settled += 1
            if better < value * (1 - TIE):
                current[here] = agent
                settled = 1
            position += 1
            self._done = (here + 1) * self._function.agents
            self._advance(0, min(value, better))
        return current

    def bound(self, leaders: Leaders) -> float:
        """Lower bound of E over all sets of as many leaders as in the given result; valid only where E is supermodular.

        For any set A, the best set T and the set V of all agents (+ joins sets; docs/leader_theory.md has the proof):

            E(A + T) >= E(A) - sum over v in T, not in A, of (E(A) - E(A + v))
            E(T) >= E(A + T) + sum over a in A, not in T, of (E(V - a) - E(V))

        The worst T has the largest terms of the first sum and the smallest of the second. The result is the best bound
        over all A that the search visited and the given set. It is at least as good as the guarantee of the greedy
        choice.
        """
        count = len(leaders)
        self._begin("bound", self._function.agents)
        self._best_additions(leaders, count)
        everybody = frozenset(range(self._function.agents))
        least_worth = {
            agent: max(self._value(everybody - {agent}) - self._value(everybody), 0.0)
            for agent in sorted(frozenset().union(*self._bases))
        }
        bounds = [0.0]
        for base in self._bases:
            value = self._known[base]
            gains = [max(value - self._least(base, v), 0.0) for v in range(self._function.agents) if v not in base]
            gains.sort(reverse=True)
            kept = sorted(least_worth[agent] for agent in base)
            # How many agents T may have in common with A.
            shares = range(max(0, count - len(gains)), min(count, len(base)) + 1)
            bounds.append(min(value - sum(gains[: count - s]) + sum(kept[: len(base) - s]) for s in shares))
        return min(max(bounds), self._value(leaders))  # rounding must not lift it above

    def evaluated(self, count: int, top: int) -> list[tuple[float, Leaders]]:
        """The ``top`` best (E, set) of the sets of ``count`` agents that were evaluated and have finite E."""
        sets = [(value, key) for key, value in self._known.items() if len(key) == count and math.isfinite(value)]
        return _ranked(sets)[:top]

    def _best_addition(self, base: Leaders) -> tuple[int, float]:
        additions = self._best_additions(base, 1)
        if math.isfinite(additions[0][0]):
            return additions[0][1], additions[0][0]
        candidates = (v for v in range(self._function.agents) if v not in base)
        return min(candidates, key=lambda v: (self._function.unreached(base | {v}), v)), math.inf

    def _best_additions(self, base: Leaders, count: int) -> list[tuple[float, int]]:
        """(E(base + v), v) of the best agents v, exact and best first; lazily, where bounds allow it."""
        if self._function.supermodular and base and math.isfinite(self._value(base)):
            self._bases.append(base)
        queue = sorted((self._least(base, v), v) for v in range(self._function.agents) if v not in base)
        exact: list[tuple[float, int]] = []
        for bound, agent in queue:
            if len(exact) >= count and bound > heapq.nsmallest(count, exact)[-1][0] * (1 + TIE):
                break
            exact.append((self._value(base | {agent}), agent))
            self._advance(1, min(exact)[0])
        return [(value, next(iter(key))) for value, key in _ranked([(e, frozenset({v})) for e, v in exact])][:count]

    def _least(self, base: Leaders, agent: int) -> float:
        """Lower bound of E(base + agent) from what is known; exact if that set was evaluated."""
        joined = base | {agent}
        if joined in self._known:
            return self._known[joined]
        gains = [
            self._known[smaller] * (1 + _ROUNDING) - self._known[smaller | {agent}]
            for smaller in self._bases
            if smaller <= base and smaller | {agent} in self._known
        ]
        return self._known[base] - min(gains) if gains else -math.inf

    def _value(self, leaders: Leaders) -> float:
        if leaders not in self._known:
            self._known[leaders] = self._solve(leaders)
        return self._known[leaders]

    def _solve(self, leaders: Leaders) -> float:
        if self._function.unreached(leaders):
            return math.inf
        self.evaluations += 1
        return self._function.system_error(leaders)

    def _begin(self, stage: str, total: int) -> None:
        self._stage, self._done, self._total = stage, 0, total

    def _advance(self, done: int, best: float) -> None:
        self._done += done
        if self._watch:
            self._watch(self._stage, min(self._done, self._total), self._total, best)


def _ranked(sets: list[tuple[float, Leaders]]) -> list[tuple[float, Leaders]]:
    """Best first; among sets that are equal up to ``TIE``, the lower agents first."""
    groups: list[tuple[float, list[int], tuple[float, Leaders]]] = []
    first = math.nan  # the least E of the sets that are equal to the present one
    for value, agents in sorted(sets, key=lambda entry: (entry[0], sorted(entry[1]))):
        if not value <= first * (1 + TIE):
            first = value
        groups.append((first, sorted(agents), (value, agents)))
    return [entry for *_, entry in sorted(groups, key=lambda group: group[:2])]
