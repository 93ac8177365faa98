# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The graph path of a run: which graph each step uses."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from msg_analysis.arithmetic.reproducible import Stream, generator
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.markov_chain import MOST_JUMPS, MarkovChain

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


@dataclass(frozen=True, slots=True)
class HoldingPeriod:
    """A stretch of steps with one graph."""

    sequence: int  # its number, from 0
    mode: int  # from 0
    first_step: int  # the steps k -> k+1 with first_step <= k <= last_step use this graph
    last_step: int


def holding_periods(experiment: Experiment, initial: FloatArray) -> Iterator[HoldingPeriod]:
    """The graph path of a run, drawn from the experiment's seed; ``initial`` (n,) is the law of g(0)."""
    # Step k uses the graph of the chain at time k dt, so successive graphs are a Markov chain with P = expm(Gamma dt),
    # exactly. A holding period between two sampling times, which no step uses, is left out.
    if experiment.schedule:
        return _numbered(experiment.schedule.stretches(experiment.step_length), experiment.steps)
    random = generator(experiment.run.seed, Stream.SWITCHING)
    return _sampled(experiment.chain, initial, random, experiment.steps, experiment.step_length)


def _sampled(
    chain: MarkovChain, initial: FloatArray, random: np.random.Generator, steps: int, dt: float
) -> Iterator[HoldingPeriod]:
    """The chain at the times 0, dt, ..., (steps - 1) dt."""
    if chain.jumps_within(dt) > MOST_JUMPS:
        chain, dt = chain.sampled(dt), 1.0

    def ends() -> Iterator[tuple[int, int]]:
        time = 0.0
        for mode, held in chain.holding_periods(initial, random):
            time += held
            yield mode, steps if math.isinf(time) else math.ceil(time / dt)

    return _numbered(ends(), steps)


def _numbered(ends: Iterable[tuple[int, int]], steps: int) -> Iterator[HoldingPeriod]:
    """Of (mode, the step from which on it is not used any more), those that some step before ``steps`` uses."""
    first, sequence = 0, 0
    for mode, end in ends:
        if end > first:
            yield HoldingPeriod(sequence, mode, first, min(steps, end) - 1)
            sequence += 1
            first = end
        if end >= steps:
            return


class PathWindow:
    """The holding periods of a graph path by number, drawn as far as they are asked for; old ones are forgotten."""

    MOST_AHEAD = 10_000  # holding periods beyond the first one that is kept; more are never published ahead

    def __init__(self, experiment: Experiment, initial: FloatArray) -> None:
        self._path = holding_periods(experiment, initial)
        self._kept: deque[HoldingPeriod] = deque()
        self.first = 0  # number of the first holding period that is kept

    def forget(self, step: int) -> None:
        """Keep only the holding periods that end at a step or later."""
        while (self._kept or self._draw()) and self._kept[0].last_step < step:
            self._kept.popleft()
            self.first += 1

    def holding(self, number: int) -> HoldingPeriod | None:
        """A holding period; None for one that is not there, not kept any more, or too far ahead."""
        index = number - self.first
        if not 0 <= index <= self.MOST_AHEAD:
            return None
        while len(self._kept) <= index:
            if not self._draw():
                return None
        return self._kept[index]

    def _draw(self) -> bool:
        holding = next(self._path, None)
        if holding is not None:
            self._kept.append(holding)
        return holding is not None


def mode_path(experiment: Experiment, initial: FloatArray) -> IntArray:
    """(N,) index of the graph of each step k -> k+1; ``initial`` (n,) is the law of g(0)."""
    return _modes(holding_periods(experiment, initial), experiment.steps)


def past_modes(experiment: Experiment, first_mode: int, steps: int) -> IntArray:
    """(steps,) g(-steps), ..., g(-1): the graphs before a run, given that it begins with g(0) = ``first_mode``."""
    # By the reversed chain, so that the graphs before and after time 0 are one stationary path; from time 0 backwards,
    # so that a longer past ends with the same graphs as a shorter one.
    chain = experiment.chain.reversed
    start = np.eye(chain.modes)[first_mode]
    random = generator(experiment.run.seed, Stream.PAST)
    backwards = _modes(_sampled(chain, start, random, steps + 1, experiment.step_length), steps + 1)
    return backwards[:0:-1]


def _modes(path: Iterator[HoldingPeriod], steps: int) -> IntArray:
    modes = np.empty(steps, dtype=np.int64)
    for holding in path:
        modes[holding.first_step : holding.last_step + 1] = holding.mode
    return modes
