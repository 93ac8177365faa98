# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The list of all questions about a run: the verdict, the evidence, the live view and the causes walk it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.dependence import ConstantState, LongLags, Replicas, Whiteness
from msg_analysis.inference.exact_values import GivenGraphs, Stamps, Start, WithoutNoise
from msg_analysis.inference.graph_names import SwappedGraphs
from msg_analysis.inference.graphs import HoldingTimes, SecondOrder, Switching
from msg_analysis.inference.link_states import LinkRates
from msg_analysis.inference.messages import Broadcast, CommonGain, Gains, MessageLosses, StaleValues
from msg_analysis.inference.noise import LargestResidual, Noise, NoiseByGraph, NoiseOverTime
from msg_analysis.inference.question import Diagnostic, Question, Search, Statistics, Test
from msg_analysis.inference.sojourns import Sojourns
from msg_analysis.inference.statistics import holm
from msg_analysis.inference.system_error import AgentMeanErrors, Covariance, RunsAlike, SystemMeanError

QUESTIONS: tuple[type[Question], ...] = (
    SystemMeanError,
    AgentMeanErrors,
    Covariance,
    Noise,
    Whiteness,
    Gains,
    CommonGain,
    Switching,
    HoldingTimes,
    SecondOrder,
    NoiseByGraph,
    NoiseOverTime,
    ConstantState,
    LargestResidual,
    LongLags,
    Replicas,
    StaleValues,
    SwappedGraphs,
    MessageLosses,
    Broadcast,
    WithoutNoise,
    Start,
    Stamps,
    GivenGraphs,
    LinkRates,
    Sojourns,
    RunsAlike,
)

MAIN_SHARE = 0.75  # of the main questions together in the mean of the evidence, however many others there are


def evidence_weights(main: Sequence[bool]) -> FloatArray:
    """Weights of sum 1 of questions in the evidence: fixed before the run, since they depend on the law only."""
    count = sum(main)
    each = MAIN_SHARE / max(count, 1), (1.0 - MAIN_SHARE) / max(len(main) - count, 1)
    weights = np.array([each[0] if one else each[1] for one in main])
    return np.asarray(weights / weights.sum())


def decide(run: Statistics, level: float, evidence: dict[str, float] | None = None) -> list[Test]:
    """The family of tests, decided at ``level`` (Holm); ``evidence``: logarithms by name of the question."""
    found = [(question, test) for question in QUESTIONS for test in question.tests(run)]
    # A NaN statistic (a log with numbers too large to compute with) counts as p = 0: the law never gives one.
    p = [0.0 if math.isnan(test.p) else test.p for _, test in found]
    return [
        Test(
            name=test.name,
            p=alone,
            p_adjusted=float(adjusted),
            rejected=bool(adjusted < level),
            estimate=test.estimate,
            log_evidence=(evidence or {}).get(question.name),
            meaning=question.meaning,
        )
        for (question, test), alone, adjusted in zip(found, p, holm(np.array(p, dtype=float)), strict=True)
    ]


def causes_of(search: Search, rejected: Sequence[str]) -> list[Cause]:
    """What is wrong with runs that disagree: agents with a constant state first, then by p-value; never empty."""
    # The classes of all questions count before anything is selected.
    search.families = sum(question.classes(search) for question in QUESTIONS)
    # The steps decide what the names of the graphs mean, and so how often which graph came after which.
    found = [cause for chain in (False, True) for cause in _causes(search, about_chain=chain)]
    if not found:
        return [_unknown(rejected)]
    return sorted(found, key=lambda cause: (cause.kind != "frozen", cause.order))


def _causes(search: Search, *, about_chain: bool) -> list[Cause]:
    """What concerns the whole run, and the clearest finding of the diagnostics, where that is clearer."""
    # One fault has many effects, so only one finding about the steps is a cause, and one about the graphs.
    asked = [question for question in QUESTIONS if question.about_chain == about_chain]
    whole = [cause for question in asked for cause in question.causes(search)]
    findings = [(search.findings[each.name], each) for each in asked if each.name in search.findings]
    certain = [(found, each) for found, each in findings if issubclass(each, Diagnostic) and found.log_p == -math.inf]
    others = [(found, each) for found, each in findings if issubclass(each, Diagnostic) and found.log_p > -math.inf]
    exact = [question.cause(found, search.names, -math.inf) for found, question in certain]
    if not others:
        return exact + whole
    best, question = min(others, key=lambda one: one[0].log_p)
    log_p = best.log_p + math.log(search.families)
    place = best.place
    if whole and place is not None and 1.5 * (place.last - place.first + 1) >= search.steps:
        return exact + whole  # of nearly the whole run
    if log_p >= min([math.log(search.level), *(cause.order for cause in whole)]):
        return exact + whole
    if question.explains_others(best):
        search.renamed, whole = best.renamed, []
    return [*exact, question.cause(best, search.names, log_p), *whole]


def _unknown(rejected: Sequence[str]) -> Cause:
    names = ", ".join(rejected)
    if list(rejected) == [Whiteness.name]:
        words = "the noise of successive steps or of replicas is correlated: random numbers are used twice"
    elif all(name.startswith((SystemMeanError.name, AgentMeanErrors.name, Covariance.name)) for name in rejected):
        words = f"start and steps follow the law, but the errors differ: probably by chance ({names})"
    else:
        words = f"no single cause that is searched for explains the rejected tests ({names})"
    return Cause("unknown", words)
