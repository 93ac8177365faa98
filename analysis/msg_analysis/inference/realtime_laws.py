# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The logged-pattern law: the errors of a run in real time, given which values and graphs its log says were used.

Timing does not depend on the states. So given the log the states are linear in independent normal numbers, and replicas
are independent. With z(K) the stack of ``pattern_events``,

    z(K) = A_K z(K-1) + noise N_K,     M(K) = E[z z^T] = A_K M(K-1) A_K^T + N_K,     Y(K-1) = H + A_K^T Y(K) A_K,

and means and covariances follow as in ``given_path``; what z contains that is not logged, noise, is replaced by its
expectation given the rest. In lockstep, with all steps on time, it is the law of runs in which values are kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import percent
from msg_analysis.inference.estimates import Estimate, covariance_test, estimates
from msg_analysis.inference.event_order import EventOrder, order_events, sampled
from msg_analysis.inference.given_path import means_given_path
from msg_analysis.inference.observation import Observation, Timers
from msg_analysis.inference.pattern_events import Periods
from msg_analysis.inference.statistics import holm, two_sided
from msg_analysis.inference.time_means import TimeMeans, forms_of, packed_moments, time_means
from msg_analysis.inference.timing import Timing
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.prediction import LAW_NAMES
from msg_analysis.twin.simulate import ideal_log

MAX_WORK = 6e10  # multiplications, at most (about a minute); the joint test is left out first, then the node errors

MAX_ENTRIES = 400  # entries of a stack, at most


class PatternUnavailableError(Exception):
    """The log does not allow the pattern law, or it would take too long; the message says why."""


def timing_effect(observation: Observation, means: TimeMeans) -> float | None:
    """Effect of timing on the system error: expectation given the log over that with ideal timers, less 1."""
    # Both are exact, for the same start and graphs of the network, so that hardly anything is left to chance.
    experiment = observation.prediction.experiment
    graphs, used, made = ideal_log(experiment, observation.step, observation.modes)
    ideal = replace(observation, timers=Timers(graphs[1:], used, made))
    periods = Periods(ideal, order_events(ideal))
    total = _forward(periods, np.sum(periods.start(_start(observation)), axis=0))[0]
    frame = observation.prediction.system.frame
    expected = float(np.trace(frame.T @ total @ frame)) / observation.steps
    return float(means.trace @ means.predicted) / expected - 1.0 if expected > 0.0 else None


def pattern_means(
    observation: Observation, order: EventOrder, *, most_work: float = MAX_WORK, most_entries: int = MAX_ENTRIES
) -> TimeMeans:
    """Time means of the sampled states, with expectation and standard errors given the log."""
    if order.contradiction:
        raise PatternUnavailableError(order.contradiction)
    system, steps = observation.prediction.system, observation.steps
    periods = Periods(observation, order)
    entries = periods.largest
    if entries > most_entries:
        raise PatternUnavailableError(
            f"{entries} values are in use at the same time, expected at most {most_entries}: some were used long after "
            "they were computed"
        )
    frame = system.frame
    p = packed_symmetric.size(frame.shape[1])
    for kind in ("joint", "nodes", "system"):
        forms, nodes, trace = forms_of(system, kind)
        q = len(forms)
        work = steps * entries**2 * (q**2 + (3 * q + 4) * entries)
        if work <= most_work:
            break
    else:
        raise PatternUnavailableError(f"{steps} steps of {entries} values are too many to compute")
    lifted = frame @ packed_symmetric.unpack(forms, frame.shape[1]) @ frame.T

    seen, agents = np.zeros(p), np.arange(observation.step.agents)
    series = np.empty(steps)
    for first, last in observation.blocks(max(p, observation.states[0].size), "expected errors"):
        sampled = observation.states[order.newest[first:last], agents]
        found = packed_moments(sampled - observation.step.reference, system, observation.largest)
        seen += found.sum(axis=0)
        series[first:last] = found @ (trace @ forms)
    total, covariance, variances = _follow(periods, _start(observation), lifted, trace)
    expected = frame.T @ (total / steps) @ frame
    covariance /= observation.replicas * steps**2
    both = series, variances / observation.replicas
    return TimeMeans.of((forms, nodes, trace), seen / steps, expected, covariance, both, joint=kind == "joint")


def means_in_lockstep(observation: Observation) -> TimeMeans | None:
    """Time means of a run in lockstep given the graphs and the values received; None where that would take too long."""
    order = EventOrder.of_lockstep(observation.steps, observation.step.agents)
    try:
        return pattern_means(observation.as_timed(), order)
    except PatternUnavailableError:
        return None


def _follow(
    periods: Periods, start: FloatArray, forms: FloatArray, trace: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum of E[X X^T] (m, m), sum of Cov(D) (q, q), and Var of the system error's D by period (N,); one replica."""
    steps, m, q = periods.steps, len(start), len(forms)
    known, published = periods.start(start)
    total, beginnings, length = _forward(periods, known + published)
    covariance, variances = np.zeros((q, q)), np.zeros(steps)
    dual = np.zeros((q, periods.entries(steps - 1), periods.entries(steps - 1)))
    dual[:, :m, :m] = forms
    for block in reversed(range(len(beginnings))):
        first, last = block * length, min((block + 1) * length, steps)
        beginning, here = beginnings[block]
        periods.release()
        moments_of = [here]
        for number in range(first + 1, last):
            moments_of.append(_next(periods, number, moments_of[-1]))
        for number in range(last - 1, max(first, 1) - 1, -1):
            period, moment = periods[number], moments_of[number - first]
            before = periods.stack(number - 1, moments_of[number - 1 - first] if number > first else beginning)
            if before is None:
                spread = 4.0 * moment - 2.0 * period.noise
            else:
                spread = 2.0 * period.noise + 4.0 * period.matrix @ before @ period.matrix.T
            added = _spread(dual, period.noise, spread)
            covariance += added
            variances[number] = trace @ added @ trace
            dual = period.matrix.T @ dual @ period.matrix
            dual[:, :m, :m] += forms
    added = _spread(dual, published, 2.0 * published + 4.0 * known)
    covariance += added
    variances[0] = trace @ added @ trace
    return total, covariance, variances


def _spread(dual: FloatArray, noise: FloatArray, spread: FloatArray) -> FloatArray:
    """(q, q): tr(Y_a N Y_b S) of the forms Y (q, S, S)."""
    return np.asarray((dual @ noise).reshape(len(dual), -1) @ (spread @ dual).reshape(len(dual), -1).T)


def _start(observation: Observation) -> FloatArray:
    """(m, m): mean of x x^T over the replicas at the known start."""
    start = observation.start - observation.step.reference
    if observation.prediction.experiment.problem == "consensus":
        start = start - start.mean(axis=0)  # the common part does not count, and can be large
    return np.asarray(start @ start.T / observation.replicas)


def _forward(periods: Periods, start: FloatArray) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]], int]:
    """Sum of E[X X^T] (m, m), M before and at the beginning of every block, and the number of periods in a block."""
    m, length = periods.agents, max(1, math.isqrt(periods.steps))
    total, beginnings, moment, before = np.zeros((m, m)), [], start, start
    for number in range(periods.steps):
        if number:
            before, moment = moment, _next(periods, number, moment)
        if number % length == 0:
            beginnings.append((before, moment))
            periods.release()
        total += moment[:m, :m]
    return total, beginnings, length


def _next(periods: Periods, number: int, moment: FloatArray) -> FloatArray:
    period = periods[number]
    return np.asarray(period.matrix.dot(moment).dot(period.matrix.T) + period.noise)  # dot: see ``given_path``


MAX_MISSED = 0.01  # largest share of missed deadlines with which a law without lateness can be supported

MAX_EFFECT = 0.01  # largest relative change of the system error that a law may leave out and still be supported


SUPPORT = {True: "supported", False: "not supported", None: "not decided"}


@dataclass(frozen=True, slots=True)
class CheckedLaw:
    """A law next to the log."""

    system_error: Estimate  # measured, and predicted by this law
    supported: bool | None  # whether the log supports it; None where that is not decided
    why: str


@dataclass(frozen=True, slots=True)
class Laws:
    """The laws of a run in real time."""

    pattern: CheckedLaw  # given the values and graphs that the agents logged as used; exact for any timing
    sequential: CheckedLaw  # no step is late, every value is received at once
    continuous: CheckedLaw  # the paper's

    @property
    def measured_against(self) -> Literal["pattern", "sequential"]:
        """The law that the errors of the comparison are compared with: the pattern law where it is available."""
        return "sequential" if self.pattern.system_error.predicted is None else "pattern"

    @property
    def why(self) -> str:
        """The reasons of all three, in words."""
        laws = {"pattern": self.pattern, "sequential": self.sequential, "continuous": self.continuous}
        return " ".join(
            f"{LAW_NAMES[key].capitalize()} ({SUPPORT[law.supported]}): {law.why}." for key, law in laws.items()
        )

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        laws = {"pattern": self.pattern, "sequential": self.sequential, "continuous": self.continuous}
        return laws | {"why": self.why}


def measure_laws(observation: Observation, order: EventOrder, timing: Timing, level: float) -> tuple[TimeMeans, Laws]:
    """Compare a run in real time with each law; also the means under the pattern law, else the sequential law."""
    ideal = replace(observation, states=sampled(observation, order))
    given = means_given_path(ideal) if ideal.prediction.path and ideal.prediction.system.readout is None else None
    sequential = given or time_means(ideal)
    error, p = _least(observation, sequential)
    effect = None
    try:
        means = pattern_means(observation, order)
        pattern = _pattern(observation, means, level)
        effect = timing_effect(observation, means)
    except PatternUnavailableError as reason:
        means = sequential
        pattern = CheckedLaw(Estimate(error.measured), None, f"not available: {reason}")
    late = timing.missed_share > MAX_MISSED
    # Where agents keep values from step to step, the sequential law has no standard error of its own.
    untested = p is None and observation.prediction.system.readout is not None and pattern.supported
    law = _sequential(error, 1.0 if untested else p, level, _deviations(timing), effect, late)
    return means, Laws(pattern, law, _continuous(observation, error, level, late))


def _pattern(observation: Observation, means: TimeMeans, level: float) -> CheckedLaw:
    error, p = _least(observation, means)
    if p is None:
        return CheckedLaw(error, None, _untestable(observation))
    logged = "the prediction for the values and graphs that the agents logged"
    if p >= level:
        return CheckedLaw(error, True, f"the errors agree with {logged}")
    why = "this law holds for any timing, so an agent did not follow its law, or its log is wrong"
    return CheckedLaw(error, False, f"the errors differ from {logged} ({_tested(error, p)}); {why}")


def _untestable(observation: Observation) -> str:
    """Why the errors of a run have no standard error."""
    if not observation.prediction.system.noise.any():
        return "without noise the errors cannot be tested"
    return "the agents were so late that only x(0), which is not random, could be compared"


def _deviations(timing: Timing) -> list[str]:
    """Facts in the log that contradict the sequential law."""
    facts = []
    if timing.missed:
        facts.append(f"{percent(timing.missed_share)} of the deadlines were missed")
    if timing.ideal_uses < timing.uses:
        facts.append(f"{percent(1.0 - timing.ideal_share)} of the values used were not those of ideal timers")
    if timing.outdated_graphs:
        facts.append(f"{percent(timing.outdated_share)} of the steps used an outdated graph")
    return facts


def _sequential(
    error: Estimate, p: float | None, level: float, deviations: list[str], effect: float | None, late: bool
) -> CheckedLaw:
    why = "assumes that every step is on time and every message arrives at once"
    if not deviations:
        why += ", as in this log"
    else:
        first = ", ".join(deviations[:-1])
        why += ", but " + (f"{first} and " if first else "") + deviations[-1]
        if effect is not None:
            why += f", which changes the system error by {100 * effect:+.2g} %"
    if p is None:
        return CheckedLaw(error, None, why)
    if p < level:
        return CheckedLaw(error, False, f"{why}; the measured errors differ ({_tested(error, p)})")
    if late:
        return CheckedLaw(error, False, why)
    if not deviations or (effect is not None and abs(effect) <= MAX_EFFECT):
        return CheckedLaw(error, True, why)
    return CheckedLaw(error, None, f"{why}; the run is too short to show a difference")


def _continuous(observation: Observation, sequential: Estimate, level: float, late: bool) -> CheckedLaw:
    """With the standard error of the sequential law, from which that of the continuous law would hardly differ."""
    law, experiment = observation.prediction.continuous_moments, observation.prediction.experiment
    if law is None:
        return CheckedLaw(Estimate(sequential.measured), None, "not available for this experiment")
    predicted, untested = law.system_error, Estimate(sequential.measured, law.system_error)
    if sequential.standard_error is None:
        return CheckedLaw(untested, None, "its errors have no standard error here")
    if not sequential.standard_error or sequential.measured is None or not predicted:
        return CheckedLaw(untested, None, _untestable(observation))
    if experiment.run.start != "stationary":
        return CheckedLaw(untested, None, "only its steady state is predicted, and the run did not start there")
    z = (sequential.measured - predicted) / sequential.standard_error
    p = float(two_sided(z))
    error = Estimate(sequential.measured, predicted, sequential.standard_error, z, p)
    effect = observation.prediction.emulated.system_error / predicted - 1.0
    why = (
        f"ignores that the agents make steps of {observation.step.dt:g}, one after the other, which changes the "
        f"system error by {100 * effect:+.2g} %"
    )
    if p < level:
        return CheckedLaw(error, False, f"{why}; the measured system error differs ({_z(error)})")
    if late:
        return CheckedLaw(error, False, f"{why}, and that deadlines were missed")
    if abs(effect) <= MAX_EFFECT:
        return CheckedLaw(error, True, why)
    return CheckedLaw(error, None, f"{why}; the run is too short to show a difference")


def _least(observation: Observation, means: TimeMeans) -> tuple[Estimate, float | None]:
    """The system error, and the smallest adjusted p-value of all tests of the second moments."""
    system = observation.prediction.system
    error, nodes = estimates(means, system)
    if not means.long_enough:
        return error.without_error(), None
    tests = [error.p, *(node.p for node in nodes), covariance_test(means, system).p]
    tested = np.array([p for p in tests if p is not None], dtype=float)
    return error, float(holm(tested).min()) if len(tested) else None


def _tested(error: Estimate, p: float) -> str:
    return f"system error {_z(error)}, smallest p {p:.2g}"


def _z(estimate: Estimate) -> str:
    return "z undefined" if estimate.z is None else f"z = {estimate.z:+.1f}"
