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

"""Departures in time or in detail as causes, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.common.text.number_words import percent
from msg_analysis.inference.blame.cause import Cause, numbers_text
from msg_analysis.inference.departures.departure import Finding, Place
from msg_analysis.inference.departures.largest_innovation import LargestInnovation
from msg_analysis.inference.departures.long_lags import LongLags
from msg_analysis.inference.departures.noise_by_graph import NoiseByGraph
from msg_analysis.inference.departures.noise_over_time import NoiseOverTime
from msg_analysis.inference.departures.sojourns import Sojourns
from msg_analysis.inference.departures.stale_values import StaleValues
from msg_analysis.inference.departures.standing_still import StandingStill
from msg_analysis.inference.statistics.distributions import binomial_interval

ABOUT_THE_CHAIN = ("switching", "sojourns")


def frozen_cause(agent: int, still: int, steps: int, findings: Sequence[Finding]) -> Cause:
    """An agent, from 0, that did not move in so many of its steps; with the stretch if that is all of them."""
    share, interval = still / steps, binomial_interval(still, steps)
    when = "does not move in any of its steps" if still == steps else f"does not move in {percent(share)} of its steps"
    stretch = next((one.place for one in findings if one.test == StandingStill.test and one.agent == agent), None)
    where = None
    if stretch and still < steps and still == stretch.last - stretch.first + 1:
        when, where = f"stood still {_steps(stretch)}", (stretch.first, stretch.last)
    words = f"agent {agent + 1} {when}, although it has noise"
    return Cause("frozen", words, agent + 1, None, None, share, interval, 0.0, 0.0, where)


def departure_causes(
    findings: Sequence[Finding], names: Sequence[str], others: Sequence[Cause], families: int, level: float
) -> list[Cause]:
    """Causes that the ``others``, which concern the whole run, do not explain.

    Of departures of the innovations, the clearest one, if it is clearer than all other causes of the innovations: one
    fault departs in many ways. Sojourns, if the rates are right.
    """
    found = []
    chain = [one for one in findings if one.test == Sojourns.test]
    steps = [one for one in findings if one.test != Sojourns.test]
    for group, same in ((chain, True), (steps, False)):
        rivals = [cause.p or 0.0 for cause in others if (cause.kind in ABOUT_THE_CHAIN) == same]
        best = min(group, key=lambda one: one.log_p, default=None)
        if best is None:
            continue
        log_p = best.log_p + math.log(families)
        if log_p < math.log(level) and math.exp(log_p) < min(rivals, default=1.0):
            found.append(_cause(best, names, math.exp(log_p)))
    return found


def _cause(one: Finding, names: Sequence[str], p: float) -> Cause:
    agent = None if one.agent is None else one.agent + 1
    graph = None if one.graph is None else names[one.graph]
    where = (one.place.first, one.place.last) if one.place else None
    whose = "all agents" if agent is None else f"agent {agent}"
    value, expected = one.estimate or 0.0, one.expected
    half = HALF_WIDTH_95 * (one.standard_error or 0.0)
    interval = (value - half, value + half)
    said = numbers_text(value, interval)
    if one.test == Sojourns.test and one.span:
        first, last = one.span
        part = f"from step {first:,} of it on" if last is None else f"in steps {first:,} to {last:,} of it"
        part = f"in step {first:,} of it" if first == last else part
        words = (
            f"the probability of leaving graph {graph} depends on the length of the sojourn: it is {said} {part}, "
            f"not {expected:.3g}"
        )
        return Cause("sojourns", words, None, None, graph, value, interval, expected, p)
    if one.test == NoiseOverTime.test and one.span:
        words = (
            f"the size of the noise of {whose} has correlation {said} with its own {one.span[0]} steps before, not 0: "
            "its variance changes in time"
        )
        return Cause("noise", words, agent, None, None, value, interval, expected, p)
    if one.test in (NoiseByGraph.test, NoiseOverTime.test):
        when = f"in graph {graph}" if one.place is None else _steps(one.place)
        words = f"the noise variance of {whose} is {said} times what the file says {when}"
        return Cause("noise", words, agent, None, graph, value, interval, expected, p, where)
    if one.test == StandingStill.test and one.place:
        words = f"agent {agent} stood still {_steps(one.place)}, although it has noise"
        return Cause("frozen", words, agent, None, None, None, None, expected, p, where)
    if one.test == LargestInnovation.test and one.place:
        words = f"agent {agent}'s noise is {value:.3g} standard deviations {_steps(one.place)}"
        return Cause("outlier", words, agent, None, None, value, None, expected, p, where)
    if one.test == LongLags.test and one.span:
        words = f"the noise of {whose} has correlation {said} with its own {one.span[0]} steps before, not 0"
        return Cause("lag", words, agent, None, None, value, interval, expected, p)
    if one.test == StaleValues.test:
        link = None if one.sender is None or agent is None else (one.sender + 1, agent)
        which = f"the values of agent {link[0]} that agent {link[1]} uses" if link else "the values that agents use"
        share, around = percent(value), f"{100 * interval[0]:.3g} to {100 * interval[1]:.3g} %"
        words = f"{share} ({around}) of {which} are one step older than the log says"
        return Cause("stale", words, None, link, None, value, interval, expected, p)
    pair = [name for name in (graph, None if one.other is None else names[one.other]) if name]
    words = f"the log has the names of the graphs {' and '.join(pair)} swapped"
    return Cause("graph", f"{words} {_steps(one.place)}" if one.place else words, None, None, pair, p=p, steps=where)


def _steps(place: Place) -> str:
    of_run = f" of run {place.run}" if place.run > 1 else ""
    if place.first == place.last:
        return f"in step {place.first:,}{of_run}"
    return f"from step {place.first:,} to {place.last:,}{of_run}"
