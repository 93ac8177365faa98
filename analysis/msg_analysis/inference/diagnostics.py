# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What all kinds of departures have in common: the steps that they are given, and what they say."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.inference.e_values import Looks
from msg_analysis.inference.received_values import HeardValues
from msg_analysis.model.step_model import StepModel


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Successive steps of a run."""

    first: int  # number of the first of the b steps
    graphs: IntArray  # (b + 1,) of these steps and of the next one; (b,) at the end of a run
    white: FloatArray  # (b, m, R) innovations over their standard deviations, N(0, 1) by the law; 0 without noise
    scale: FloatArray  # (b, m) these standard deviations; infinite without noise
    after: FloatArray  # (b, m, R) states after the steps
    reception: HeardValues  # what was heard in the steps, and the states before them
    looks: Looks  # when evidence is looked at, T times


@dataclass(frozen=True, slots=True)
class Place:
    """Steps of a run, both ends included."""

    first: int
    last: int
    run: int = 1  # of several runs, from 1 in the order of the comparison

    def later(self, runs: int) -> Place:
        """The same place with so many runs before it."""
        return Place(self.first, self.last, self.run + runs)


@dataclass(frozen=True, slots=True)
class Finding:
    """The clearest departure of a kind; agents and graphs from 0."""

    test: str
    log_p: float  # of the test: for all places together where it could have been
    agent: int | None = None  # None: all
    sender: int | None = None  # of a link to the agent
    graph: int | None = None
    other: int | None = None  # graph that is swapped with it
    place: Place | None = None
    span: tuple[int, int | None] | None = None  # lag, or first and last step of a sojourn (None: its end)
    estimate: float | None = None
    standard_error: float | None = None
    expected: float | None = None


Question = tuple[str, tuple[int, ...]]
"""Words, with {} for the name of a graph, and these graphs from 0."""


class Departure(ABC):
    """Sums over the steps of runs of one experiment: one kind of departure."""

    test: str  # its name in the family of tests, and as a kind of evidence

    @abstractmethod
    def add(self, block: Block) -> FloatArray:
        """Add steps, which follow those that were added before: (T, ...) of ``evidence`` after each look."""

    @abstractmethod
    def merge(self, other: Self) -> None:
        """Add the sums of other runs of the same experiment, with other seeds."""

    @abstractmethod
    def finding(self) -> Finding | None:
        """The clearest departure, whose p is that of the test; None where there is nothing to test."""

    @abstractmethod
    def evidence(self) -> FloatArray:
        """(questions, alternatives) logarithms of the evidence; no row where there is nothing to test."""

    @abstractmethod
    def questions(self) -> list[Question]:
        """What the rows of ``evidence`` are about."""


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """What departures need to know of the law of a run."""

    step: StepModel
    planned: int  # steps of a complete run
    replicas: int  # R
    noisy: BoolArray  # (m,) agents whose innovations are known to be independent normal numbers over time
    apart: bool  # whether those of different agents are independent of each other, given what they heard
    links: IntArray  # (L, 2) receiver and sender, where innovations are independent of all that the receiver heard
    plain: bool  # whether all agents hear the states themselves, in lockstep
