# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What a question about a run is: its test, its evidence at any time, and the causes that it finds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import candidates
from msg_analysis.inference.candidates import Cause, Correlated, ParameterGroup, Selected, numbers_text, select
from msg_analysis.inference.e_values import Analyses
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.received_values import ReceivedValues
from msg_analysis.inference.residuals import ResidualTests
from msg_analysis.model.step_model import StepModel

if TYPE_CHECKING:
    from msg_analysis.inference.verdict import Evidence


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

    @property
    def words(self) -> str:
        """Such as "from step 10 to 12"."""
        of_run = f" of run {self.run}" if self.run > 1 else ""
        if self.first == self.last:
            return f"in step {self.first:,}{of_run}"
        return f"from step {self.first:,} to {self.last:,}{of_run}"


@dataclass(slots=True)
class Largest:
    """The largest value that was seen, what it is of, and where; runs are numbered in the order of merging."""

    value: float = 0.0
    of: tuple[float, ...] = ()
    place: Place = Place(0, 0)
    runs: int = 1

    def take(self, value: float, of: tuple[float, ...], place: Place) -> None:
        """Keep it if it is larger."""
        if not value <= self.value:  # also a NaN
            self.value, self.of, self.place = value, of, place

    def merge(self, other: Largest) -> None:
        """With that of other runs."""
        if other.value > self.value:
            place = replace(other.place, run=other.place.run + self.runs)
            self.value, self.of, self.place = other.value, other.of, place
        self.runs += other.runs


def agent_words(agent: int | None) -> str:
    """An agent, from 0, in words; None: all."""
    return "all agents" if agent is None else f"agent {agent + 1}"


@dataclass(frozen=True, slots=True)
class Finding:
    """The clearest deviation that a diagnostic found; agents and graphs from 0."""

    log_p: float  # of the test: for all places together where it could have been
    agent: int | None = None  # None: all
    sender: int | None = None  # of a link to the agent
    graph: int | None = None
    other: int | None = None  # graph that is swapped with it, or that comes next
    before: int | None = None  # graph that came before
    renamed: tuple[int, ...] = ()  # (n,) the graph that the log means by each name, where that is so in the whole run
    replicas: tuple[int, ...] = ()  # whose noise is not independent; empty: all
    held: bool = False  # whether the agent is a leader of infinite gain
    place: Place | None = None
    span: tuple[int, int | None] | None = None  # lag, or first and last step of a holding time (None: its end)
    estimate: float | None = None
    standard_error: float | None = None
    expected: float | None = None
    ends: tuple[float, float] | None = None  # of the interval, where that is not normal
    possible: tuple[float, float] = (-math.inf, math.inf)  # values: no interval goes beyond

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 %; None without a standard error."""
        low, high = self.ends or Estimate(self.estimate, standard_error=self.standard_error).interval
        if low is None or high is None:
            return None
        least, most = self.possible
        return min(max(low, least), most), min(max(high, least), most)

    @property
    def numbers(self) -> str:
        """Estimate and interval in words."""
        return numbers_text(self.estimate or 0.0, self.interval or (0.0, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """What the tests of a run, or of several, are made of; None where it is not computed."""

    system_error: Estimate | None = None  # as it is tested: given the path of the graphs where that is known
    node_errors: Sequence[Estimate] = ()
    corrected: str = ""  # what is added to the names of these tests where the errors are corrected for this path
    p_covariance: float | None = None  # of all second moments
    residuals: ResidualTests = field(default_factory=ResidualTests)
    p_switching: float | None = None
    p_loss: float | None = None
    p_broadcast: float | None = None
    findings: Mapping[str, Finding] = field(default_factory=dict)  # by name of the diagnostic
    p_alike: float | None = None  # of several runs


class Search:
    """The search for the causes of a disagreement: sums over runs, and what was found in them so far."""

    def __init__(
        self, experiment: Experiment, evidence: Evidence, findings: Mapping[str, Finding], level: float
    ) -> None:
        self.experiment, self.names = experiment, [graph.name for graph in experiment.graph_list]
        self.residuals, self.transitions, self.loss = evidence.residuals, evidence.transitions, evidence.loss
        self.findings, self.level, self.steps = findings, level, evidence.steps
        self.families = 0  # classes of candidates, all questions together
        self.renamed: tuple[int, ...] = ()  # of the finding that the names of the graphs are others, once it is a cause
        residuals, loss, broadcast = evidence.residuals, evidence.loss, evidence.broadcast
        self.frozen = candidates.frozen(residuals)
        # Agents whose states are constant are no evidence on gains and noise.
        self.excluded = [agent for agent, _, _ in self.frozen]
        self.parameters: dict[str, ParameterGroup | None] = {
            "gains": candidates.gains(residuals, self.excluded),
            "noise": candidates.noise(residuals, self.excluded, np.zeros(len(residuals.terms))),
            "loss": candidates.losses(loss) if loss else None,
            "broadcast": candidates.variances(np.diag(broadcast.scatter), broadcast.samples) if broadcast else None,
        }

    def classes(self, group: str) -> int:
        """Classes of candidates of a group of parameters."""
        found = self.parameters.get(group)
        return len(found.classes) if found else 0

    def selected(self, group: str) -> list[Selected]:
        """The changes that explain the score of a group of parameters."""
        if group == "gains":
            return self.selected_gains[0]
        found = self.noise if group == "noise" else self.parameters.get(group)
        return self._select(found)[0] if found else []

    def _select(self, group: ParameterGroup) -> tuple[list[Selected], FloatArray]:
        return select(group.score, group.information, group.classes, self.families, self.level)

    @cached_property
    def selected_gains(self) -> tuple[list[Selected], FloatArray]:
        """What is found in the regression, and the total change of its coefficients."""
        nothing: tuple[list[Selected], FloatArray] = [], np.zeros(len(self.residuals.terms))
        found = self._select(group) if (group := self.parameters["gains"]) else nothing
        # In real time correlated noise is in what others receive, and looks like a wrong gain.
        return nothing if self.experiment.run.pace == "realtime" and self._clearer(found[0]) else found

    def _clearer(self, gains: Sequence[Selected]) -> bool:
        pairs = min((one.log_p for one in self._correlated), default=1.0)
        return pairs < min((one.log_p for one in gains), default=0.0)

    @cached_property
    def _correlated(self) -> list[Correlated]:
        if self.parameters["noise"] is None:
            return []
        return candidates.correlations(self.residuals, self.excluded, self.families, self.level)

    @property
    def correlated(self) -> list[Correlated]:
        """Pairs of agents whose noise is; none where wrong gains, which correlate residuals too, are clearer."""
        return self._correlated if self._clearer(self.selected_gains[0]) else []

    @cached_property
    def noise(self) -> ParameterGroup | None:
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
    rounding: FloatArray  # (m,) largest rounding of these residuals, over their standard deviation
    apart: bool  # whether those of different agents are independent of each other, given what they received
    links: IntArray  # (L, 2) receiver and sender, where residuals are independent of all that the receiver received
    lockstep: bool
    gains: IntArray  # (G, 2) receivers and senders whose gains are asked about; the same agent twice: pull of a leader
    pairs: IntArray  # (P, 2) agents whose noises may be common
    lossy: IntArray  # (l, 2) receivers and senders whose losses are


class Question:
    """One question about a run, which one part of its law answers.

    The class reads the test and the causes from what is computed of a run; an object has the evidence of one run.
    """

    name: ClassVar[str]  # of the test in the verdict
    meaning: ClassVar[str]  # what is wrong where it is rejected
    # From ``Statistics``, of the test, where that is one without an estimate.
    p_value: ClassVar[attrgetter[float | None]]
    subject: ClassVar[str] = ""  # of its evidence, where that has one row and is not about the name
    main: ClassVar[bool] = False  # whether one part of the law answers it, see ``evidence_weights``
    about_chain: ClassVar[bool] = False  # whether it is about the graphs, not about the steps of the agents
    parameters: ClassVar[str] = ""  # group of ``Search.parameters`` whose changes are its causes

    def __init__(self, law: Law) -> None:
        self.law = law

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """Of a run, alone; none where there is nothing to test."""
        p = cls.p_value(run)
        return [] if p is None else [Test(cls.name, p)]

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
        return search.classes(cls.parameters)

    @classmethod
    def causes(cls, search: Search) -> list[Cause]:
        """What is wrong."""
        return [replace(cls.cause_of(one, search), log_p=one.log_p) for one in search.selected(cls.parameters)]

    @classmethod
    def cause_of(cls, one: Selected, search: Search) -> Cause:
        """A change of the ``parameters`` in words."""
        raise NotImplementedError


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


class Diagnostic(Question, ABC):
    """A question with sums of its own over the steps, which finds where in the run something is wrong."""

    # While a run goes on, none is asked: all together take as much time as all other questions.

    kind: ClassVar[str]  # of its cause

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self.agents = np.flatnonzero(law.noisy)
        self.together = bool(law.apart and len(self.agents) > 1)  # whether all of them are asked about as one, too

    def columns(self, values: AnyArray) -> AnyArray:
        """(..., agents + 1): values (..., agents), and their sum where all are asked about together."""
        return np.append(values, values.sum(axis=-1, keepdims=True), axis=-1) if self.together else values

    def agent(self, column: int) -> int | None:
        """Of one of the ``columns``; None: all."""
        return int(self.agents[column]) if column < len(self.agents) else None

    @abstractmethod
    def add(self, block: Block) -> FloatArray:
        """Add steps, which follow those that were added before: (T, ...) of ``logarithms`` after each analysis."""

    @abstractmethod
    def merge(self, other: Self) -> None:
        """Add the sums of other runs of the same experiment, with other seeds; nothing goes on from run to run."""

    @abstractmethod
    def finding(self) -> Finding | None:
        """The clearest deviation, whose p is that of the test; None where there is nothing to test."""

    @abstractmethod
    def logarithms(self) -> FloatArray:
        """(rows, alternatives) of the evidence so far; no row where there is nothing to test."""

    @classmethod
    @abstractmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """The finding, with the names of the graphs."""

    @classmethod
    def explains_others(cls, found: Finding) -> bool:
        """Whether all other causes were computed from what this finding says is wrong."""
        del found
        return False

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], log_p: float) -> Cause:
        """The finding, with the names of the graphs and the logarithm of its adjusted p."""
        agent = None if found.agent is None else found.agent + 1
        link = None if found.sender is None or agent is None else (found.sender + 1, agent)
        graphs = [names[graph] for graph in (found.before, found.graph, found.other) if graph is not None]
        graphs += [names[graph] for graph, meant in enumerate(found.renamed) if meant != graph]
        return Cause(
            kind=cls.kind,
            words=cls.words(found, names),
            agent=None if link else agent,
            link=link,
            graph=graphs[0] if len(graphs) == 1 else graphs or None,
            estimate=found.estimate,
            interval=found.interval,
            expected=found.expected,
            p=math.exp(log_p),
            log_p=None if log_p == -math.inf else log_p,
            steps=(found.place.first, found.place.last) if found.place else None,
        )

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """The clearest deviation."""
        found = run.findings.get(cls.name)
        if found is None:
            return []
        estimate = None if found.estimate is None else Estimate(found.estimate, found.expected, found.standard_error)
        return [Test(cls.name, math.exp(found.log_p), estimate=estimate)]

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


class SummedDiagnostic(Diagnostic):
    """A diagnostic whose evidence is a function of sums over the steps."""

    sums: Sequence[AnyArray]

    @abstractmethod
    def between(self, block: Block) -> Sequence[AnyArray]:
        """(T, ...) of each of the sums: over the steps between each analysis and the one before it."""

    @abstractmethod
    def of_sums(self, sums: Sequence[AnyArray]) -> FloatArray:
        """(..., rows, alternatives) of the evidence of sums, each with axes in front."""

    def add(self, block: Block) -> FloatArray:
        """The evidence of the sums after each analysis."""
        between = zip(self.sums, self.between(block), strict=True)
        after = [before + each.cumsum(axis=0) for before, each in between]
        self.sums = [each[-1] for each in after]
        return self.of_sums(after)

    def merge(self, other: Self) -> None:
        """Sums over steps."""
        self.sums = [mine + its for mine, its in zip(self.sums, other.sums, strict=True)]

    def logarithms(self) -> FloatArray:
        """Of the sums so far."""
        return self.of_sums(self.sums)
