# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The logged-pattern law: the errors of a run in real time, given which values and graphs its log says were used.

Timing does not depend on the states. So given the log the states are linear in independent normal numbers, and replicas
are independent. With z(K) the stack of ``pattern_events``,

    z(K) = A_K z(K-1) + noise N_K,     M(K) = E[z z^T] = A_K M(K-1) A_K^T + N_K,     Y(K-1) = H + A_K^T Y(K) A_K.

M gives the exact expectation of the time mean. For quadratic forms H the dual Y gives E[sum of what is still to come |
z], with martingale increments D. The covariance of their sum is estimated by the sum of

    Cov(D_a, D_b | z(K-1)) = tr( Y_a N Y_b (2 N + 4 A z z^T A^T) ) / R

as in ``errors.given_path``; what z contains that is not logged, noise, is replaced by its expectation given the rest.
In lockstep the same law, with all steps on time, is that of runs in which values are kept from step to step.
M is computed forwards, Y backwards, in blocks: going backwards, the M of a block are computed again from its beginning.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from msg_analysis.inference.errors.time_means import TimeMeans, forms_of, packed_moments
from msg_analysis.inference.observed.observation import Observation, Timers
from msg_analysis.inference.realtime.event_order import EventOrder, order_events
from msg_analysis.inference.realtime.pattern_events import Periods
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.twin.ideal_timers import ideal_log
from msg_analysis.types import FloatArray

MAX_WORK = 6e10  # multiplications, at most (about a minute); the joint test is left out first, then the node errors

MAX_ENTRIES = 400  # entries of a stack, at most


class PatternUnavailableError(Exception):
    """The log does not allow the pattern law, or it would take too long; the message says why."""


def timing_effect(observation: Observation, means: TimeMeans) -> float | None:
    """Effect of a run's timing on its system error: expectation given the log over that with ideal timers, less 1.

    Both are exact, for the same start and graphs of the network, so that hardly anything is left to chance.

    Parameters
    ----------
    observation
        of a run in real time
    means
        of ``pattern_means``

    Returns
    -------
    float | None
        None where the expected error is 0
    """
    experiment = observation.prediction.experiment
    graphs, used, made = ideal_log(experiment, observation.step, observation.modes)
    ideal = replace(observation, timers=Timers(graphs[1:], used, made))
    periods = Periods(ideal, order_events(ideal))
    total = _forward(periods, np.sum(periods.start(_start(observation)), axis=0))[0]
    frame = observation.prediction.system.frame
    expected = float(np.trace(frame.T @ total @ frame)) / observation.steps
    return float(means.trace @ means.predicted) / expected - 1.0 if expected > 0.0 else None


def pattern_means(observation: Observation, order: EventOrder) -> TimeMeans:
    """Time means of the sampled states, with expectation and standard errors given the log.

    Parameters
    ----------
    observation
        of a run in real time
    order
        of its events

    Raises
    ------
    PatternUnavailableError
        contradictory times, too many values to be known at the same time, or a run that is too long
    """
    if order.contradiction:
        raise PatternUnavailableError(order.contradiction)
    system, steps = observation.prediction.system, observation.steps
    periods = Periods(observation, order)
    entries = periods.largest
    if entries > MAX_ENTRIES:
        raise PatternUnavailableError(
            f"{entries} values are in use at the same time, expected at most {MAX_ENTRIES}: some were used long after "
            "they were computed"
        )
    frame = system.frame
    p = packed_symmetric.size(frame.shape[1])
    for kind in ("joint", "nodes", "system"):
        forms, nodes, trace = forms_of(system, kind)
        q = len(forms)
        work = steps * entries**2 * (q**2 + (3 * q + 4) * entries)
        if work <= MAX_WORK:
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
    return TimeMeans(
        second_moments=packed_symmetric.unpack(seen / steps, frame.shape[1]),
        expected_moments=expected,
        joint=kind == "joint",
        measured=forms @ (seen / steps),
        predicted=forms @ packed_symmetric.pack(expected),
        covariance=covariance / (observation.replicas * steps**2),
        nodes=nodes,
        trace=trace,
        system_series=series,
        system_variances=variances / observation.replicas,
    )


def means_in_lockstep(observation: Observation) -> TimeMeans | None:
    """Time means of a run in lockstep, given the path of the graphs and which values were heard.

    None where that would take too long.
    """
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
