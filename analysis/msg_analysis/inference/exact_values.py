# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Questions about what a log must hold exactly: x(0), stamps in lockstep, a schedule, and agents without noise.

A correct run never fails one; so these tests count only where they fail, and cost the others nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.experiment.links import LinkSchedule
from msg_analysis.experiment.markov_chain import DrawnSchedule, Schedule
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.question import Block, Diagnostic, Finding, Law, Place, Statistics, Test, agent_words
from msg_analysis.inference.residuals import received_residuals
from msg_analysis.model.step_model import Wiring

ROUNDING = 2.0**-40  # of the largest x(0): smaller differences are for ``check``


class Exact(Diagnostic):
    """A question whose finding is certain."""

    def add(self, block: Block) -> FloatArray:
        """No evidence: what cannot be is infinite evidence."""
        return np.empty((block.analyses.count, 0, 1))

    def merge(self, other: Self) -> None:
        """Of one run."""

    def finding(self) -> Finding | None:
        """Found elsewhere."""
        return None

    def logarithms(self) -> FloatArray:
        """None."""
        return np.empty((0, 1))

    @classmethod
    def classes(cls, search: object) -> int:
        """No chance, and so no correction for it."""
        del search
        return 0


class Start(Exact):
    """Whether x(0) of the log is that of the record."""

    name = "start"
    meaning = "the run did not start from the states of its record"
    kind = "start"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """An agent."""
        del names
        which = f", replica {found.replicas[0] + 1}," if found.replicas[0] else ""
        run = f" of run {found.place.run}" if found.place and found.place.run > 1 else ""
        return (
            f"{agent_words(found.agent)}{which}{run} starts at {found.estimate!r}, not at {found.expected!r} as in the "
            "record of the run"
        )


class Stamps(Exact):
    """Whether in lockstep the stamps of the states are the times of their steps."""

    name = "stamps"
    meaning = "the stamps of the states are not the times of their steps"
    kind = "stamps"

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """The first one."""
        del names
        when = found.place.words if found.place else ""
        return (
            f"the state of {agent_words(found.agent)} {when} is stamped {found.estimate!r} s of simulated time, not "
            f"{found.expected!r} s"
        )


class GivenGraphs(Exact):
    """Whether the graphs follow the schedule of the file, or have its links only."""

    name = "schedule"
    meaning = "the graphs are not those of the schedule"
    kind = "schedule"
    about_chain = True

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """The first step with another graph."""
        when = found.place.words if found.place else ""
        if found.graph is None or found.other is None:
            sender = agent_words(found.sender)
            return f"{agent_words(found.agent)} was linked to {sender} {when}, which no link of the file does"
        return f"graph {names[found.graph]} was active {when}, where the schedule has {names[found.other]}"


class WithoutNoise(Exact):
    """Where agents without noise are not where the law puts them; the test is that of the covariance of the noise."""

    name = "agents without noise"
    meaning = "an agent without noise is not where the law puts it"
    kind = "deterministic"

    def __init__(self, law: Law) -> None:
        super().__init__(law)
        self._found: Finding | None = None
        self._deviations = np.sqrt(np.square(law.step.noise_gain).sum(axis=2))  # (n, m) of process noise

    def add(self, block: Block) -> FloatArray:
        """Nothing is computed where all agents have noise."""
        quiet = np.isinf(block.scale)
        if self._found is None and quiet.any():
            away = np.abs(received_residuals(self.law.step, block.reception, block.after))
            allowed = block.reception.allowed(self._deviations[block.reception.graphs, np.arange(away.shape[1])])
            wrong = np.argwhere((away.max(axis=2) > allowed) & quiet)
            if len(wrong):
                at, agent = wrong[0].tolist()
                held = bool(self.law.step.grounded[agent])
                value = float(block.after[at, agent, int(away[at, agent].argmax())])
                step = block.first + at + 1
                self._found = Finding(
                    -math.inf,
                    agent=agent,
                    place=Place(step, step),
                    estimate=value if held else float(away[at, agent].max()),
                    expected=self.law.step.reference if held else 0.0,
                    held=held,
                )
        return super().add(block)

    def merge(self, other: Self) -> None:
        """The first one."""
        self._found = self._found or other._found

    def finding(self) -> Finding | None:
        """The first step of the first agent."""
        return self._found

    @classmethod
    def tests(cls, run: Statistics) -> list[Test]:
        """None of its own."""
        del run
        return []

    @classmethod
    def cause(cls, found: Finding, names: Sequence[str], log_p: float) -> Cause:
        """Of a leader that is held, what it is held at."""
        return replace(super().cause(found, names, log_p), kind="reference" if found.held else cls.kind)

    @classmethod
    def words(cls, found: Finding, names: Sequence[str]) -> str:
        """An agent in a step."""
        del names
        when, who = found.place.words if found.place else "", agent_words(found.agent)
        if found.held:
            at, reference = found.estimate, found.expected
            return f"{who}, a leader that is held, is at {at:g} {when}, not at the reference {reference:g}"
        return f"{who}, which has no noise, is {found.estimate:.3g} away from where the law puts it {when}"


def exact_findings(
    step: Wiring, start: FloatArray, record: FloatArray, wrong_stamp: tuple[int, int, int] | None, modes: IntArray
) -> dict[str, Finding]:
    """By name of the question, from x(0) (m, R) of log and record, ``Run.wrong_stamp``, and the graphs (N,)."""
    found = {}
    if isinstance(step.switching, LinkSchedule):
        for mode, (source, target) in step.switching.foreign.items():
            if (modes == mode).any():
                first = int(np.argmax(modes == mode))
                found[GivenGraphs.name] = Finding(-math.inf, agent=target, sender=source, place=Place(first, first))
                break
    elif isinstance(step.switching, Schedule) and not isinstance(step.switching, DrawnSchedule):
        expected = step.switching.sampled(len(modes), step.dt)
        for at in np.flatnonzero(modes != expected)[:1].tolist():
            graph, other = int(modes[at]), int(expected[at])
            found[GivenGraphs.name] = Finding(-math.inf, graph=graph, other=other, place=Place(at, at))
    away = np.abs(start - record) > ROUNDING * np.abs(record).max(initial=0.0) + np.finfo(float).tiny
    if away.any():
        agent, replica = np.argwhere(away)[0].tolist()
        found[Start.name] = Finding(
            -math.inf,
            agent=agent,
            replicas=(replica,),
            place=Place(0, 0),
            estimate=float(start[agent, replica]),
            expected=float(record[agent, replica]),
        )
    if wrong_stamp is not None:
        at, agent, stamp = wrong_stamp
        found[Stamps.name] = Finding(
            -math.inf,
            agent=agent,
            place=Place(at, at),
            estimate=stamp / SECOND,
            expected=StepClock(step.dt).nanoseconds(at) / SECOND,
        )
    return found


def of_runs(runs: Sequence[Mapping[str, Finding]]) -> dict[str, Finding]:
    """The findings of the first of several runs that has any, question by question."""
    found: dict[str, Finding] = {}
    for number, findings in enumerate(runs, start=1):
        for name, one in findings.items():
            assert one.place is not None
            found.setdefault(name, replace(one, place=replace(one.place, run=number)))
    return found
