# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a log of any origin: all tests of its innovations, its path and its errors, decided together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.resources import blas_threads
from msg_analysis.common.text import HALF_WIDTH_95, counted, markdown_table, number_text, with_names
from msg_analysis.errors import ExitCode, InputError
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.hidden_path import HiddenFilter, hidden_system_error, long_run_error, why_no_filter
from msg_analysis.inference.innovations import Filter, Innovations, Variance, estimate_noise
from msg_analysis.inference.intervals import interval_law
from msg_analysis.inference.log_tests import (
    Parameters,
    PathTest,
    covariance_p,
    largest_p,
    parameter_causes,
    path_test,
    size_p,
    swapped,
    system_error,
    whiteness_p,
)
from msg_analysis.inference.question import Test
from msg_analysis.inference.statistics import holm
from msg_analysis.model.log import Log

FEWEST = 50  # samples
IRREGULAR, GAP = 0.05, 3.0  # median intervals: deviation that is said; what is longer is a gap
ESTIMATED_FROM = 20_000  # samples with which the measurement noise is searched for
MOST_MATRICES = 60_000_000  # numbers in the matrices that the mean error needs
VARIANCES = ("noise", "measurement_noise")  # kinds of causes
MOST_CHANGE = 100.0  # of a weight; a log that knows nothing of the gains can ask for more, and for unstable laws
OTHER_FAMILIES = 3  # of causes: rates, exchanged agents, a held leader


@dataclass(frozen=True, slots=True)
class Factor:
    """A measured number over that of the law or map; None: the log says nothing about it."""

    estimate: float | None
    interval: tuple[float, float] | None  # 95 %


@dataclass(frozen=True, slots=True)
class MeasurementNoise:
    """Standard deviations of the measurement noise."""

    values: tuple[float, ...]  # (m,)
    estimated: bool
    interval: tuple[float, float] | None = None  # 95 %, where it was estimated


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LogComparison:
    """The result of ``msg-analysis compare --law --map``.

    Attributes
    ----------
    log
        what was compared
    level
        probability of a false "disagrees", at most
    tests
        the family; the verdict is "disagrees" where one is rejected
    causes
        what is wrong, the clearest first
    system_error
        mean-square error over the samples, without the measurement noise, and its expectation given the path of the
        graphs, or over all paths where it is hidden; None where it was not computed
    ratios
        (m,) mean square of the standardised innovations of each agent, 1 under the law; None: never measured
    factors
        of all gains, all noise variances, the variance of the measurement noise, and with a hidden path all rates,
        estimated together
    measurement_noise
        as the map says it, or estimated
    path
        test of the switches; None where there is nothing to test
    exact, approximate, untested
        what the verdict rests on, in sentences
    """

    log: Log
    level: float
    tests: list[Test]
    causes: Sequence[Cause]
    system_error: Estimate | None
    ratios: tuple[float | None, ...]
    factors: dict[str, Factor]
    measurement_noise: MeasurementNoise
    path: PathTest | None
    exact: tuple[str, ...]
    approximate: tuple[str, ...]
    untested: tuple[str, ...]

    @property
    def verdict(self) -> Literal["agrees", "disagrees"]:
        """Whether no test is rejected."""
        return "disagrees" if any(test.rejected for test in self.tests) else "agrees"

    @property
    def exit_code(self) -> int:
        """0 agrees, 1 disagrees."""
        return ExitCode.DISAGREES if self.verdict == "disagrees" else ExitCode.FINE

    def __repr__(self) -> str:
        error = self.system_error
        numbers = "" if error is None else f"; system error {number_text(error.measured)}, predicted "
        numbers += "" if error is None else number_text(error.predicted)
        return f"<LogComparison with {self.log.law.name!r}: {self.verdict}{numbers}>"

    def _repr_markdown_(self) -> str:
        rows = [(test.name, number_text(test.p, 3), number_text(test.p_adjusted, 3)) for test in self.tests]
        causes = "".join(f"- {with_names(cause.words, self.log.law.names)}\n" for cause in self.causes)
        return f"**{self.verdict}**\n\n{causes}\n" + markdown_table(("test", "p", "adjusted"), rows)

    def to_json(self) -> dict[str, Any]:
        """The document of ``--json``."""
        log, path = self.log, self.path
        lengths = np.diff(log.times)
        return {
            "verdict": self.verdict,
            "law": log.law.name,
            "sampled_law": log.sampled_law,
            "hidden": log.hidden,
            "names": log.law.names,
            "level": self.level,
            "samples": len(log.times),
            "coordinates": log.states.shape[2],
            "span": float(log.times[-1] - log.times[0]),
            "intervals": {
                "least": float(lengths.min()),
                "median": float(np.median(lengths)),
                "largest": float(lengths.max()),
            },
            "missing": int(np.isnan(log.states).any(axis=2).sum()),
            "measurement_noise": asdict(self.measurement_noise),
            "system_error": None if self.system_error is None else self.system_error.to_json(),
            "ratios": list(self.ratios),
            "factors": {name: asdict(factor) for name, factor in self.factors.items()},
            "switching": None
            if path is None
            else {"counts": path.counts.tolist(), "expected": path.expected.tolist(), "p": path.p},
            "tests": [{**test.to_json(), "meaning": test.meaning} for test in self.tests],
            "causes": [asdict(cause) for cause in self.causes],
            "exact": list(self.exact),
            "approximate": list(self.approximate),
            "untested": list(self.untested),
            "notes": list(log.notes),
        }


def compare_log(log: Log, level: float = 0.01) -> LogComparison:
    """Compare a log with its law; see ``Log.compare``."""
    if not 0.0 < level <= 0.5:
        raise InputError(f"level: {level}: expected a probability above 0, at most 0.5")
    if len(log.times) < FEWEST:
        raise InputError(f"{len(log.times)} samples: expected at least {FEWEST}: record for longer")
    law = interval_law(log.law, log.sampled_law)
    never = np.flatnonzero(np.isnan(log.states).all(axis=(0, 2)) & ~law.held)
    if len(never):
        raise InputError(f"agent {int(never[0]) + 1}: no value in the log: expected some of every agent")
    reason = why_no_filter(law, log.times) if log.hidden else None
    if reason:
        return _errors_only(log, level, reason)
    of = (
        HiddenFilter(law, log.times, log.states)
        if log.hidden
        else Filter(law, log.times, log.states, log.starts, log.graphs)
    )
    with blas_threads(law.agents):
        noise, measured = measurement_noise(log, of)
        keep = law.agents**2 * len(log.times) * (law.modes if log.hidden else 2) <= MOST_MATRICES
        found = of.run(noise, terms=of.terms(), keep=keep)
        error = None
        if keep:
            error = hidden_system_error(of, found) if isinstance(of, HiddenFilter) else system_error(of, found)
        found.maps = found.gains = found.moments = found.probabilities = None
        parameters = Parameters.of(found, estimated=measured.estimated)
        span = float(log.times[0]), float(log.times[-1])
        path = None if log.hidden else path_test(log.law, log.starts, log.graphs, span, log.sampled_law == "steps")
        tests = _tests(found, parameters, path, error, level)
        causes = _causes(log, of, found, parameters, path, noise, tests, level)
    sizes = size_p(found)
    return LogComparison(
        log=log,
        level=level,
        tests=tests,
        causes=causes,
        system_error=error,
        ratios=tuple(None if one is None else one[0] for one in sizes),
        factors=_factors(parameters),
        measurement_noise=measured,
        path=path,
        **_grounds(log, found, measured, path, error),
    )


def _errors_only(log: Log, level: float, reason: str) -> LogComparison:
    """The verdict by the system error alone, where a hidden path cannot be followed."""
    if log.measurement_noise is None:
        raise InputError(f"measurement_noise: estimate: {reason}: expected standard deviations")
    error = long_run_error(log.law, log.sampled_law, log.states, log.measurement_noise)
    meaning = "the mean-square error is not that of the law"
    tests = (
        [Test("system error", error.p, error.p, error.p < level, error, None, meaning)] if error.p is not None else []
    )
    words = f"the mean-square error is {number_text(error.measured)}, and not {number_text(error.predicted)}"
    return LogComparison(
        log=log,
        level=level,
        tests=tests,
        causes=[Cause("unknown", words)] if any(test.rejected for test in tests) else [],
        system_error=error,
        ratios=(None,) * log.law.agents,
        factors={},
        measurement_noise=MeasurementNoise(tuple(log.measurement_noise.tolist()), estimated=False),
        path=None,
        exact=("The system error that is expected is the mean over all paths of the graphs in the steady state.",),
        approximate=("The log is taken to be in the steady state; the interval is that of the means of its parts.",),
        untested=(f"Innovations, gains, noise and the switching: {reason}.",),
    )


def measurement_noise(log: Log, of: Filter) -> tuple[FloatArray, MeasurementNoise]:
    """Of the map, or estimated."""
    m = of.law.agents
    if log.measurement_noise is not None:
        return log.measurement_noise, MeasurementNoise(tuple(log.measurement_noise.tolist()), estimated=False)
    value, error = estimate_noise(of, ESTIMATED_FROM)
    half = HALF_WIDTH_95 * error
    return np.full(m, value), MeasurementNoise((value,) * m, True, (max(value - half, 0.0), value + half))


def _tests(
    found: Innovations, parameters: Parameters, path: PathTest | None, error: Estimate | None, level: float
) -> list[Test]:
    """The family, decided by Holm's method."""
    terms, largest = len(found.terms), largest_p(found)
    rates = Variance("switching")
    last = terms + len(found.variances) - (rates in found.variances)
    common = parameters.variance(Variance("measurement"))
    listed: list[tuple[str, float | None, str]] = [
        ("innovations: covariance", covariance_p(found), "innovations vary, or vary together, otherwise than expected"),
        ("innovations: whiteness", whiteness_p(found), "what the law did not expect can be foretold from the past"),
        ("innovations: gains", parameters.joint_p(slice(0, terms)), "a gain, a reference or an offset is wrong"),
        ("innovations: common gain", parameters.direction_p(parameters.gains), "all gains are wrong by one factor"),
        ("innovations: variances", parameters.joint_p(slice(terms, last)), "noise or measurement noise is wrong"),
        ("innovations: common noise", parameters.direction_p(parameters.process), "all noise is wrong by one factor"),
        ("innovations: measurement noise", parameters.direction_p(common), "the measurement noise is wrong"),
        (
            "innovations: rates",
            parameters.direction_p(parameters.variance(rates)),
            "the hidden graphs switch otherwise",
        ),
        ("innovations: largest", largest and largest[0], "a value is far from where the law can have put it"),
        ("switching", path.p if path else None, "the graphs switch more or less often than in the law"),
        ("system error", error.p if error else None, "the mean-square error is not that of the law"),
    ]
    sizes = enumerate(size_p(found), start=1)
    meaning = "the innovations of this agent are larger or smaller than expected"
    listed[1:1] = [(f"innovations: size, agent {i}", one and one[1], meaning) for i, one in sizes]
    if found.off_reference:
        listed.append(("held leader", 0.0, "a leader that is held at the reference is elsewhere"))
    known = [(name, 0.0 if math.isnan(p) else p, meaning) for name, p, meaning in listed if p is not None]
    adjusted = holm(np.array([p for _, p, _ in known]))
    return [
        Test(name, p, float(all_), bool(all_ < level), error if name == "system error" else None, None, meaning)
        for (name, p, meaning), all_ in zip(known, adjusted, strict=True)
    ]


def _causes(
    log: Log,
    of: Filter,
    found: Innovations,
    parameters: Parameters,
    path: PathTest | None,
    noise: FloatArray,
    tests: Sequence[Test],
    level: float,
) -> list[Cause]:
    rejected = [test.name for test in tests if test.rejected]
    causes: list[Cause] = []
    if not rejected:
        return causes
    if found.off_reference:
        k, agent, off = found.off_reference
        words = f"agent {agent + 1} is held at the reference by the law, but {off:.3g} away at {log.times[k]:g}"
        causes.append(Cause("held", words, agent + 1, p=0.0))
    if any(name.startswith(("innovations", "system")) for name in rejected):
        unit = of.law.unit
        several, change = parameter_causes(parameters, log.law, unit, OTHER_FAMILIES, level)
        if 0.0 < np.abs(change).max(initial=0.0) < MOST_CHANGE and any(cause.kind in VARIANCES for cause in several):
            # A wrong gain makes innovations larger, too: variances are judged with the gains that were found.
            law = of.law.changed(found.terms, change)
            again = of.under(law).run(noise, terms=found.terms, most=min(len(log.times), ESTIMATED_FROM))
            left = Parameters.of(again, estimated=log.measurement_noise is None)
            others, _ = parameter_causes(left, log.law, unit, OTHER_FAMILIES, level)
            several = [cause for cause in several if cause.kind not in VARIANCES]
            several += [cause for cause in others if cause.kind in VARIANCES]
        exchanged = swapped(of, noise, OTHER_FAMILIES + len(parameters.classes()))
        if exchanged and exchanged[0].order < math.log(level) and exchanged[1] > parameters.explained:
            several = [exchanged[0]]  # it explains more than all other changes together
        causes += several
    if path and path.cause and "switching" in rejected:
        causes.append(path.cause)
    if not causes and "innovations: largest" in rejected and (largest := largest_p(found)):
        p, k, i = largest
        words = f"agent {i + 1} jumps at {log.times[k]:g}: the value there is far from where the law can have put it"
        causes.append(Cause("jump", words, i + 1, p=p, log_p=math.log(p) if p > 0.0 else None))
    if not causes:
        words = f"no single cause that is searched for explains the rejected tests ({', '.join(rejected)})"
        causes.append(Cause("unknown", words))
    return sorted(causes, key=lambda cause: cause.order)


def _factors(parameters: Parameters) -> dict[str, Factor]:
    named = {
        "gains": parameters.gains,
        "noise": parameters.process,
        "measurement_noise": parameters.variance(Variance("measurement")),
    }
    if Variance("switching") in parameters.found.variances:
        named["rates"] = parameters.variance(Variance("switching"))
    factors = {}
    for name, one in zip(named, parameters.factor(list(named.values())), strict=True):
        if one is None:
            factors[name] = Factor(None, None)
            continue
        value, half = one[0], HALF_WIDTH_95 * one[1]
        least = -math.inf if name == "gains" else 0.0  # variances and rates are not negative
        factors[name] = Factor(max(value, least), (max(value - half, least), max(value + half, least)))
    return factors


def _grounds(
    log: Log, found: Innovations, measured: MeasurementNoise, path: PathTest | None, error: Estimate | None
) -> dict[str, tuple[str, ...]]:
    """What is exact, approximate and not tested, in sentences."""
    law = "the steps of length run.dt" if log.sampled_law == "steps" else "the continuous law"
    exact = [f"The innovations are those of {law} over the path of the graphs in the log, with all its intervals."]
    approximate = ["The tests of gains, variances and errors are exact in the limit of many samples."]
    untested = ["Which messages were received, lost or late: a log of states does not say it."]
    if log.hidden:
        exact = [f"Means and covariances between two samples are those of {law} over all paths of the graphs."]
        approximate.append(
            "The graphs are hidden: the innovations are tested given a filter of the path (interacting multiple "
            "models), for which the states are normal given the graph."
        )
        untested.append("The single rates of the switching: only a common factor of all, as far as states tell it.")
    lengths = np.diff(log.times) / np.median(np.diff(log.times))
    varies = float(lengths[lengths < GAP].std())
    if varies > IRREGULAR and log.sampled_law == "continuous":
        approximate.append(
            f"The intervals vary by {varies:.0%} of their median: the stamps are taken to be the true times of the "
            "samples; errors of 5 % of the interval can reject a right log."
        )
    if measured.estimated:
        approximate.append("The measurement noise is estimated from the log, the same for all agents.")
    if found.scored < found.samples:
        what = "gains, variances and rates" if log.hidden else "variances"
        approximate.append(f"The tests of {what} use the first {counted(found.scored, 'sample')} only.")
    if path is None and len(log.law.graph_list) > 1 and not log.hidden:
        untested.append("The switching: the law has a given sequence of graphs.")
    if path is not None and len(log.starts) == 1:
        approximate.append("The log has one graph all the time: the test of the switching is about that alone.")
    if error is None:
        untested.append("The mean-square error: the log is too large for its matrices.")
    return {"exact": tuple(exact), "approximate": tuple(approximate), "untested": tuple(untested)}
