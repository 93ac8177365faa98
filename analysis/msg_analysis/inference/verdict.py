# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Comparison of a run with its prediction, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.causes import Accused, find_causes
from msg_analysis.inference.comparison import Comparison, Test, trusted
from msg_analysis.inference.estimates import CovarianceTest, Estimate, covariance_test, estimates, rank_agents
from msg_analysis.inference.evidence import Evidence
from msg_analysis.inference.given_path import GivenPath
from msg_analysis.inference.messages import loss_test
from msg_analysis.inference.observation import Measurement, Observation, spaced_steps
from msg_analysis.inference.residuals import InnovationTests
from msg_analysis.inference.sequential_sums import AnyTimeEvidence, any_time_evidence
from msg_analysis.inference.statistics import batch_interval, holm, steps_to_half_width
from msg_analysis.inference.switching import switching_test
from msg_analysis.inference.time_means import TimeMeans
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.prediction import Prediction, predict

MIN_STEPS = 100  # fewest steps of an incomplete run for which numbers are given


def compare(trajectory: Run, *, level: float = 0.01) -> Comparison:
    """Compare a run, or its complete beginning, with what theory predicts for it.

    Every test assumes exactly the law that the record says was run; the probability of any false rejection in the
    family is at most ``level`` (Holm). A test with nothing to test (no noise, one graph, no loss) is left out. In real
    time, the family has only tests that are exact whatever the timing was. Where the law has no prediction (a protocol
    that is not linear, or is not installed), only graphs and losses are tested.

    Parameters
    ----------
    trajectory
        of a bag or of the twin
    level
        probability of a false "disagrees", all tests together

    Raises
    ------
    InputError
        no prediction (too large, unbounded), or a log without what is needed
    """
    unpredicted = trajectory.record.experiment.unpredictable()
    if unpredicted:
        return _measured(trajectory, level, unpredicted)
    prediction = predict(trajectory.record.experiment, trajectory.record.step_model)
    if trajectory.prefix < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    observation = Observation.of(trajectory, prediction)
    if observation.steps < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    until = trajectory.record.until
    decided = until is not None and until.decided
    return judge(trajectory, prediction, Evidence.of(observation, level, decided=decided), level)


def judge(
    trajectory: Run,
    prediction: Prediction,
    evidence: Evidence,
    level: float,
    more: Sequence[tuple[str, float | None]] = (),
) -> Comparison:
    """The verdict on the evidence of one run, or of several; ``more`` has names and p-values of further tests.

    Of several runs, ``trajectory`` is one with the completeness of all.
    """
    means, lockstep = evidence.means, prediction.experiment.run.pace == "lockstep"
    system_error, node_errors = _over_all_paths(means, prediction.system)
    covariance = _covariance(evidence, prediction.system)
    innovations = evidence.innovations.tests()
    switching = evidence.transitions.test(prediction.step.transition)
    loss = evidence.loss.test() if evidence.loss else None
    p_broadcast = evidence.broadcast.p_value() if evidence.broadcast else None
    family = [
        *_error_tests(evidence.exact, prediction.system),
        ("covariance", covariance.p if evidence.decisive else None),
        ("innovations: covariance", innovations.p_covariance),
        ("innovations: whiteness", innovations.p_whiteness),
        ("innovations: gains", innovations.p_gain),
        ("innovations: common gain", innovations.p_common_gain),
        ("switching", switching.p),
        *((finding.test, math.exp(finding.log_p)) for finding in evidence.watched.findings()),
        ("loss", loss.p if loss else None),
        ("broadcast", p_broadcast),
        *more,
    ]
    tests = _judge(family, level)
    rejected = [test.name for test in tests if test.rejected]
    blame: list[Cause] = []
    if rejected and trajectory.completeness.complete:
        blame = find_causes(_accused(prediction, evidence), level, rejected)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=evidence.steps,
        system_error=system_error,
        node_errors=node_errors,
        covariance=covariance,
        innovations=innovations,
        switching=switching,
        continuous_error=prediction.continuous.system_error if prediction.continuous_moments else None,
        batch=batch_interval(means.system_series),
        tests=tests,
        running=_running(means, prediction.step.dt),
        loss=loss,
        p_broadcast=p_broadcast,
        timing=evidence.timing,
        laws=evidence.laws,
        given=GivenPath(means, evidence.given) if evidence.given else None,
        order=rank_agents(means, level) if means.long_enough else None,
        blame=blame,
        any_time=_any_time(trajectory.record, prediction, evidence, level),
        trust=trusted(prediction, means, given=evidence.given is not None) if lockstep else None,
    )


def _any_time(record: RunRecord, prediction: Prediction, evidence: Evidence, level: float) -> AnyTimeEvidence:
    """The interval is tuned by what was known before the run, whatever step it ended at."""
    means, names = evidence.means, [graph.name for graph in record.experiment.graph_list]
    variance = float(means.system_variances.sum()) if means.long_enough else None
    planned, error = float(record.planned_steps), evidence.watched.sums.error
    if record.until and error is not None:
        wanted = record.until.precision * prediction.emulated.system_error
        planned = min(planned, steps_to_half_width(error.variance, wanted))
    return any_time_evidence(evidence.watched, level, names, variance, evidence.steps, planned)


def _over_all_paths(means: TimeMeans, system: JumpSystem) -> tuple[Estimate, list[Estimate]]:
    """The system error and the node errors; without standard errors where the run is too short for these."""
    error, nodes = estimates(means, system)
    if means.long_enough:
        return error, nodes
    return error.without_error(), [node.without_error() for node in nodes]


def _error_tests(laws: Sequence[TimeMeans], system: JumpSystem) -> list[tuple[str, float | None]]:
    """Names and p-values of the tests of the errors; ``laws`` in the order of preference."""
    if not laws:
        return []
    system_error, nodes = estimates(next((law for law in laws if len(law.nodes)), laws[0]), system)
    named = [(f"error of agent {i}", node.p) for i, node in enumerate(nodes, start=1)]
    return [("system error", system_error.p), *named]


def _covariance(evidence: Evidence, system: JumpSystem) -> CovarianceTest:
    """The second moments and their expectation over all paths, tested given the path."""
    shown = covariance_test(evidence.means, system)
    tested = covariance_test(evidence.given, system) if evidence.given else shown
    return replace(tested, measured=shown.measured, predicted=shown.predicted)


def _accused(prediction: Prediction, evidence: Evidence) -> Accused:
    experiment = prediction.experiment
    return Accused(
        names=[graph.name for graph in experiment.graph_list],
        chain=experiment.chain,
        dt=experiment.step_length,
        reference=experiment.reference,
        innovations=evidence.innovations,
        transitions=evidence.transitions,
        loss=evidence.loss,
        broadcast=evidence.broadcast,
        departures=evidence.watched.findings(),
    )


def _measured(trajectory: Run, level: float, unpredicted: str) -> Comparison:
    """Comparison without a prediction."""
    measurement = Measurement.of(trajectory)
    agents, enough = measurement.step.agents, True
    if measurement.steps < MIN_STEPS and not trajectory.completeness.complete:
        enough = False
    series, covariance = measurement.system_series, measurement.covariance if enough else None
    switching = switching_test(measurement.modes, measurement.step.transition) if enough else None
    loss = loss_test(measurement) if enough else None
    family = [("switching", switching.p if switching else None), ("loss", loss.p if loss else None)]
    nodes = [Estimate()] * agents if covariance is None else [Estimate(float(error)) for error in np.diag(covariance)]
    counts = spaced_steps(len(series)) if enough else np.empty(0, np.int64)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=measurement.steps,
        system_error=Estimate() if covariance is None else Estimate(float(np.trace(covariance))),
        node_errors=nodes,
        covariance=CovarianceTest(measured=covariance, note="there is no prediction"),
        innovations=InnovationTests(None, None, None),
        switching=switching,
        continuous_error=None,
        batch=batch_interval(series) if enough else None,
        tests=_judge(family, level),
        running={
            "time": np.asarray((measurement.first + counts) * measurement.step.dt, dtype=float),
            "system_error": np.cumsum(series)[counts - 1] / counts if enough else np.empty(0),
            "standard_error": np.zeros(len(counts)),
        },
        loss=loss,
        unpredicted=unpredicted,
        transient=measurement.first if enough else None,
    )


def without_numbers(trajectory: Run, level: float, prediction: Prediction, steps: int) -> Comparison:
    """Comparison with too few steps: only what was expected."""
    predicted = prediction.emulated
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=steps,
        system_error=Estimate(predicted=predicted.system_error),
        node_errors=[Estimate(predicted=float(error)) for error in predicted.node_errors],
        covariance=CovarianceTest(predicted=predicted.covariance),
        innovations=InnovationTests(None, None, None),
        switching=None,
        continuous_error=prediction.continuous.system_error if prediction.continuous_moments else None,
        batch=None,
        tests=[],
        running={key: np.empty(0) for key in ("time", "system_error", "standard_error")},
    )


def _judge(family: list[tuple[str, float | None]], level: float) -> list[Test]:
    # A NaN statistic (a log with numbers too large to compute with) counts as p = 0: the law never gives one.
    tested = [(name, 0.0 if math.isnan(p) else p) for name, p in family if p is not None]
    adjusted = holm(np.array([p for _, p in tested], dtype=float))
    return [Test(name, p, float(a), bool(a < level)) for (name, p), a in zip(tested, adjusted, strict=True)]


def _running(means: TimeMeans, dt: float) -> dict[str, FloatArray]:
    """Mean of the system error up to some steps, denser at the beginning, and its standard error."""
    counts = spaced_steps(len(means.system_series))
    errors = np.sqrt(np.cumsum(means.system_variances)[counts - 1]) / counts
    return {
        "time": np.asarray(counts * dt, dtype=float),
        "system_error": np.cumsum(means.system_series)[counts - 1] / counts,
        "standard_error": errors if means.long_enough else np.zeros(len(counts)),
    }
