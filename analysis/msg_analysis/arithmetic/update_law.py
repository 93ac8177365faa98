# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The update law, implemented once for agents, twin and checks, on arrays and on the bytes of messages.

Its results are equal to the last bit on every machine: sums run over the agents in ascending order, one term at a time
(never through BLAS or a reduction, whose order depends on shapes and threads), and each term is one multiplication and
one addition of doubles. The compiled kernel and numpy give the same bits; the kernel is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray


def weighted_sum(weights: Sequence[float | FloatArray], values: Sequence[FloatArray]) -> FloatArray:
    """sum_j weights[j] * values[j], term after term in the order given; at least one term, values of one shape."""
    terms = zip(values, weights, strict=True)
    value, weight = next(terms)
    total = value * weight
    for value, weight in terms:
        total += value * weight
    return total


def step(weights: Sequence[float | FloatArray], values: Sequence[FloatArray], drive: FloatArray) -> FloatArray:
    """x_i(k+1) = sum_j W_ij x_j(k) + drive_i(k), for the non-zero W_ij of row i, j ascending, and values of shape (R,).

    For many rows at once: weights (m, 1), padded with zeros, and values (m, R). The drive is noise plus offset.
    """
    total = weighted_sum(weights, values)
    total += drive
    return total


_DOUBLE = np.dtype("<f8")


def to_payload(state: FloatArray) -> bytes:
    """Bytes of a state (replicas,) of float64."""
    return state.astype(_DOUBLE, copy=False).tobytes()


def from_payload(payload: bytes) -> FloatArray:
    """State (replicas,) of a payload of 8 bytes for each number; read-only."""
    return np.frombuffer(payload, _DOUBLE)


def combine_with_numpy(weights: Sequence[float], payloads: Sequence[bytes], drive: bytes) -> bytes:
    """``step`` on payloads of equal size; the kernel accepts only a tuple of weights and a list of payloads."""
    return to_payload(step(weights, [from_payload(payload) for payload in payloads], from_payload(drive)))


def all_finite_with_numpy(payload: bytes) -> bool:
    """Whether all numbers of a payload are finite."""
    return bool(np.isfinite(from_payload(payload)).all())


combine: Callable[[Sequence[float], Sequence[bytes], bytes], bytes]
"""The update law on payloads: the kernel's, or ``combine_with_numpy``."""

all_finite: Callable[[bytes], bool]
"""Whether all numbers of a payload are finite: the kernel's, or ``all_finite_with_numpy``."""

try:
    from msg_analysis.arithmetic import _kernel
except ImportError:  # there was no compiler when this was installed
    COMPILED, combine, all_finite = False, combine_with_numpy, all_finite_with_numpy
else:
    COMPILED, combine, all_finite = True, _kernel.combine, _kernel.all_finite


@dataclass(frozen=True, slots=True)
class Round:
    """Agents that can step at once, under one graph, because none uses what another of them makes."""

    agents: IntArray  # (a,) from 0
    rows: IntArray  # (d, a) the d-th value that each of them uses, a row of [x(k); x(k+1)]; the order of the sum
    there: BoolArray  # (d, a) whether it is no padding
    weights: FloatArray  # (d, a), 0 for padding, which changes no sum


@dataclass(frozen=True, slots=True)
class Reception:
    """What becomes of the values that agents send each other in K steps or more, over L links sorted by receiver."""

    # The messages are those of C steps in a row, the first of which is ``delay`` before the first of the K; in step k a
    # link brings message k + ahead. So C is K, or K + 1 if one is ahead.

    links: IntArray  # (m, m) number of the link from the sender, the column; L for an agent's own value
    first: IntArray  # (m + 1,) number of the first link to each receiver, and L
    senders: IntArray  # (L,)
    ahead: IntArray  # (L,) 1 where the sender steps before the receiver in real time, else 0
    delay: int
    lost: BoolArray  # (L + 1, C) which messages are lost; the last row is not used
    broadcast: FloatArray | None  # (m, C, R) noise that is added to what each agent publishes
    link: FloatArray | None  # (L, C, R) noise that is added on each link
    # (L, R) the last values heard, which take the place of lost ones, and are changed; None: an agent's own value does
    held: FloatArray | None = None

    def hold(self, k: int, states: FloatArray, agents: IntArray) -> None:
        """Note what these agents receive in step k, over all links."""
        if self.held is not None:
            links = np.concatenate([np.arange(self.first[i], self.first[i + 1]) for i in agents])
            links = links[~self.lost[links, k + self.ahead[links]]]
            self.held[links] = self._messages(k, states, links)

    def heard(self, k: int, states: FloatArray, agents: IntArray, senders: IntArray) -> list[FloatArray]:
        """For each d, (a, R): what agents (a,) use of ``senders`` (d, a) in step k; ``states`` as in ``advance``."""
        numbers = self.links[agents, senders]
        own = numbers == len(self.senders)
        links = np.where(own, 0, numbers)
        mine = states[self.delay + k][agents]
        if not len(self.senders):
            return [mine for _ in senders]
        if self.held is not None:
            values = self.held[links]
        else:
            values = self._messages(k, states, links)
            own = own | self.lost[links, k + self.ahead[links]]
        return list(np.where(own[..., None], mine, values))

    def _messages(self, k: int, states: FloatArray, links: IntArray) -> FloatArray:
        which, senders = k + self.ahead[links], self.senders[links]
        values = states[which, senders]
        if self.broadcast is not None:
            values = values + self.broadcast[senders, which]
        return values if self.link is None else values + self.link[links, which]


class ManySteps:
    """The steps of m agents, under each graph in one or several rounds."""

    def __init__(self, rounds: Sequence[Sequence[Round]], *, compiled: bool = COMPILED) -> None:
        """``rounds[mode]``: the rounds of a graph, in order; not ``compiled``: by numpy, with the same bits."""
        self._rounds, self._compiled = rounds, compiled
        self._agents = sum(len(one.agents) for one in rounds[0])
        together = [one for of_graph in rounds for one in of_graph]
        terms = np.concatenate([one.there.sum(axis=0) for one in together])
        # Row after row: the agent that it is for, where its terms begin, and its terms.
        self._order = np.concatenate([one.agents for one in together], dtype=np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(terms)], dtype=np.int64)
        self._columns = np.concatenate([one.rows.T[one.there.T] for one in together], dtype=np.int64)
        self._weights = np.concatenate([one.weights.T[one.there.T] for one in together])

    def advance(
        self, modes: IntArray, past: FloatArray, drives: FloatArray, reception: Reception | None = None
    ) -> FloatArray:
        """(K, m, R): x(1) to x(K) under the graphs ``modes`` (K,), from ``past`` (delay + 1, m, R), the last x(0)."""
        # drives (K, m, R) has the noise of each step and what the reference adds.
        states = np.empty((len(past) + len(modes), *past.shape[1:]))
        states[: len(past)] = past
        if self._compiled:
            arrays = self._order, self._offsets, self._columns, self._weights, np.ascontiguousarray(modes)
            received: list[Any] = []
            if (r := reception) is not None:
                received = [r.links, r.first, r.senders, r.ahead, r.delay, r.lost]
                received += [b"" if noise is None else noise for noise in (r.broadcast, r.link)]
                received += [] if r.held is None else [r.held]
            _kernel.advance(*arrays, np.ascontiguousarray(drives), states, *past.shape[1:], *received)
        else:
            self._with_numpy(modes, states, drives, reception)
        return states[len(past) :]

    def _with_numpy(self, modes: IntArray, states: FloatArray, drives: FloatArray, reception: Reception | None) -> None:
        m = self._agents
        now = len(states) - len(modes) - 1
        sums = [[(one.agents, list(one.weights[:, :, None]), one.rows) for one in each] for each in self._rounds]
        for k, mode in enumerate(modes):
            both = states[now + k : now + k + 2].reshape(2 * m, -1)  # x(k) above x(k+1)
            for agents, weights, rows in sums[mode]:
                if reception is None:
                    values = list(both[rows])
                else:
                    reception.hold(k, states, agents)
                    values = reception.heard(k, states, agents, rows % m)
                both[m + agents] = step(weights, values, drives[k, agents])
