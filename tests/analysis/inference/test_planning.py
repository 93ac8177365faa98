"""Plans of runs: lengths, replicas and power against formulas written out, scipy.stats, and sums over runs."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import scipy.stats
from report_texts import without_figures
from tests.support.watched_run import sums_of

import experiments
from experiments import compare, observed, predict, simulate
from msg_analysis import Experiment, InputError, NotAvailableError
from msg_analysis.common.text import percent
from msg_analysis.inference.evidence_sums import EvidenceSums
from msg_analysis.inference.fault_power import Fault, FaultPower, StepInformation, fault_powers, run_power
from msg_analysis.inference.sample_size import REPLICAS
from msg_analysis.inference.statistics import simultaneous_half_width
from msg_analysis.report.comparison_text import power_words
from msg_analysis.report.page import render

ONE_GRAPH = Experiment.parse({"name": "one", "graphs": {"ring": {"cycle": [1, 2, 3]}}, "run": {"duration": 10}})


def line_ring(**run: Any) -> Experiment:
    return Experiment.load("line_ring").with_run(**run)


@pytest.mark.parametrize(("dof", "noncentrality"), [(1, 3.0), (15, 24.2), (200, 90.0)])
def test_power_is_noncentral_chi_square(dof: int, noncentrality: float) -> None:
    found = FaultPower(Fault("noise", 2.0), 0, None, [StepInformation("noise", dof, noncentrality / 7)], 0.001, 1.0)
    expected = scipy.stats.ncx2.sf(scipy.stats.chi2.isf(0.001, dof), dof, noncentrality)
    assert found.power(7) == pytest.approx(expected, rel=1e-6)
    assert found.steps(expected) == pytest.approx(7, rel=1e-6)


def test_lengths_are_those_of_the_formulas() -> None:
    plan = line_ring().plan(0.02)
    error, variance = plan.precision.error, plan.precision.variance
    assert error == pytest.approx(predict(line_ring()).emulated.system_error)
    for row in plan.to_json()["lengths"]:
        scatter = (variance.path + variance.replica / row["replicas"]) / error**2
        assert row["steps"] == math.ceil((1.959963984540054 / 0.02) ** 2 * scatter)
        steps = row["any_time_steps"]
        half_width = simultaneous_half_width(scatter * steps, scatter * steps) / steps
        assert half_width == pytest.approx(0.02, rel=1e-3)
        assert half_width <= 0.02
        assert row["duration"] == pytest.approx(row["steps"] * 0.05)
    shown = plan.to_json()["file"]
    assert shown["half_width"] == pytest.approx(1.96 * math.sqrt(variance.of(16) / 8000) / error, rel=1e-4)
    assert plan.precision.steps(shown["half_width"], 16) in (8000, 8001)


def test_the_interval_of_a_run_is_the_planned_one() -> None:
    """The standard error that a run itself states, and its interval for all times."""
    experiment = line_ring(duration=1000, replicas=4)
    plan, found = experiment.plan(), compare(simulate(experiment))
    measured = found.system_error.standard_error / plan.precision.error
    assert measured == pytest.approx(plan.precision.standard_error(found.steps, 4), rel=0.05)
    planned = plan.to_json()["file"]["any_time_half_width"] * plan.precision.error
    assert found.any_time.half_width == pytest.approx(planned, rel=0.05)


def test_best_replicas() -> None:
    """Where the graphs decide the scatter, few; where there is but one graph, as many as are considered."""
    precision = line_ring().plan().precision
    best = precision.best_replicas(10_000)
    assert 1 < best < REPLICAS[-1]
    infinite = math.sqrt(precision.variance.path / 10_000) / precision.error
    assert precision.standard_error(10_000, best) < 1.06 * infinite
    assert precision.standard_error(10_000, best / 2) > 1.05 * precision.standard_error(10_000, REPLICAS[-1])
    assert ONE_GRAPH.plan().precision.best_replicas(10_000) == REPLICAS[-1]


def test_a_budget() -> None:
    found = line_ring().plan(seconds=60.0, rate=1000.0).to_json()
    numbers = [found["budget"]["steps"], found["budget"]["wall_time"], found["file"]["wall_time"]]
    assert numbers == [60_000, 60.0, 8.0]
    found = Experiment.load("line_ring_realtime").plan(seconds=60.0).to_json()
    numbers = [found["rate"], found["budget"]["steps"], found["file"]["wall_time"]]
    assert numbers == pytest.approx([100.0, 6000, 80.0])
    assert found["file"]["any_time_half_width"] is None


def test_the_start_costs_steps() -> None:
    """Until the expected error is within the precision; no run is shorter."""
    experiment = line_ring(start="zero")
    plan, stationary = experiment.plan(0.02), line_ring().plan(0.02)
    times = np.arange(0.0, 20.0, 0.05)
    course = experiment.transient(times).system_error
    outside = np.flatnonzero(np.abs(course - plan.precision.error) > 0.02 * plan.precision.error)
    assert plan.precision.warm_up == outside[-1] + 1
    assert plan.precision.steps(0.02, 4) == plan.precision.warm_up + stationary.precision.steps(0.02, 4)
    assert plan.precision.standard_error(10, 4) == math.inf
    assert plan.to_json()["warm_up"] == plan.precision.warm_up


def powers(experiment: Experiment, *faults: Fault) -> list[FaultPower]:
    return fault_powers(predict(experiment), experiment.run.replicas, 0.01, faults)


def test_noise_is_the_divergence_of_normal_laws() -> None:
    (found,) = powers(line_ring(replicas=3), Fault("noise", 1.1))
    assert found.tests == [StepInformation("residuals: covariance", 15, pytest.approx(3 * (0.1 - math.log(1.1))))]
    x = scipy.stats.chi2.isf(0.01 / 21, 15)
    assert found.level == pytest.approx(0.01 / 21)
    assert found.power(5000) == pytest.approx(scipy.stats.ncx2.sf(x, 15, 15000 * (0.1 - math.log(1.1))), rel=1e-6)
    assert found.power(found.steps()) == pytest.approx(0.99, abs=1e-6)
    assert found.power(found.steps(0.5)) == pytest.approx(0.5, abs=1e-6)


def test_noise_that_agents_share_has_that_divergence_too() -> None:
    """Against the eigenvalues of the whole change of a covariance with correlations."""
    gain = np.array([[1.0, 0.4, 0.0], [0.0, 0.5, 0.2], [0.3, 0.0, 0.8]])
    experiment = experiments.line_ring(noise={"process": gain.tolist()})
    (found,) = powers(experiment, Fault("noise", 1.5, 1))
    wrong = np.diag([1.0, math.sqrt(1.5), 1.0]) @ gain
    values = scipy.linalg.eigvalsh(wrong @ wrong.T, gain @ gain.T) - 1.0
    divergence = float((values - np.log1p(values)).sum())
    assert found.tests[0].noncentrality == pytest.approx(experiment.run.replicas * divergence)


@pytest.mark.parametrize("duration", [1.0, 100.0])
def test_a_run_that_agrees_says_what_it_could_have_found(duration: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 steps, and 2000: the interval of the table, and the power that the plan of this run has."""
    run = simulate(line_ring(duration=duration))
    document = compare(run).to_json()
    power, tested = document["power"], document["given_path"]["system_error"]
    assert document["verdict"] == "agrees"
    assert power["half_width"] == pytest.approx(np.diff(tested["interval"])[0] / 2 / tested["predicted"], rel=1e-3)
    planned = next(row for row in line_ring(duration=duration).plan().to_json()["faults"] if row["factor"] == 1.1)
    assert [power[key] for key in ("kind", "agent", "power")] == [planned[key] for key in ("kind", "agent", "power")]
    words = (
        f"The system error is known to ± {percent(power['half_width'])} (95 %); a noise variance of one agent 10 % too "
        f"large would be found with probability {percent(power['power'])}."
    )
    assert power_words(document) == [words]
    assert power_words(document | {"verdict": "disagrees"}) == []
    without_figures(monkeypatch)
    assert words in render(compare(run))


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({}, "noise"),
        ({"noise": {"process": 0.0, "link": 0.5}}, "gain"),
        ({"noise": {"process": 0.0}, "run": {"dt": 0.1, "duration": 40, "start": [1.0, 0.0, 2.0]}}, "switching"),
        ({"run": {"dt": 0.1, "duration": 40, "pace": "realtime"}}, "noise"),
    ],
)
def test_the_fault_is_one_that_the_law_can_have(changes: dict[str, Any], kind: str) -> None:
    prediction = predict(experiments.line_ring(**changes))
    found = run_power(prediction, EvidenceSums(prediction, 1, in_detail=True), 100, 0.01, None)
    assert found.to_json()["kind"] == kind
    assert found.half_width is None


def test_gains_have_the_information_of_a_run() -> None:
    """Of every link: the sum of the squared regressors of a run, over the variance of the noise."""
    experiment = line_ring(duration=4000, replicas=4)
    run = observed(experiment)
    sums = sums_of(run)
    (found,) = powers(experiment, Fault("gain", 0.5))
    assert (found.agent, found.sender) in {(0, 4), (4, 0)}  # only the ring has this link
    by_name = {test.name: test for test in found.tests}
    measured = sums.total.link_information[0, 0, 4] + sums.total.link_information[0, 4, 0]
    assert run.steps * by_name["residuals: gains"].noncentrality == pytest.approx(0.125 * measured, rel=0.05)
    assert by_name["residuals: gains"].dof == 5 + 8 + 10
    x, ring = run.states[:-1], run.modes == 1
    line = 0.05 * (x[:, :-1] - x[:, 1:])
    pulls = np.zeros_like(x)
    pulls[:, 1:] += line
    pulls[:, :-1] -= line
    closing = 0.05 * (x[:, 4] - x[:, 0]) * ring[:, None]
    pulls[:, 0] += closing
    pulls[:, 4] -= closing
    shift = 0.5 * (closing * pulls[:, 0]).sum()
    expected = shift**2 / (pulls**2).sum() / 0.05
    assert run.steps * by_name["residuals: common gain"].noncentrality == pytest.approx(expected, rel=0.05)


def test_rates_have_the_divergence_of_the_chains() -> None:
    (found,) = powers(line_ring(), Fault("switching", 1.4))
    leaving, wrong = (0.5 * (1.0 - math.exp(-2.0 * 0.5 * factor * 0.05)) for factor in (1.0, 1.4))
    divergence = wrong * math.log(wrong / leaving) + (1.0 - wrong) * math.log((1.0 - wrong) / (1.0 - leaving))
    assert found.tests == [StepInformation("switching", 2, pytest.approx(2.0 * divergence))]


def test_power_is_that_of_runs() -> None:
    """Noise variance x 1.05 in 20,000 steps: 50 of 100 twin runs were rejected by a family of 12 tests."""
    (found,) = powers(line_ring(replicas=1), Fault("noise", 1.05))
    assert dataclasses.replace(found, level=0.01 / 12).power(20_000) == pytest.approx(0.5, abs=0.05)


def test_faults_that_a_law_cannot_have() -> None:
    assert [row["kind"] for row in ONE_GRAPH.plan().to_json()["faults"]] == ["noise", "noise", "gain", "gain"]
    fast = experiments.line_ring(time="discrete", switching={"transition": [[0.2, 0.8], [0.8, 0.2]]})
    assert [row["factor"] for row in fast.plan().to_json()["faults"] if row["kind"] == "switching"] == [0.7]


def test_notes() -> None:
    large = experiments.line_ring(30, run={"dt": 0.1, "duration": 40, "replicas": 16}).plan(0.02).to_json()
    assert large["variance"]["path_followed"] is False
    assert 0.001 < large["sampling_error"] < 0.05
    assert "the network is large, so the scatter of the mean is sampled" in large["notes"][0]


@pytest.mark.parametrize("switches", [8, 12])
def test_plan_and_compare_say_the_same_about_few_switches(switches: int) -> None:
    """Rates of 0.05: each graph is left 0.025 times per unit of time; between 10 and 25 times, too."""
    run = {"dt": 0.05, "duration": 40 * switches, "replicas": 4}
    experiment = experiments.line_ring(5, 0.05, run=run)
    words = f"has few switches (some graph is left {0.998 * switches:.3g} times on average)"
    notes = [note for note in experiment.plan(0.9).to_json()["notes"] if f"a run of {experiment.steps} steps" in note]
    said = [words in text for text in (" ".join(notes), str(compare(simulate(experiment)).trust.words))]
    assert said == [switches < 10] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"precision": 0.0}, "precision: 0: expected a share"),
        ({"precision": math.nan}, "precision: nan: expected a share"),
        ({"level": 0.9}, "level: 0.9: expected a probability"),
        ({"seconds": 10.0}, "budget: a run in lockstep is as fast as the machine"),
        ({"seconds": -1.0, "rate": 1.0}, "budget: -1 s: expected"),
        ({"rate": 0.0}, "speed: 0 steps per second: expected"),
    ],
)
def test_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        line_ring().plan(**options)


def test_refused_too() -> None:
    with pytest.raises(InputError, match="speed: 5 steps per second: in real time these are"):
        Experiment.load("line_ring_realtime").plan(rate=5.0)
    with pytest.raises(InputError, match="the predicted system error is 0"):
        ONE_GRAPH.with_noise(process=0.0).with_run(start="zero").plan()
    with pytest.raises(NotAvailableError):
        Experiment.load("ros_ws/src/msg_agents_example_protocols/experiments/saturated.yaml").plan()
