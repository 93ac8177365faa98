"""Which laws of a run in real time its log supports: logged pattern, sequential, continuous."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import stats

from msg_analysis.common.number_words import percent
from msg_analysis.inference.errors.estimates import Estimate, covariance_test, estimates
from msg_analysis.inference.errors.time_means import TimeMeans, time_means
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.realtime.event_order import EventOrder, sampled
from msg_analysis.inference.realtime.logged_pattern import PatternUnavailableError, pattern_means, timing_effect
from msg_analysis.inference.realtime.timing import Timing
from msg_analysis.inference.statistics.holm import holm

MAX_MISSED = 0.01  # largest share of missed deadlines with which a law without lateness can be supported

MAX_EFFECT = 0.01  # largest relative change of the system error that a law may leave out and still be supported


@dataclass(frozen=True, slots=True)
class Law:
    """A law beside the log."""

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
            "logged-pattern law": self.pattern,
            "sequential law": self.sequential,
            "continuous law": self.continuous,
        }
        said = {True: "supported", False: "not supported", None: "not decided"}
        return " ".join(f"The {name} is {said[law.supported]}: {law.why}." for name, law in laws.items())

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
    sequential = time_means(replace(observation, states=sampled(observation)))
    error, p = _least(observation, sequential)
    effect = None
    try:
        means = pattern_means(observation, order)
        pattern = _pattern(observation, means, level)
        effect = timing_effect(observation, means)
    except PatternUnavailableError as reason:
        means = sequential
        pattern = Law(Estimate(error.measured), None, f"it is not available: {reason}")
    late = timing.missed_share > MAX_MISSED
    law = _sequential(error, p, level, _departures(timing), effect, late)
    return means, Laws(pattern, law, _continuous(observation, error, level, late))


def _pattern(observation: Observation, means: TimeMeans, level: float) -> Law:
    error, p = _least(observation, means)
    if p is None:
        return Law(error, None, "without noise there is nothing to measure")
    if p >= level:
        why = "with the values and graphs that the agents say they used, the errors are as they should be"
    else:
        why = (
            "with the values and graphs that the agents say they used, the errors should be others "
            f"(system error {_z(error)}, least p {p:.2g}); this law holds whatever the timing, so agents did something "
            "else than their law, or than they say"
        )
    return Law(error, p >= level, why)


def _departures(timing: Timing) -> list[str]:
    """Facts in the log that contradict the sequential law."""
    facts = []
    if timing.missed:
        facts.append(f"{percent(timing.missed_share)} of the deadlines were missed")
    if timing.ideal_uses < timing.uses:
        facts.append(f"{percent(1.0 - timing.ideal_share)} of the values used were not those that it assumes")
    if timing.outdated_graphs:
        facts.append(f"{percent(timing.outdated_share)} of the steps were made with another graph than the network's")
    return facts


def _sequential(
    error: Estimate, p: float | None, level: float, departures: list[str], effect: float | None, late: bool
) -> Law:
    why = "it assumes that nobody is late and that all is heard at once; "
    if not departures:
        why += "and so it was"
    else:
        why += departures[0] if len(departures) == 1 else ", ".join(departures[:-1]) + " and " + departures[-1]
        if effect is not None:
            why += f", which changes the system error by {_change(effect)}"
    if p is None:
        return Law(error, None, why)
    if p < level:
        return Law(error, False, f"{why}; the errors are others (system error {_z(error)}, least p {p:.2g})")
    if late:
        return Law(error, False, why)
    if not departures or (effect is not None and abs(effect) <= MAX_EFFECT):
        return Law(error, True, why)
    return Law(error, None, f"{why}; in a run of this length the errors do not show it")


def _continuous(observation: Observation, sequential: Estimate, level: float, late: bool) -> Law:
    """With the standard error of the sequential law, from which that of the continuous law would hardly differ."""
    law, experiment = observation.prediction.continuous, observation.prediction.experiment
    if law is None:
        return Law(Estimate(sequential.measured), None, "there is none for this experiment")
    predicted = law.system_error
    if not sequential.standard_error or sequential.measured is None or not predicted:
        return Law(Estimate(sequential.measured, predicted), None, "without noise there is nothing to measure")
    if experiment.run.start != "stationary":
        why = "the run did not start in the steady state, which is all that is known of this law here"
        return Law(Estimate(sequential.measured, predicted), None, why)
    z = (sequential.measured - predicted) / sequential.standard_error
    p = float(2.0 * stats.norm.sf(abs(z)))
    error = Estimate(sequential.measured, predicted, sequential.standard_error, z, p)
    effect = observation.prediction.emulated.system_error / predicted - 1.0
    why = (
        f"it leaves out that the agents make steps (of {observation.step.dt:g}), one after the other, which changes "
        f"the system error by {_change(effect)}"
    )
    if p < level:
        return Law(error, False, f"{why}; the measured one differs ({_z(error)})")
    if late:
        return Law(error, False, f"{why}, and that deadlines were missed")
    if abs(effect) <= MAX_EFFECT:
        return Law(error, True, why)
    return Law(error, None, f"{why}; a run of this length does not show it")


def _least(observation: Observation, means: TimeMeans) -> tuple[Estimate, float | None]:
    """The system error, and the smallest adjusted p-value of all tests of the second moments."""
    system = observation.prediction.system
    error, nodes = estimates(means, system)
    tests = [error.p, *(node.p for node in nodes), covariance_test(means, system).p]
    tested = np.array([p for p in tests if p is not None], dtype=float)
    return error, float(holm(tested).min()) if len(tested) else None


def _change(effect: float) -> str:
    return f"{100 * effect:+.2g} %"


def _z(estimate: Estimate) -> str:
    return "z undefined" if estimate.z is None else f"z = {estimate.z:+.1f}"
