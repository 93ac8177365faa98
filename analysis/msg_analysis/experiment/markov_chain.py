# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What switches between the graphs: a Markov chain, or a schedule."""

from __future__ import annotations

import itertools
import math
import sys
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.arithmetic.reproducible import exponential, reproducible_product
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment.graphs import hops

Time = Literal["continuous", "discrete"]


def stationary_law(matrix: FloatArray) -> FloatArray:
    """(n,) stationary law of an irreducible chain by the GTH algorithm; ``matrix`` (n, n): generator or transitions.

    Uses no subtraction and only off-diagonal entries, so every entry of the law is accurate to machine precision
    whatever the rates (Grassmann, Taksar, Heyman 1985).
    """
    rates = np.array(matrix, dtype=float)
    n = len(rates)
    for k in range(n - 1, 0, -1):
        rates[:k, k] /= rates[k, :k].sum()
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
    law = np.ones(n)
    for k in range(1, n):
        law[k] = (law[:k] * rates[:k, k]).sum()  # not @: the order of a sum in BLAS depends on the processor
    return np.asarray(law / law.sum())


@dataclass(frozen=True, slots=True, eq=False)
class MarkovChain:
    """An ergodic chain on the n graphs."""

    time: Time
    matrix: FloatArray  # (n, n) generator Gamma [1 / unit of time], or P, one jump a step

    @property
    def modes(self) -> int:
        """Number of graphs n."""
        return len(self.matrix)

    @property
    def irreducible(self) -> bool:
        """Whether every graph can be reached from every other one."""
        jumps = self.matrix > 0
        return bool((hops(jumps, [0]) >= 0).all() and (hops(jumps.T, [0]) >= 0).all())

    @property
    def period(self) -> int:
        """Greatest common divisor of the lengths of all cycles of an irreducible chain; 1 in continuous time."""
        if self.time == "continuous":
            return 1
        level, jumps = hops(self.matrix > 0, [0]), np.argwhere(self.matrix > 0)
        return math.gcd(*(int(level[i]) + 1 - int(level[j]) for i, j in jumps))

    @property
    def ergodic(self) -> bool:
        """Irreducible and, in discrete time, aperiodic (assumption 1 of the paper)."""
        return self.irreducible and self.period == 1

    @property
    def stationary(self) -> FloatArray:
        """(n,) stationary law pi."""
        return stationary_law(self.matrix)

    @property
    def holding_times(self) -> list[float | None]:
        """Mean time in each graph before it is left, in discrete time in steps; None where it is never left."""
        leaving = (self.matrix - np.diag(np.diag(self.matrix))).sum(axis=1)
        return [1.0 / rate if rate > 0 else None for rate in leaving.tolist()]

    @property
    def reversed(self) -> MarkovChain:
        """The stationary chain backwards in time: its rates are pi_j Gamma_ji / pi_i, or pi_j P_ji / pi_i."""
        law = self.stationary
        return MarkovChain(self.time, self.matrix.T * law / law[:, None])

    def transition(self, dt: float) -> FloatArray:
        """(n, n) law of the graph a step of dt later: expm(Gamma dt), or P itself in discrete time."""
        if self.time == "discrete":
            return self.matrix.copy()
        import scipy.linalg  # here, since every agent's process would wait for it

        with np.errstate(over="ignore", invalid="ignore"):
            transition = np.clip(np.asarray(scipy.linalg.expm(self.matrix * dt), dtype=float), 0.0, None)
        if not np.isfinite(transition).all():  # of two fast graphs, in older versions of scipy
            return self.sampled(dt).matrix
        return np.asarray(transition / transition.sum(axis=1, keepdims=True))

    def jumps_within(self, dt: float) -> float:
        """Mean number of jumps in dt of the stationary chain in continuous time; 0 for another one."""
        leaving = -np.diag(self.matrix) * dt if self.time == "continuous" else np.zeros(1)
        return float((self.stationary * leaving).sum()) if leaving.any() else 0.0

    def sampled(self, dt: float) -> MarkovChain:
        """The chain in continuous time at the times 0, dt, ..., the same to the last bit on every machine."""
        squarings = max(0, math.frexp(float(np.abs(self.matrix).max()) * dt)[1])
        transition = exponential(self.matrix * (dt * 2.0**-squarings))
        for _ in range(squarings):
            transition = np.clip(reproducible_product(transition, transition), 0.0, None)
            transition /= transition.sum(axis=1, keepdims=True)  # an error of a row's sum would double each time
        return MarkovChain("discrete", transition)

    def holding_periods(self, initial: FloatArray, random: np.random.Generator) -> Iterator[tuple[int, float]]:
        """Exact path of the chain, without end: (mode from 0, time spent in it); ``initial`` (n,): law of the first."""
        # Holding times are exponential, or geometric in steps; the next graph is drawn from the jump chain.
        off_diagonal = self.matrix - np.diag(np.diag(self.matrix))
        leaving = off_diagonal.sum(axis=1).tolist()
        jumps = [_cumulative(law / rate) if rate > 0.0 else [] for law, rate in zip(off_diagonal, leaving, strict=True)]
        mode = _draw(_cumulative(initial), random)
        while True:
            if leaving[mode] == 0.0:
                yield mode, np.inf
                return
            if self.time == "continuous":
                held = random.exponential(1.0 / leaving[mode])
            else:
                held = float(random.geometric(min(leaving[mode], 1.0)))
            yield mode, held
            mode = _draw(jumps[mode], random)


MOST_JUMPS = 1000.0  # in a step, in the mean, that are drawn one by one; part of the definition of a run
ROUNDING = 1e-9  # relative, of times in steps: what is so near to a step begins with it


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """A given sequence of the n graphs: recorded, or made by an engineer."""

    starts: FloatArray  # (p,) when each stretch begins [units of simulated time], ascending from 0
    order: IntArray  # (p,) graph of each stretch, from 0
    modes: int  # number of graphs n
    end: float  # when the last stretch ends; inf: never
    repeat: bool  # whether it then begins again

    @property
    def _spent(self) -> FloatArray:
        """(n,) time in every graph, up to the end, or without one to the beginning of the last stretch."""
        ends = np.append(self.starts[1:], self.starts[-1:] if math.isinf(self.end) else self.end)
        return np.asarray(np.bincount(self.order, ends - self.starts, self.modes), dtype=float)

    @property
    def stationary(self) -> FloatArray:
        """(n,) shares of time of the graphs."""
        spent = self._spent
        return np.asarray(spent / spent.sum() if spent.any() else np.eye(self.modes)[self.order[0]])

    @property
    def holding_times(self) -> list[float | None]:
        """Mean length of the stretches of each graph [units of simulated time]; None where it is not known."""
        counts = np.bincount(self.order, minlength=self.modes).tolist()
        return [time / count if time else None for time, count in zip(self._spent.tolist(), counts, strict=True)]

    def to_json(self) -> dict[str, Any]:
        """What ``info`` says of it."""
        end = None if math.isinf(self.end) else self.end
        return {"stretches": len(self.starts), "end": end, "repeat": self.repeat}

    def sampled(self, steps: int, dt: float) -> IntArray:
        """(steps,) graphs at the times 0, dt, ...; after the end, the last one."""
        modes, first = np.full(steps, self.order[-1], dtype=np.int64), 0
        for mode, end in self.stretches(dt):
            modes[first:end], first = mode, max(first, end)
            if first >= steps:
                break
        return modes

    def stretches(self, dt: float) -> Iterator[tuple[int, int]]:
        """(mode, the step from which on it is not used any more) of each stretch, without end where it repeats."""
        ends = [*self.starts[1:].tolist(), self.end]
        for turn in itertools.count() if self.repeat else (0,):
            for mode, end in zip(self.order.tolist(), ends, strict=True):
                steps = (end + turn * self.end if turn else end) / dt
                yield mode, sys.maxsize if math.isinf(steps) else math.ceil(steps - ROUNDING * max(1.0, steps))


@dataclass(frozen=True, slots=True, eq=False)
class DrawnSchedule(Schedule):
    """The path of a run, drawn from its seed, of a law that is not a chain of its graphs."""


@dataclass(frozen=True, eq=False)
class SemiMarkovChain:
    """A chain whose holding times are Erlang: exactly a Markov chain of phases, passed one after the other."""

    chain: MarkovChain  # with the mean holding times
    shapes: IntArray  # (n,) number of phases of each graph

    @property
    def graph_of(self) -> IntArray:
        """(S,) graph of each phase."""
        return np.repeat(np.arange(len(self.shapes)), self.shapes)

    @property
    def first(self) -> IntArray:
        """(n,) first phase of each graph."""
        return np.asarray(np.cumsum(self.shapes) - self.shapes)

    @property
    def phases(self) -> MarkovChain:
        """The chain of all phases: each graph's are passed as fast as its mean holding time asks for."""
        size, last = int(self.shapes.sum()), np.cumsum(self.shapes) - 1
        jumps = self.chain.matrix - np.diag(np.diag(self.chain.matrix))
        matrix = np.zeros((size, size))
        for graph, shape in enumerate(self.shapes.tolist()):
            matrix[last[graph], self.first] = shape * jumps[graph]
            for phase in range(int(self.first[graph]), int(last[graph])):
                matrix[phase, phase + 1] = shape * jumps[graph].sum()
        rest = matrix.sum(axis=1)
        np.fill_diagonal(matrix, 1.0 - rest if self.chain.time == "discrete" else -rest)
        return MarkovChain(self.chain.time, matrix)

    def drawn(self, initial: FloatArray, random: np.random.Generator, steps: int, dt: float) -> SojournSchedule:
        """A path of so many steps; ``initial`` (S,): law of the first phase."""
        chain, unit, graph_of = self.phases, 1.0 if self.chain.time == "continuous" else dt, self.graph_of.tolist()
        if chain.jumps_within(dt) > MOST_JUMPS:
            chain, unit = chain.sampled(dt), dt
        starts, order, time = [0.0], list[int](), 0.0
        for phase, held in chain.holding_periods(initial, random):
            if order[-1:] != [graph_of[phase]]:
                starts[len(order) :] = [time]
                order.append(graph_of[phase])
            time += held * unit
            if time >= steps * dt:
                break
        return SojournSchedule(np.array(starts), np.array(order), len(self.shapes), math.inf, False, self, initial)


@dataclass(frozen=True, slots=True, eq=False)
class SojournSchedule(DrawnSchedule):
    """The path of a run with Erlang holding times."""

    law: SemiMarkovChain
    initial: FloatArray  # (S,) law of the first phase


def require_chain(switching: MarkovChain | Schedule) -> MarkovChain:
    """The chain; NotAvailableError where the graphs have a schedule instead."""
    if isinstance(switching, Schedule):
        raise NotAvailableError("switching: the sequence of the graphs is given: expected a Markov chain for this")
    return switching


def _cumulative(law: FloatArray) -> list[float]:
    sums: list[float] = np.cumsum(law).tolist()
    return sums


def _draw(cumulative: list[float], random: np.random.Generator) -> int:
    """Index drawn by inversion from one uniform number."""
    return bisect_right(cumulative, random.random() * cumulative[-1])
