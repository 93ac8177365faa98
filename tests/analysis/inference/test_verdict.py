"""What a verdict is made of: runs without a prediction, that end early, in real time, and means of several runs."""

import dataclasses

import numpy as np
import pytest
from scipy import special
from tests.support.watched_run import sums_of

from experiments import (
    CORRELATED,
    Experiment,
    Run,
    compare,
    cut,
    directed,
    line_ring,
    observed,
    pieces,
    predict,
    simulate,
)
from msg_analysis.inference import verdict
from msg_analysis.inference.event_order import order_events
from msg_analysis.inference.given_path import means_given_path
from msg_analysis.inference.observation import spaced_steps
from msg_analysis.inference.residuals import ResidualSums
from msg_analysis.inference.statistics import simultaneous_half_width, steps_to_half_width
from msg_analysis.inference.system_error import ErrorMartingale
from msg_analysis.model.run_record import Until


@pytest.fixture(scope="module")
def unpredicted() -> Run:
    saturated = "ros_ws/src/msg_agents_example_protocols/experiments/saturated.yaml"
    return simulate(Experiment.load(saturated).with_run(duration=30, replicas=2))


def test_without_a_prediction(unpredicted: Run) -> None:
    """Errors after the transient, whose end they say, and tests of graphs only."""
    found, steps = compare(unpredicted), len(unpredicted.modes)
    assert (found.verdict, found.steps, bool(found.unpredicted)) == ("unpredicted", steps, True)
    values = unpredicted.values[found.transient : steps]
    values = values - values.mean(axis=1, keepdims=True)
    squares = (values**2).mean(axis=2)
    assert [node.measured for node in found.node_errors] == pytest.approx(squares.mean(axis=0))
    assert found.system_error.measured == pytest.approx(squares.sum(axis=1).mean())
    last = [found.running[key][-1] for key in ("time", "system_error")]
    assert last == pytest.approx([steps * unpredicted.experiment.step_length, found.system_error.measured])
    assert (found.running["standard_error"].any(), found.batch is None) == (False, False)
    assert [test.name for test in found.tests] == ["switching"]


@pytest.mark.parametrize(("step", "enough"), [(50, False), (100, False), (101, True), (180, True)])
def test_a_part_of_a_run_without_a_prediction(unpredicted: Run, step: int, enough: bool) -> None:
    """100 steps are enough; fewer give no numbers."""
    found = compare(cut(unpredicted, step))
    assert (found.verdict, found.steps) == ("incomplete", step - 1)
    assert len(found.node_errors) == unpredicted.states.shape[1]
    assert (found.system_error.measured is not None) == enough
    assert (found.switching is not None) == (len(found.running["time"]) > 0) == enough


def ending(run: Run, until: Until) -> Run:
    return dataclasses.replace(run, record=dataclasses.replace(run.record, until=until))


def test_a_run_that_was_to_end_early() -> None:
    """When its evidence decides, that is looked at more often; for a precision, the interval is tuned for it."""
    run = simulate(line_ring(run={"duration": 410, "replicas": 1}))
    plain, decided = compare(run), compare(ending(run, Until.parse("decided")))
    assert plain.any_time.time == pytest.approx(spaced_steps(8200, 80) * 0.05)
    assert decided.any_time.time == pytest.approx(spaced_steps(8200, 400) * 0.05)
    prediction, until = predict(run.record.experiment), Until(0.2)
    variance = ErrorMartingale(prediction, 1).variance
    wanted = steps_to_half_width(variance, 0.2 * prediction.emulated.system_error)
    assert wanted < 8200
    total = (plain.running["standard_error"][-1] * 8200) ** 2
    for found, planned in ((plain, 8200), (compare(ending(run, until)), wanted)):
        half_width = float(simultaneous_half_width(total, variance * planned)) / 8200
        assert found.any_time.half_width == pytest.approx(half_width)


def test_shorter_runs_are_looked_at_less_often() -> None:
    longer = compare(simulate(line_ring(run={"duration": 250, "replicas": 1})))
    assert longer.any_time.time == pytest.approx(spaced_steps(5000, 50) * 0.05)
    run = simulate(line_ring())
    found = compare(run)
    assert (found.verdict, found.causes) == ("agrees", [])
    assert compare(cut(run, 101)).system_error.measured is not None  # of 100 steps
    assert found.any_time.time == pytest.approx(spaced_steps(400, 20) * 0.05)
    families = sums_of(observed(run), in_detail=True).families()
    for test in found.tests:
        logs = families.get(test.name)
        expected = None if logs is None else pytest.approx(special.logsumexp(logs) - np.log(logs.size), abs=1e-9)
        assert test.log_evidence == expected or test.name.startswith("system error")


def test_in_real_time() -> None:
    """Errors given the log are not corrected; residuals are taken in the order in which the states were made."""
    run = simulate(directed(noise={"process": CORRELATED}, run={"pace": "realtime", "duration": 20}))
    found, observation = compare(run), observed(run)
    names = [test.name for test in found.tests]
    assert names[:5] == ["system error", *(f"error of agent {i}" for i in (1, 2, 3)), "covariance"]
    assert (found.laws.measured_against, found.trust) == ("pattern", None)
    sums = ResidualSums(observation, order_events(observation).position)
    assert found.innovations.p_gain == pytest.approx(sums.tests().p_gain, rel=1e-9)


def test_means_of_runs_that_were_computed_in_different_detail() -> None:
    """What both have is left; every step counts the same, and so do the expectations."""
    observation = observed(pieces())
    steps, d = observation.steps, 3
    joint = means_given_path(observation)
    nodes, system = (means_given_path(observation, most_work=steps * d**2 * (q**2 + 5 * q * d)) for q in (3, 1))
    assert (joint.joint, len(nodes.nodes), len(system.nodes)) == (True, 3, 0)
    for one, other, left in ((joint, joint, 3), (joint, nodes, 3), (nodes, joint, 3), (nodes, system, 0)):
        other = dataclasses.replace(other, measured=2.0 * other.measured, expected_moments=3.0 * other.expected_moments)
        merged = verdict._merged_means(one, 100, other, 300)
        assert (merged.joint, len(merged.nodes)) == (one is other or (one.joint and other.joint), left)
        measured = [means.trace @ means.measured for means in (one, other, merged)]
        assert measured[2] == pytest.approx(0.25 * measured[0] + 0.75 * measured[1])
        variance = [means.trace @ means.covariance @ means.trace for means in (one, other, merged)]
        assert variance[2] == pytest.approx(0.25**2 * variance[0] + 0.75**2 * variance[1])
        assert merged.expected_moments == pytest.approx(2.5 * one.expected_moments)
        assert merged.second_moments == pytest.approx(0.25 * one.second_moments + 0.75 * other.second_moments)
        each = [means.nodes @ means.measured for means in (one, other, merged)]
        assert each[2][:left] == pytest.approx(0.25 * each[0][:left] + 0.75 * each[1][:left])
