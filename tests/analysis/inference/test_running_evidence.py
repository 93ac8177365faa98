"""Evidence and intervals of a running network: against the sums over the whole run, and how often they miss."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments import Experiment, Observation, Run, compare, five, new_record, predict, simulate
from msg_analysis.inference.estimates import Estimate
from msg_analysis.inference.evidence_sums import EvidenceSums
from msg_analysis.inference.online_errors import (
    LiveEstimate,
    LiveReport,
    RunningErrors,
    RunningInterval,
    precision_words,
    reached,
)
from msg_analysis.inference.online_evidence import AnyTime, ReceivedEvidence, RunningEvidence, supports
from msg_analysis.inference.statistics import RunningBatches, simultaneous_half_width, steps_to_half_width
from msg_analysis.inference.system_error import ErrorMartingale
from msg_analysis.model.run_record import Until


def two_replicas(**changes: Any) -> Experiment:
    return five(run={"replicas": 2} | changes.pop("run", {}), **changes)


def ending(law: Experiment, precision: float) -> Run:
    """A run of the twin that was to end at this precision."""
    run = simulate(law)
    return replace(run, record=replace(run.record, until=Until(precision)))


@pytest.mark.parametrize("pieces", [1, 7, 300])
@pytest.mark.parametrize("missing", [False, True])
def test_is_the_sum_over_the_whole_run(pieces: int, missing: bool) -> None:
    run, prediction = simulate(two_replicas()), predict(two_replicas())
    seen = RunningEvidence(prediction, 2)
    gaps = [0, 700, 701, 1500] if missing else [0]  # steps that were not seen
    for steps in np.array_split(np.delete(np.arange(1, 2000), gaps), pieces):
        steps = steps[::-1]  # in any order within a piece
        seen.add(steps, run.modes[steps], run.states[steps], run.states[steps + 1])
    expected = EvidenceSums(prediction, 2)
    # The arrays without the places 0, 700, 701 and 1500 of the steps from 1 on.
    stretches = [(2, 701), (703, 1501), (1502, 2000)] if missing else [(2, 2000)]
    # The graph after a step is needed, but not after the last step of the run.
    for first, end in stretches:
        part = Observation(prediction, run.states[first : end + 1], run.modes[first:end], run.states[first])
        expected.add(part, 0, end - first - (end < 2000))
    assert seen.sums.total.counts.tolist() == expected.total.counts.tolist()
    assert seen.report(None).log_evidence == pytest.approx(expected.evidence(), abs=1e-9)


def test_what_the_states_alone_do_not_give() -> None:
    for changes in ({"noise": {"loss": 0.1}}, {"noise": {"delay": 1}}, {"run": {"pace": "realtime"}}):
        prediction = predict(two_replicas(**changes))
        assert supports(prediction)
        assert not supports(prediction, most_bytes=100)
        with pytest.raises(ValueError, match="do not give the evidence"):
            RunningEvidence(prediction, 2)
    with pytest.raises(ValueError, match="the states alone give the evidence"):
        ReceivedEvidence(predict(two_replicas()), 2)


@pytest.mark.parametrize("changes", [{}, {"noise": {"loss": 0.1}}], ids=["plain", "loss"])
def test_errors_without_evidence(changes: dict[str, Any]) -> None:
    live = LiveEstimate(new_record(two_replicas(**changes)), evidence=False)
    assert (live.evidence, live.log, live.report().any_time.log_evidence) == (None, None, None)


def test_the_last_step_of_a_run_that_ends_early() -> None:
    """As in the comparison of the shorter run."""
    run, prediction = simulate(two_replicas()), predict(two_replicas())
    seen, expected = RunningEvidence(prediction, 2), EvidenceSums(prediction, 2)
    for steps in np.array_split(np.arange(1500), 7):
        seen.add(steps, run.modes[steps], run.states[steps], run.states[steps + 1])
    seen.end_at(1500)
    later = np.arange(1500, 1600)
    seen.add(later, run.modes[later], run.states[later], run.states[later + 1])
    expected.add(Observation(prediction, run.states[:1501], run.modes[:1500], run.states[0]), 0, 1500)
    assert (seen.count, seen.report(None).log_evidence) == (1500, pytest.approx(expected.evidence(), abs=1e-9))


def test_the_interval_is_that_of_the_comparison() -> None:
    run = ending(two_replicas(duration=400), 0.1)
    live = LiveEstimate(run.record)
    live.add_whole(np.arange(8000), run.modes, run.states[:-1], run.states[1:])
    assert live.report().any_time.half_width == pytest.approx(compare(run).any_time.half_width, rel=1e-9)


def test_intervals_hold_at_all_times() -> None:
    """Of 40 runs, looked at every 50 steps, at most 5 ever miss: more do with probability 0.014 at a level of 5 %."""
    prediction, missed = predict(two_replicas()), 0
    variance = ErrorMartingale(prediction, 2).variance
    for seed in range(40):
        run = ending(two_replicas(seed=seed), 0.2)
        errors = RunningErrors(run.record, prediction, nodes=False)
        interval = RunningInterval(run.record, prediction, variance)
        for steps in np.array_split(np.arange(2000), 40):
            interval.add(errors.add(steps, run.modes[steps], run.states[steps], run.states[steps + 1]))
            system, _ = errors.estimates()
            half = interval.half_width(system, errors.count)
            if half is not None and abs(system.measured - system.predicted) > half:
                missed += 1
                break
    assert missed <= 5


def test_running_batches() -> None:
    """Against numpy on batches of the length that they then have; independent values have their own variance."""
    series = np.random.default_rng(3).standard_normal(5000) + 2.0
    batches = RunningBatches()
    assert batches.variance() is None
    for part in np.array_split(series, 37):
        batches.add(part)
    length = 128  # 5000 / 64 < 128
    means = series[: 5000 // length * length].reshape(-1, length).mean(axis=1)
    assert batches.count == 5000
    assert batches.variance() == pytest.approx(means.var(ddof=1) * length * 5000)
    assert batches.variance() == pytest.approx(5000, rel=0.5)


def test_steps_to_half_width() -> None:
    """The interval that is tuned for so many steps is then as narrow as wanted."""
    steps = steps_to_half_width(3.0, 0.02)
    assert simultaneous_half_width(3.0 * steps, 3.0 * steps) / steps == pytest.approx(0.02)
    assert steps_to_half_width(3.0, 0.0) == np.inf


def report(half_width: float | None, crossed: int | None = None, steps: int = 1000) -> LiveReport:
    seen = AnyTime(half_width, 0.0, crossed=crossed)
    return LiveReport(0, steps - 1, steps, steps, Estimate(2.0, 2.0, 0.1), [], None, any_time=seen)


def test_when_a_run_may_end() -> None:
    assert reached(Until(0.05), report(0.11)) is None
    assert reached(Until(0.05), report(None)) is None
    assert reached(Until(0.05), report(0.1)) == "precision 5 % reached at step 1000"
    assert reached(Until(0.05), report(0.1, steps=99)) is None  # too early
    assert reached(Until(0.05), report(0.11, crossed=800)) is None
    words = reached(Until.parse("decided"), report(0.11, crossed=800))
    assert words == "evidence against the prediction passed 100 at step 1000"
    assert precision_words(report(0.11)) == "precision 5.5 % at step 1000"
    assert precision_words(report(None)) == "the precision is not known"
