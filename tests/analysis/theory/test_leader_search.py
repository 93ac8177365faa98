"""The search on set functions that are not those of networks: weighted sets that a leader has to hit."""

import math
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_analysis.theory.leader_search import LeaderSearch


@dataclass
class Hitting:
    """E(S) = constant + total weight of the sets that S does not hit: non-increasing and supermodular."""

    agents: int
    sets: list[frozenset[int]]
    weights: list[float]
    supermodular: bool = True
    constant: float = 1.0
    calls: list[frozenset[int]] = field(default_factory=list)

    def unreached(self, leaders: frozenset[int]) -> int:
        return 0 if leaders else self.agents

    def system_error(self, leaders: frozenset[int]) -> float:
        self.calls.append(leaders)
        return self.constant + math.fsum(w for s, w in zip(self.sets, self.weights, strict=True) if not s & leaders)


def hitting(seed: int, agents: int = 9, *, integer: bool = False, supermodular: bool = True) -> Hitting:
    random = np.random.default_rng(seed)
    sets = [frozenset(random.choice(agents, random.integers(1, 4), replace=False).tolist()) for _ in range(30)]
    weights = random.integers(1, 4, 30).astype(float) if integer else random.exponential(size=30)
    return Hitting(agents, sets, weights.tolist(), supermodular)


def plain_greedy(function: Hitting, count: int) -> list[int]:
    chosen: list[int] = []
    for _ in range(count):
        rest = [v for v in range(function.agents) if v not in chosen]
        chosen.append(min(rest, key=lambda v: (round(function.system_error(frozenset([*chosen, v])), 9), v)))
    return chosen


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 5), st.booleans())
def test_lazy_greedy_is_plain_greedy(seed: int, count: int, integer: bool) -> None:
    """Also with many ties (integer weights), where the lower agent wins."""
    function = hitting(seed, integer=integer)
    search = LeaderSearch(function)
    assert search.greedy(count) == plain_greedy(hitting(seed, integer=integer), count)
    assert search.evaluations == len(function.calls) == len(set(function.calls))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 5), st.booleans())
def test_pruned_exchanges_are_plain_exchanges(seed: int, count: int, integer: bool) -> None:
    lazy = LeaderSearch(hitting(seed, integer=integer))
    plain = LeaderSearch(hitting(seed, integer=integer, supermodular=False))
    assert lazy.swap(count) == plain.swap(count)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 5), st.sampled_from(["greedy", "swap"]))
def test_bound_holds_and_is_no_worse_than_the_guarantee(seed: int, count: int, method: str) -> None:
    function = hitting(seed)
    search = LeaderSearch(function)
    found = frozenset(search.greedy(count) if method == "greedy" else search.swap(count))
    values = {s: function.system_error(frozenset(s)) for s in combinations(range(function.agents), count)}
    best, value = min(values.values()), function.system_error(found)
    bound = search.bound(found)
    assert bound <= best * (1 + 1e-9)
    assert best <= value * (1 + 1e-9)
    # E(greedy) - E* <= (1 - 1/k)^(k - 1) (E(first) - E*), solved for E*
    first = min(function.system_error(frozenset({v})) for v in range(function.agents))
    rest = (1 - 1 / count) ** (count - 1)
    assert method == "swap" or bound >= (value - rest * first) / (1 - rest) - 1e-7


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 4))
def test_no_exchange_improves_the_result(seed: int, count: int) -> None:
    function = hitting(seed)
    found = LeaderSearch(function).swap(count)
    value = function.system_error(frozenset(found))
    for leaving in found:
        for entering in set(range(function.agents)) - set(found):
            assert function.system_error(frozenset(found) - {leaving} | {entering}) >= value * (1 - 1e-9)


def test_laziness_saves_work() -> None:
    """Fewer evaluations than plain search; the same result."""
    counts = {}
    for supermodular in (True, False):
        search = LeaderSearch(hitting(5, agents=40, supermodular=supermodular))
        counts[supermodular] = (search.swap(5), search.evaluations)
    assert counts[True][0] == counts[False][0]
    assert counts[True][1] < 0.6 * counts[False][1]


def test_exhaustive_is_in_order_and_complete() -> None:
    function = hitting(3, agents=7)
    found = LeaderSearch(function).exhaustive(3, 5)
    values = sorted((function.system_error(frozenset(s)), s) for s in combinations(range(7), 3))
    assert [(value, tuple(sorted(s))) for value, s in found] == values[:5]


def test_ties_go_to_the_lower_agents() -> None:
    """Equal up to rounding, in an order that rounding would change."""

    class Flat(Hitting):
        def system_error(self, leaders: frozenset[int]) -> float:
            return 1.0 - 1e-13 * sum(leaders)

    flat = Flat(6, [], [])
    assert [sorted(s) for _, s in LeaderSearch(flat).exhaustive(2, 15)] == [list(s) for s in combinations(range(6), 2)]
    assert LeaderSearch(flat).swap(3) == [0, 1, 2]
    assert [sorted(s) for _, s in LeaderSearch(flat).exhaustive(2, 2)] == [[0, 1], [0, 2]]


def test_watch_is_told() -> None:
    told: list[tuple[str, int, int, float]] = []
    search = LeaderSearch(hitting(1), lambda *state: told.append(state))
    search.bound(frozenset(search.swap(3)))
    assert {"greedy", "exchange, round 1", "bound"} <= {stage for stage, *_ in told}
    assert all(0 <= done <= total for _, done, total, _ in told)
    assert told[-1][3] == pytest.approx(min(best for stage, _, _, best in told if stage == "bound"))
