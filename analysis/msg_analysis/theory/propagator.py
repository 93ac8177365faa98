# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Linear equations that a Markov chain couples, over time, by powers of matrices: accurate for any stiffness.

See docs/theory.md, "Transients".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment.markov_chain import Time

_KEPT = 8  # powers of recent time differences that are kept: a uniform grid needs one, or two that differ by rounding
_DEGREE = 13  # of the Taylor polynomial; with norm at most 1/4 the rest is below 1e-17 of it


@dataclass(frozen=True, slots=True, eq=False)
class Power:
    """The map over some time; powers of one flow commute."""

    matrix: FloatArray  # (N, N)
    change: bool = True  # z + matrix @ z; otherwise matrix @ z, which is better once nearly everything has died out

    def __call__(self, z: FloatArray) -> FloatArray:
        """The map of (N,) or (N, q)."""
        moved = self.matrix @ z
        return np.asarray(z + moved if self.change else moved)

    def then(self, other: Power) -> Power:
        """Both maps, one after the other."""
        if self.change and other.change:
            change = self.matrix + other.matrix + other.matrix @ self.matrix
            whole = change + np.eye(len(change))
            return Power(change) if np.linalg.norm(whole, 1) > 0.5 else Power(whole, change=False)
        return Power(other(self.matrix) if not self.change else self(other.matrix), change=False)


class Flow:
    """Powers of one matrix A (N, N): y(t) = exp(A t) y(0), or y(k) = (1 + A)^k y(0) in discrete time, t in steps."""

    # Powers are kept as what they change, E in z -> z + E z, as long as little of z dies out: the square is then
    # 2 E + E^2, and small changes are not lost beside 1.

    def __init__(self, time: Time, matrix: FloatArray) -> None:
        self._time, self._matrix = time, matrix
        self._kept: dict[int, Power] = {}

    @property
    def tick(self) -> float:
        """Shortest time that is looked at: 1 / norm, or one step."""
        if self._time == "discrete":
            return 1.0
        return 1.0 / (float(np.linalg.norm(self._matrix, 1)) or 1.0)

    @property
    def slowest(self) -> float:
        """Rate at which the slowest part dies out, like exp(-rate t): 0 if something stays."""
        return self._slowest(self._matrix)

    def _slowest(self, matrix: FloatArray) -> float:
        values = np.linalg.eigvals(matrix)
        if self._time == "continuous":
            return float(-values.real.max(initial=-np.inf))
        # |1 + v|^2 - 1 without the 1: slow motion is not lost.
        growth = float((2.0 * values.real + np.abs(values) ** 2).max(initial=-1.0))
        return -0.5 * math.log1p(growth) if growth > -1.0 else math.inf

    def rotated(self, z: FloatArray) -> FloatArray:
        """The coordinates y of z, in which the powers work."""
        return z

    def restored(self, y: FloatArray) -> FloatArray:
        """The z that has the coordinates y."""
        return y

    def over(self, duration: float) -> Power:
        """The map from z(0) to z(duration)."""
        if self._time == "discrete":
            result, left = Power(np.zeros_like(self._matrix)), round(duration)
            for power in self.doublings():
                if left & 1:
                    result = result.then(power)
                left >>= 1
                if not left:
                    return result
        scaled = self._matrix * duration
        squarings = max(0, int(np.ceil(np.log2(max(4.0 * float(np.linalg.norm(scaled, 1)), 1e-300)))))
        scaled /= 2.0**squarings
        change = scaled / _DEGREE
        for k in range(_DEGREE - 1, 0, -1):
            change = (scaled + scaled @ change) / k
        power = Power(change)
        for _ in range(squarings):
            power = power.then(power)
        return power

    def doublings(self) -> Iterator[Power]:
        """The maps over 1, 2, 4, ... ticks, without end; each costs one product."""
        power = Power(self._matrix) if self._time == "discrete" else self.over(self.tick)
        while True:
            yield power
            power = power.then(power)

    def grid(self, start: FloatArray, times: FloatArray) -> FloatArray:
        """(T, ...) z at ascending times (T,), from z(0) = start."""
        # Differences of a uniform grid differ in their last bits; they share one power.
        unit = 16.0 * np.finfo(float).eps * float(times[-1]) or 1.0
        y, now = self.rotated(start), 0.0
        found = np.zeros((len(times), *start.shape))
        for row, then in enumerate(times):
            key = round((then - now) / unit)
            if key > 0:
                if key not in self._kept:
                    if len(self._kept) >= _KEPT:
                        self._kept.clear()
                    self._kept[key] = self.over(float(then) - now)
                y, now = self._kept[key](y), float(then)
            found[row] = self.restored(y)
        self._kept.clear()
        return found


class Propagator(Flow):
    """The equations of n modes z_i, as stacks (n, q); they are those of Propositions 1 and 6 of the paper.

        continuous: d/dt z_i = A_i z_i + sum_j Gamma_ji z_j           discrete: z_i(k+1) = sum_j P_ji A_j z_j(k)

    ``chain``: (n, n) Gamma or P; ``stationary``: (n,) pi; ``local``: (n, q, q) A_i, less the identity in discrete time.

    The modes are rotated to their sum and the deviation of each from its share of the sum. The chain moves nothing in
    the sum and drops out of it exactly: so slow motion stays accurate beside rates that are many orders of magnitude
    faster.
    """

    def __init__(self, time: Time, chain: FloatArray, stationary: FloatArray, local: FloatArray) -> None:
        n, q = local.shape[:2]
        self._shape = (n, q)
        flow = chain.T * (1.0 - np.eye(n))
        flow -= np.diag(flow.sum(axis=0))  # Gamma^T, or P^T - I, with columns that sum to zero
        pivot = int(np.argmax(stationary))
        # z = spread @ y, y = gather @ z: y_0 is the sum, the others z_i - pi_i y_0 for every mode but the pivot.
        others = np.delete(np.arange(n), pivot)
        self._spread = np.column_stack([stationary, np.eye(n)[:, others] - np.eye(n)[:, [pivot]]])
        self._gather = np.vstack([np.ones(n), np.eye(n)[others] - stationary[others, None]])
        self._jumps = flow[np.ix_(others, others)] - flow[others][:, [pivot]]
        jumps = np.zeros((n, n))
        jumps[1:, 1:] = self._jumps
        after = self._gather if time == "continuous" else (np.eye(n) + jumps) @ self._gather
        blocks = np.einsum("ki,il,iab->kalb", after, self._spread, local, optimize=True)
        blocks[:, range(q), :, range(q)] += jumps
        super().__init__(time, blocks.reshape(n * q, n * q))

    @property
    def slowest_jump(self) -> float:
        """``slowest`` of the law of the graph: how fast it forgets its start. More than one mode."""
        return self._slowest(self._jumps)

    def rotated(self, z: FloatArray) -> FloatArray:
        """(n q, ...) of (n, q, ...)."""
        return np.tensordot(self._gather, z, axes=1).reshape(-1, *z.shape[2:])

    def restored(self, y: FloatArray) -> FloatArray:
        """(n, q, ...) of (n q, ...)."""
        return np.tensordot(self._spread, y.reshape(*self._shape, *y.shape[1:]), axes=1)
