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

"""Which laws of a run in real time its log supports: logged pattern, sequential, continuous."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from msg_analysis.common.text.number_words import percent
from msg_analysis.inference.errors.estimates import Estimate, covariance_test, estimates
from msg_analysis.inference.errors.time_means import TimeMeans, time_means
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.realtime.event_order import EventOrder, sampled
from msg_analysis.inference.realtime.logged_pattern import PatternUnavailableError, pattern_means, timing_effect
from msg_analysis.inference.realtime.timing import Timing
from msg_analysis.inference.statistics.distributions import two_sided
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.theory.prediction import LAW_NAMES

MAX_MISSED = 0.01  # largest share of missed deadlines with which a law without lateness can be supported

MAX_EFFECT = 0.01  # largest relative change of the system error that a law may leave out and still be supported


SUPPORT = {True: "supported", False: "not supported", None: "not decided"}


@dataclass(frozen=True, slots=True)
class Law:
    """A law next to the log."""

    system_error: Estimate  # measured, and predicted by this law
    supported: bool | None  # whether the log supports it; None where that is not decided
    why: str

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {"system_error": self.system_error.to_json(), "supported": self.supported, "why": self.why}


@dataclass(frozen=True, slots=True)
class Laws:
    """The laws of a run in real time."""

    pattern: Law  # given the values and graphs that the agents logged as used; exact for any timing
    sequential: Law  # no step is late, every value is heard at once
    continuous: Law  # the paper's

    @property
    def measured_against(self) -> Literal["pattern", "sequential"]:
        """The law that the errors of the comparison are compared with: the pattern law where it is available."""
        return "sequential" if self.pattern.system_error.predicted is None else "pattern"

    @property
    def why(self) -> str:
        """The reasons of all three, in words."""
        laws = {
            "pattern": self.pattern,
            "sequential": self.sequential,
            "continuous": self.continuous,
        }
        return " ".join(
            f"{LAW_NAMES[key].capitalize()} ({SUPPORT[law.supported]}): {law.why}." for key, law in laws.items()
        )

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "pattern": self.pattern.to_json(),
            "sequential": self.sequential.to_json(),
            "continuous": self.continuous.to_json(),
            "why": self.why,
        }


def measure_laws(observation: Observation, order: EventOrder, timing: Timing, level: float) -> tuple[TimeMeans, Laws]:
    """Compare a run in real time with each law; also the time means under the pattern law, else the sequential law.

    The pattern law is supported unless the errors reject it at ``level``. The others are not supported if the errors
    reject them, or if more deadlines were missed than ``MAX_MISSED``. They are supported if what they leave out is
    known to change the system error by at most ``MAX_EFFECT``; otherwise the run is too short to decide.
    """
    sequential = time_means(replace(observation, states=sampled(observation, order)))
    error, p = _least(observation, sequential)
    effect = None
    try:
        means = pattern_means(observation, order)
        pattern = _pattern(observation, means, level)
        effect = timing_effect(observation, means)
    except PatternUnavailableError as reason:
        means = sequential
        pattern = Law(Estimate(error.measured), None, f"not available: {reason}")
    late = timing.missed_share > MAX_MISSED
    # Where agents keep values from step to step, the sequential law has no standard error of its own.
    untested = p is None and observation.prediction.system.readout is not None and pattern.supported
    law = _sequential(error, 1.0 if untested else p, level, _departures(timing), effect, late)
    return means, Laws(pattern, law, _continuous(observation, error, level, late))


def _pattern(observation: Observation, means: TimeMeans, level: float) -> Law:
    error, p = _least(observation, means)
    if p is None:
        return Law(error, None, "without noise the errors cannot be tested")
    logged = "the prediction for the values and graphs that the agents logged"
    if p >= level:
        return Law(error, True, f"the errors agree with {logged}")
    why = "this law holds for any timing, so an agent did not follow its law, or its log is wrong"
    return Law(error, False, f"the errors differ from {logged} ({_tested(error, p)}); {why}")


def _departures(timing: Timing) -> list[str]:
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
    error: Estimate, p: float | None, level: float, departures: list[str], effect: float | None, late: bool
) -> Law:
    why = "assumes that every step is on time and every message arrives at once"
    if not departures:
        why += ", as in this log"
    else:
        first = ", ".join(departures[:-1])
        why += ", but " + (f"{first} and " if first else "") + departures[-1]
        if effect is not None:
            why += f", which changes the system error by {_change(effect)}"
    if p is None:
        return Law(error, None, why)
    if p < level:
        return Law(error, False, f"{why}; the measured errors differ ({_tested(error, p)})")
    if late:
        return Law(error, False, why)
    if not departures or (effect is not None and abs(effect) <= MAX_EFFECT):
        return Law(error, True, why)
    return Law(error, None, f"{why}; the run is too short to show a difference")


def _continuous(observation: Observation, sequential: Estimate, level: float, late: bool) -> Law:
    """With the standard error of the sequential law, from which that of the continuous law would hardly differ."""
    law, experiment = observation.prediction.continuous_moments, observation.prediction.experiment
    if law is None:
        return Law(Estimate(sequential.measured), None, "not available for this experiment")
    predicted = law.system_error
    if sequential.standard_error is None:
        return Law(Estimate(sequential.measured, predicted), None, "its errors have no standard error here")
    if not sequential.standard_error or sequential.measured is None or not predicted:
        return Law(Estimate(sequential.measured, predicted), None, "without noise the errors cannot be tested")
    if experiment.run.start != "stationary":
        why = "only its steady state is predicted, and the run did not start there"
        return Law(Estimate(sequential.measured, predicted), None, why)
    z = (sequential.measured - predicted) / sequential.standard_error
    p = float(two_sided(z))
    error = Estimate(sequential.measured, predicted, sequential.standard_error, z, p)
    effect = observation.prediction.emulated.system_error / predicted - 1.0
    why = (
        f"ignores that the agents make steps of {observation.step.dt:g}, one after the other, which changes the "
        f"system error by {_change(effect)}"
    )
    if p < level:
        return Law(error, False, f"{why}; the measured system error differs ({_z(error)})")
    if late:
        return Law(error, False, f"{why}, and that deadlines were missed")
    if abs(effect) <= MAX_EFFECT:
        return Law(error, True, why)
    return Law(error, None, f"{why}; the run is too short to show a difference")


def _least(observation: Observation, means: TimeMeans) -> tuple[Estimate, float | None]:
    """The system error, and the smallest adjusted p-value of all tests of the second moments."""
    system = observation.prediction.system
    error, nodes = estimates(means, system)
    if not means.long_enough:
        return error.without_error(), None
    tests = [error.p, *(node.p for node in nodes), covariance_test(means, system).p]
    tested = np.array([p for p in tests if p is not None], dtype=float)
    return error, float(holm(tested).min()) if len(tested) else None


def _change(effect: float) -> str:
    return f"{100 * effect:+.2g} %"


def _tested(error: Estimate, p: float) -> str:
    return f"system error {_z(error)}, smallest p {p:.2g}"


def _z(estimate: Estimate) -> str:
    return "z undefined" if estimate.z is None else f"z = {estimate.z:+.1f}"
