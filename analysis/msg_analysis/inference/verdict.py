# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Comparison of a run, or of several runs of one experiment, with the prediction, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from msg_analysis.common.arrays import BLOCK_NUMBERS, FloatArray, IntArray
from msg_analysis.common.resources import blas_threads
from msg_analysis.experiment.limits import unpredictable
from msg_analysis.experiment.markov_chain import Schedule
from msg_analysis.inference.candidates import Cause
from msg_analysis.inference.comparison import MAX_MISSED, Comparison, few_digits, trusted
from msg_analysis.inference.counts import LossTally, Transitions, loss_test
from msg_analysis.inference.e_values import log_mean
from msg_analysis.inference.estimates import (
    CovarianceTest,
    Estimate,
    beside_sampled,
    covariance_test,
    estimates,
    rank_agents,
    sampled_beside,
)
from msg_analysis.inference.event_order import order_events
from msg_analysis.inference.evidence_sums import AnyTimeEvidence, WatchedEvidence, any_time_evidence
from msg_analysis.inference.exact_values import exact_findings, of_runs
from msg_analysis.inference.fault_power import run_power
from msg_analysis.inference.given_path import GivenPath, means_given_path
from msg_analysis.inference.observation import Measurement, Observation, spaced_steps
from msg_analysis.inference.question import Finding, Search, Statistics
from msg_analysis.inference.questions import causes_of, decide
from msg_analysis.inference.realtime_laws import Laws, means_in_lockstep, measure_laws
from msg_analysis.inference.received_values import errors_have_digits
from msg_analysis.inference.residuals import BroadcastSums, ResidualSums
from msg_analysis.inference.statistics import batch_interval, steps_to_half_width
from msg_analysis.inference.time_means import TimeMeans, time_means
from msg_analysis.inference.timing import Timing, measure_timing
from msg_analysis.model.run import Run
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring
from msg_analysis.theory.prediction import Prediction, predict_run

ANALYSES = 20, 80  # at the evidence over time, in short and in long runs: each takes as long as some hundred steps
STEPS_PER_ANALYSIS = 100  # between these
DECIDED_ANALYSES = 400  # where the evidence has decided when the run ended, and so decides the verdict


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Sums over the steps of runs; those of several runs of one experiment are added up."""

    steps: int
    means: TimeMeans  # time means, and their expectation over all paths of the graphs; in real time: given the log
    decisive: bool  # whether the law that the means are compared with is exact
    given: TimeMeans | None  # with their expectation given the path; None where it is not computed
    residuals: ResidualSums
    transitions: Transitions | None  # None where there is a schedule
    loss: LossTally | None  # None without loss
    broadcast: BroadcastSums | None  # None without broadcast noise
    watched: WatchedEvidence  # what holds at any time
    exact: tuple[Mapping[str, Finding], ...]  # of each run, see ``exact_findings``
    timing: Timing | None = None  # of one run in real time
    laws: Laws | None = None  # of one run in real time

    @property
    def tested(self) -> TimeMeans | None:
        """The errors next to the exact law that they are tested against; None where there is none."""
        # Given the path holds for every run, over all paths needs long runs; but with the errors of the agents first.
        laws = [self.given, self.means if self.means.long_enough else None] if self.decisive else []
        known = [law for law in laws if law]
        return next((law for law in known if len(law.nodes)), known[0] if known else None)

    @classmethod
    def of(cls, observation: Observation, level: float, *, decided: bool = False) -> Evidence:
        """Of one run, which ended when its evidence ``decided``; in real time, laws are tested at ``level``."""
        usual = int(np.clip(observation.steps // STEPS_PER_ANALYSIS, *ANALYSES))
        analyses = spaced_steps(observation.steps, DECIDED_ANALYSES if decided else usual)
        laws, timing, position, given = None, None, None, None
        watched = WatchedEvidence(observation, analyses)
        with blas_threads(observation.step.agents):
            if observation.timers:
                timing, order = measure_timing(observation), order_events(observation)
                position = order.position
                means, laws = measure_laws(observation, order, timing, level)
            else:
                chain = None if observation.prediction.path else time_means(observation)
                kept = observation.prediction.system.readout is not None
                given = means_in_lockstep(observation) if kept else means_given_path(observation)
                means = chain or given or time_means(observation)
                given = given if chain else None
            residuals = ResidualSums(observation, position, watched)
        return cls(
            steps=observation.steps,
            means=means,
            decisive=(laws is None or laws.measured_against == "pattern")
            and errors_have_digits(observation.prediction),
            given=given,
            residuals=residuals,
            transitions=_transitions(observation.step, observation.modes),
            loss=LossTally.of(observation),
            broadcast=BroadcastSums.of(observation),
            watched=watched,
            exact=(
                exact_findings(
                    observation.step,
                    observation.states[0],
                    observation.start,
                    observation.wrong_stamp,
                    observation.modes,
                ),
            ),
            timing=timing,
            laws=laws,
        )

    def merged(self, other: Evidence) -> Evidence:
        """The evidence of these and other runs of the same experiment; the sums of ``self`` are changed in place."""
        self.residuals.merge(other.residuals)
        self.watched.merge(other.watched)
        if self.loss and other.loss:
            self.loss.merge(other.loss)
        if self.broadcast and other.broadcast:
            self.broadcast.merge(other.broadcast)
        given = None
        if self.given and other.given:
            given = _merged_means(self.given, self.steps, other.given, other.steps)
        return replace(
            self,
            steps=self.steps + other.steps,
            means=_merged_means(self.means, self.steps, other.means, other.steps),
            decisive=self.decisive and other.decisive,
            given=given,
            transitions=self.transitions and other.transitions and self.transitions.merged(other.transitions),
            exact=self.exact + other.exact,
            timing=None,
            laws=None,
        )


def _merged_means(one: TimeMeans, steps: int, other: TimeMeans, more: int) -> TimeMeans:
    # So every step, and every martingale increment, counts the same.
    a, b = steps / (steps + more), more / (steps + more)
    if one.joint != other.joint or len(one.nodes) != len(other.nodes):
        one, other = _coarser(one, other), _coarser(other, one)
    return replace(
        one,
        second_moments=a * one.second_moments + b * other.second_moments,
        expected_moments=a * one.expected_moments + b * other.expected_moments,
        measured=a * one.measured + b * other.measured,
        predicted=a * one.predicted + b * other.predicted,
        covariance=a**2 * one.covariance + b**2 * other.covariance,
        system_series=np.concatenate([one.system_series, other.system_series]),
        system_variances=np.concatenate([one.system_variances, other.system_variances]),
        switches=one.switches + other.switches,
    )


def _coarser(means: TimeMeans, other: TimeMeans) -> TimeMeans:
    """Reduced to what both have: the node errors, or only the system error."""
    combinations = means.nodes if len(means.nodes) and len(other.nodes) else means.trace[None]
    count = len(combinations)
    return replace(
        means,
        joint=False,
        measured=combinations @ means.measured,
        predicted=combinations @ means.predicted,
        covariance=combinations @ means.covariance @ combinations.T,
        nodes=np.eye(count) if count > 1 else np.empty((0, 1)),
        trace=np.ones(count),
    )


MIN_STEPS = 100  # fewest steps of an incomplete run for which numbers are given


def compare_run(
    trajectory: Run, *, level: float = 0.01, max_missed: float = MAX_MISSED, block_numbers: int = BLOCK_NUMBERS
) -> Comparison:
    """Compare a run, or its complete beginning, with what theory predicts for it, see ``pool.compare``."""
    unpredicted = unpredictable(trajectory.record.experiment)
    if unpredicted:
        return _measured(trajectory, level, unpredicted, block_numbers)
    prediction = predict_run(trajectory.record.experiment, trajectory.record.step_model)
    if trajectory.prefix < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    observation = Observation.of(trajectory, prediction, block_numbers)
    if observation.steps < MIN_STEPS and not trajectory.completeness.complete:
        return without_numbers(trajectory, level, prediction, max(trajectory.prefix, 0))
    until = trajectory.record.until
    decided = until is not None and until.decided
    evidence = Evidence.of(observation, level, decided=decided)
    return replace(evaluate(trajectory, prediction, evidence, level), max_missed=max_missed)


def evaluate(
    trajectory: Run, prediction: Prediction, evidence: Evidence, level: float, p_alike: float | None = None
) -> Comparison:
    """The verdict on the evidence of one run, or of several, of which ``trajectory`` has the completeness."""
    means, lockstep = evidence.means, prediction.experiment.run.pace == "lockstep"
    system_error, node_errors = estimates(means, prediction.system)
    if not means.long_enough:  # too short for standard errors over all paths of the graphs
        system_error, node_errors = system_error.without_error(), [node.without_error() for node in node_errors]
    covariance = covariance_test(means, prediction.system)
    if evidence.given:  # tested given the path
        tested = covariance_test(evidence.given, prediction.system)
        covariance = replace(tested, measured=covariance.measured, predicted=covariance.predicted)
    law = evidence.tested
    tested_error, tested_nodes = estimates(law, prediction.system) if law else (None, [])
    switching = evidence.transitions.test(prediction.step.transition) if evidence.transitions else None
    loss = evidence.loss.test() if evidence.loss else None
    run = Statistics(
        system_error=tested_error,
        node_errors=tested_nodes,
        corrected=", corrected" if law and law is evidence.given else "",
        p_covariance=covariance.p if evidence.decisive else None,
        residuals=evidence.residuals.tests(),
        p_switching=switching.p if switching else None,
        p_loss=loss.p if loss else None,
        p_broadcast=evidence.broadcast.p_value() if evidence.broadcast else None,
        findings=evidence.watched.sums.findings() | of_runs(evidence.exact),
        p_alike=p_alike,
    )
    families = evidence.watched.sums.families()
    logarithms = {name: float(log_mean(logs.reshape(-1))) for name, logs in families.items()}
    tests = decide(run, level, logarithms)
    rejected = [test.name for test in tests if test.rejected]
    causes: list[Cause] = []
    if rejected and trajectory.completeness.complete:
        causes = causes_of(Search(prediction.experiment, evidence, run.findings, level), rejected)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=evidence.steps,
        system_error=system_error,
        node_errors=node_errors,
        covariance=covariance,
        innovations=run.residuals,
        switching=switching,
        continuous_error=prediction.continuous.system_error if prediction.continuous_moments else None,
        batch=batch_interval(means.system_series),
        tests=tests,
        running=_running(
            means.system_series, means.system_variances if means.long_enough else None, prediction.step.dt
        ),
        loss=loss,
        p_broadcast=run.p_broadcast,
        timing=evidence.timing,
        laws=evidence.laws,
        given=GivenPath(means, evidence.given) if evidence.given else None,
        order=rank_agents(means, level) if means.long_enough else None,
        causes=causes,
        any_time=_any_time(trajectory.record, prediction, evidence, level, families),
        trust=few_digits(prediction)
        or (trusted(prediction, means, given=evidence.given is not None) if lockstep else None),
        power=run_power(prediction, evidence.watched.sums, evidence.steps, level, tested_error),
    )


def _transitions(step: Wiring, modes: IntArray) -> Transitions | None:
    """Those of a chain; None where there is a schedule."""
    return None if isinstance(step.switching, Schedule) else Transitions.of(modes, step.modes)


def _any_time(
    record: RunRecord, prediction: Prediction, evidence: Evidence, level: float, families: dict[str, FloatArray]
) -> AnyTimeEvidence:
    """The interval is tuned by what was known before the run, whatever step it ended at."""
    means = evidence.means
    variance = float(means.system_variances.sum()) if means.long_enough else None
    planned, error = float(record.planned_steps), evidence.watched.sums.error
    if record.until and error is not None:
        wanted = record.until.precision * prediction.emulated.system_error
        planned = min(planned, steps_to_half_width(error.variance, wanted))
    return any_time_evidence(evidence.watched, level, families, variance, evidence.steps, planned)


def _measured(trajectory: Run, level: float, unpredicted: str, block_numbers: int) -> Comparison:
    """Comparison without a prediction."""
    measurement = Measurement.of(trajectory, block_numbers)
    series, covariance, step = measurement.system_series, measurement.covariance, measurement.step
    if measurement.steps < MIN_STEPS and not trajectory.completeness.complete:
        return Comparison(
            trajectory=trajectory,
            level=level,
            steps=measurement.steps,
            system_error=Estimate(),
            node_errors=[Estimate()] * step.agents,
            covariance=CovarianceTest(note="there is no prediction"),
            running=_running(np.empty(0), None, step.dt),
            unpredicted=unpredicted,
        )
    sampled = sampled_beside(trajectory.record.experiment)
    transitions, loss = _transitions(step, measurement.modes), loss_test(measurement)
    switching = transitions.test(step.transition) if transitions else None
    start, wrong_stamp = trajectory.record.start, trajectory.wrong_stamp
    exact = exact_findings(step, trajectory.states[0], start, wrong_stamp, measurement.modes)
    return Comparison(
        trajectory=trajectory,
        level=level,
        steps=measurement.steps,
        system_error=Estimate(float(np.trace(covariance)), sampled.system_error if sampled else None),
        node_errors=beside_sampled(np.diag(covariance), sampled.node_errors if sampled else None),
        covariance=CovarianceTest(measured=covariance, note="there is no prediction"),
        switching=switching,
        batch=batch_interval(series),
        tests=decide(
            Statistics(p_switching=switching.p if switching else None, p_loss=loss.p if loss else None, findings=exact),
            level,
        ),
        running=_running(series, None, step.dt, measurement.first),
        loss=loss,
        unpredicted=unpredicted,
        sampled=sampled,
        transient=measurement.first,
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
        continuous_error=prediction.continuous.system_error if prediction.continuous_moments else None,
        running=_running(np.empty(0), None, prediction.step.dt),
    )


def _running(series: FloatArray, variances: FloatArray | None, dt: float, first: int = 0) -> dict[str, FloatArray]:
    """Mean of the system error up to some steps, denser at the beginning, and its standard error."""
    counts = spaced_steps(len(series)) if len(series) else np.empty(0, np.int64)
    return {
        "time": np.asarray((first + counts) * dt, dtype=float),
        "system_error": np.cumsum(series)[counts - 1] / counts,
        "standard_error": np.zeros(len(counts))
        if variances is None
        else np.sqrt(np.cumsum(variances)[counts - 1]) / counts,
    }
