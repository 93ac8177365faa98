# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a question about a run is: its test, its evidence at any time, and the causes that it finds.

All questions are in the list of ``questions``; how to add one is in docs/statistics.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import candidates
from msg_analysis.inference.candidates import Cause, Parameters, Selected, select
from msg_analysis.inference.counts import LossTally, LossTest, SwitchingTest, Transitions
from msg_analysis.inference.e_values import Analyses
from msg_analysis.inference.estimates import CovarianceTest, Estimate
from msg_analysis.inference.received_values import ReceivedValues
from msg_analysis.inference.residuals import BroadcastSums, ResidualSums, ResidualTests
from msg_analysis.model.step_model import StepModel


@dataclass(frozen=True, slots=True)
class Test:
    """One member of the family of tests that the verdict is about."""

    name: str
    p: float  # of this test alone
    p_adjusted: float = 1.0  # Holm's, over the family
    rejected: bool = False  # whether ``p_adjusted`` is below the level
    estimate: Estimate | None = None  # of what is tested; None where that is not one number
    log_evidence: float | None = None  # of the whole question, at the end of the run; None where it has no e-value
    meaning: str = ""  # what is wrong where it is rejected

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {"name": self.name, "p": self.p, "p_adjusted": self.p_adjusted, "rejected": self.rejected}


@dataclass(frozen=True, slots=True)
class Place:
    """Steps of a run, both ends included."""

    first: int
    last: int
    run: int = 1  # of several runs, from 1 in the order of the comparison

    def later(self, runs: int) -> Place:
        """The same place with so many runs before it."""
        return Place(self.first, self.last, self.run + runs)

    @property
    def words(self) -> str:
        """Such as "from step 10 to 12"."""
        of_run = f" of run {self.run}" if self.run > 1 else ""
        if self.first == self.last:
            return f"in step {self.first:,}{of_run}"
        return f"from step {self.first:,} to {self.last:,}{of_run}"


@dataclass(frozen=True, slots=True)
class Finding:
    """The clearest deviation that a diagnostic found; agents and graphs from 0."""

    log_p: float  # of the test: for all places together where it could have been
    agent: int | None = None  # None: all
    sender: int | None = None  # of a link to the agent
    graph: int | None = None
    other: int | None = None  # graph that is swapped with it
    place: Place | None = None
    span: tuple[int, int | None] | None = None  # lag, or first and last step of a holding time (None: its end)
    estimate: float | None = None
    standard_error: float | None = None
    expected: float | None = None

    @property
    def interval(self) -> tuple[float, float]:
        """95 %; (0, 0) without an estimate."""
        low, high = Estimate(self.estimate or 0.0, standard_error=self.standard_error or 0.0).interval
        assert low is not None
        assert high is not None
        return low, high

    @property
    def steps(self) -> tuple[int, int] | None:
        """First and last step of the place."""
        return (self.place.first, self.place.last) if self.place else None

    @property
    def whose(self) -> str:
        """The agent in words."""
        return "all agents" if self.agent is None else f"agent {self.agent + 1}"


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """What the tests of a run, or of several, are made of; None where it is not computed."""

    system_error: Estimate | None = None  # as it is tested: given the path of the graphs where that is known
    node_errors: Sequence[Estimate] = ()
    corrected: str = ""  # what is added to the names of these tests where the errors are corrected for this path
    covariance: CovarianceTest | None = None
    residuals: ResidualTests = field(default_factory=ResidualTests)
    switching: SwitchingTest | None = None
    loss: LossTest | None = None
    p_broadcast: float | None = None
    findings: Mapping[str, Finding] = field(default_factory=dict)  # by name of the diagnostic
    p_alike: float | None = None  # of several runs


class Search:
    """The search for the causes of a disagreement: sums over runs, and what was found in them so far.

    Consequences across groups are removed: agents whose states are constant are left out of the regression and of the
    noise, and the part of the residuals that wrong gains explain is not counted as noise.
    """

    def __init__(
        self,
        experiment: Experiment,
        residuals: ResidualSums,
        transitions: Transitions,
        loss: LossTally | None,
        broadcast: BroadcastSums | None,
        findings: Mapping[str, Finding],
        level: float,
    ) -> None:
        self.experiment, self.names = experiment, [graph.name for graph in experiment.graph_list]
        self.residuals, self.transitions, self.loss_tally = residuals, transitions, loss
        self.findings, self.level = findings, level
        self.families = 0  # classes of candidates, all questions together
        self.frozen = candidates.frozen(residuals)
        self.excluded = [agent for agent, _, _ in self.frozen]
        self.gains = candidates.gains(residuals, self.excluded)
        self.losses = candidates.losses(loss) if loss else None
        self.broadcast = candidates.variances(np.diag(broadcast.scatter), broadcast.samples) if broadcast else None

    def select(self, group: Parameters | None) -> list[Selected]:
        """The changes that explain the score of a group."""
        return self._select(group)[0] if group else []

    def _select(self, group: Parameters) -> tuple[list[Selected], FloatArray]:
        return select(group.score, group.information, group.classes, self.families, self.level)

    @cached_property
    def selected_gains(self) -> tuple[list[Selected], FloatArray]:
        """What is found in the regression, and the total change of its coefficients."""
        return self._select(self.gains) if self.gains else ([], np.zeros(len(self.residuals.terms)))

    @cached_property
    def any_noise(self) -> Parameters | None:
        """The noise variances as if all gains were right."""
        return candidates.noise(self.residuals, self.excluded, np.zeros(len(self.residuals.terms)))

    @cached_property
    def noise(self) -> Parameters | None:
        """The noise variances, without what wrong gains explain."""
        return candidates.noise(self.residuals, self.excluded, self.selected_gains[1])


@dataclass(slots=True, eq=False)
class RunningSums:
    """Sums over the steps before each of T analyses, for m agents, n graphs and L rates of the system error."""

    impossible: IntArray  # (T,) steps in which an agent without noise moved
    samples: IntArray  # (T, m) residuals
    squares: FloatArray  # (T, m) of residuals over their standard deviations
    link_score: FloatArray  # (T, m, m) receiver, sender
    link_information: FloatArray  # (T, m, m)
    pair_score: FloatArray  # (T, m, m)
    pair_information: FloatArray  # (T, m, m)
    common_score: FloatArray  # (T,) of all gains at once
    common_information: FloatArray  # (T,)
    counts: IntArray  # (T, n, n) of steps from graph to graph
    messages: IntArray  # (T, m, m) of links that lose some
    lost: IntArray  # (T, m, m)
    broadcast_samples: IntArray  # (T,) of each agent
    broadcast_squares: FloatArray  # (T, m)
    error: FloatArray  # (T, L) logarithms of the martingales of the system error

    @classmethod
    def zeros(cls, analyses: int, agents: int, graphs: int, rates: int) -> RunningSums:
        """Of no step."""
        m, n = agents, graphs
        shapes: dict[str, tuple[int, ...]] = {"counts": (n, n), "error": (rates,)}
        shapes |= dict.fromkeys(("samples", "squares", "broadcast_squares"), (m,))
        pairs = "link_score", "link_information", "pair_score", "pair_information", "messages", "lost"
        shapes |= dict.fromkeys(pairs, (m, m))
        whole = "impossible", "samples", "counts", "messages", "lost", "broadcast_samples"
        made: dict[str, Any] = {
            each.name: np.zeros((analyses, *shapes.get(each.name, ())), np.int64 if each.name in whole else np.float64)
            for each in fields(cls)
        }
        return cls(**made)

    def then(self, parts: RunningSums) -> RunningSums:
        """After each analysis, from the last sums of these and those between the analyses."""
        added = {each.name: getattr(parts, each.name).cumsum(axis=0) for each in fields(self)}
        return RunningSums(**{name: getattr(self, name)[-1] + values for name, values in added.items()})

    def last(self) -> RunningSums:
        """After the last analysis only."""
        return RunningSums(**{each.name: getattr(self, each.name)[-1:].copy() for each in fields(self)})

    def merge(self, other: RunningSums) -> None:
        """Add the sums of another run, with as many analyses."""
        for each in fields(self):
            getattr(self, each.name).__iadd__(getattr(other, each.name))


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """What questions need to know of the law of a run."""

    step: StepModel
    graphs: Sequence[str]  # their names
    planned: int  # steps of a complete run
    replicas: int  # R
    noisy: BoolArray  # (m,) agents whose residuals are known to be independent normal numbers over time
    apart: bool  # whether those of different agents are independent of each other, given what they received
    links: IntArray  # (L, 2) receiver and sender, where residuals are independent of all that the receiver received
    plain: bool  # whether all agents receive the states themselves, in lockstep
    gains: IntArray  # (G, 2) receivers and senders whose gains are asked about; the same agent twice: pull of a leader
    pairs: IntArray  # (P, 2) agents whose noises may be common
    lossy: IntArray  # (l, 2) receivers and senders whose losses are


class Question(ABC):
    """One question about a run, which one part of its law answers.

    The class reads the test and the causes from what is computed of a run; an object has the evidence of one run.
    """

    name: ClassVar[str]  # of the test in the verdict
    meaning: ClassVar[str]  # what is wrong where it is rejected
    subject: ClassVar[str] = ""  # of its evidence, where that has one row and is not about the name
    main: ClassVar[bool] = False  # whether one part of the law answers it, see ``evidence_weights``
    about_chain: ClassVar[bool] = False  # whether it is about the graphs, not about the steps of the agents

    def __init__(self, law: Law) -> None:
        self.law = law

    @classmethod
    @abstractmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of a run, alone; none where there is nothing to test."""

    def number_of_tests(self) -> int:
        """Number of tests in the family of a run with this law."""
        return 1

    def evidence(self, sums: RunningSums) -> FloatArray:
        """(T, rows, alternatives) logarithms of the evidence after each analysis; no row where it has none."""
        return np.empty((len(sums.impossible), 0, 1))

    def about(self, row: int) -> str:
        """What a row of ``evidence`` is about, in words."""
        del row
        return self.subject or self.name

    @classmethod
    def classes(cls, search: Search) -> int:
        """Classes of candidate causes that ``causes`` has."""
        del search
        return 0

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """What is wrong."""
        del search
        return []


def one_test(name: str, p: float | None, estimate: Estimate | None = None) -> list[Test]:
    """One test; none without a p-value."""
    return [] if p is None else [Test(name, p, estimate=estimate)]


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Successive steps of a run."""

    first: int  # number of the first of the b steps
    graphs: IntArray  # (b + 1,) of these steps and of the next one; (b,) at the end of a run
    white: FloatArray  # (b, m, R) residuals over their standard deviations, N(0, 1) by the law; 0 without noise
    scale: FloatArray  # (b, m) these standard deviations; infinite without noise
    after: FloatArray  # (b, m, R) states after the steps
    reception: ReceivedValues  # what was received in the steps, and the states before them
    analyses: Analyses  # the interim analyses, T of them


class Diagnostic(Question):
    """A question with sums of its own over the steps, which finds where in the run something is wrong.

    While a run goes on it is not asked: all together take as much time as all other questions.
    """

    @abstractmethod
    def add(self, block: Block) -> FloatArray:
        """Add steps, which follow those that were added before: (T, ...) of ``logarithms`` after each analysis."""

    @abstractmethod
    def merge(self, other: Self) -> None:
        """Add the sums of other runs of the same experiment, with other seeds."""

    @abstractmethod
    def finding(self) -> Finding | None:
        """The clearest deviation, whose p is that of the test; None where there is nothing to test."""

    @abstractmethod
    def logarithms(self) -> FloatArray:
        """(rows, alternatives) of the evidence so far; no row where there is nothing to test."""

    @classmethod
    @abstractmethod
    def cause(cls, found: Finding, names: Sequence[str], p: float) -> Cause:
        """The finding in words, with the names of the graphs and its adjusted p."""

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """The clearest deviation."""
        found = run.findings.get(cls.name)
        if found is None:
            return []
        estimate = None if found.estimate is None else Estimate(found.estimate, found.expected, found.standard_error)
        return one_test(cls.name, math.exp(found.log_p), estimate)

    def number_of_tests(self) -> int:
        """None where there is nothing to test."""
        return int(self.logarithms().size > 0)

    def evidence(self, sums: RunningSums) -> FloatArray:
        """That after all steps."""
        del sums
        return self.logarithms()[None]

    @classmethod
    def classes(cls, search: Search) -> int:
        """One, where it is tested."""
        return int(cls.name in search.findings)
