"""Comparisons of runs in real time, whose agents are late, hear late, and learn late of the graph."""

import dataclasses
import json

import late_timers
import numpy as np
import pytest
from late_timers import busy
from p_values import assert_calibrated

from experiments import CORRELATED, TRACKING, Completeness, changed, compare, directed, observed, predict, simulate
from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, Stream, normals
from msg_analysis.common.text import percent
from msg_analysis.errors import InputError
from msg_analysis.inference.event_order import order_events
from msg_analysis.inference.received_values import ReceivedValues, process_noise
from msg_analysis.inference.regression import Regression
from msg_analysis.inference.residuals import ResidualSums, residuals
from msg_analysis.inference.timing import measure_timing
from msg_analysis.model.step_model import phases


def real_time(noise=None, **run):
    return directed(noise=noise or {"process": 1.0}, run={"pace": "realtime"} | run)


CASES = {
    "consensus": real_time(),
    "correlated": changed(real_time({"process": CORRELATED}), **TRACKING),
    "noise by graph": real_time({"process": {"a": [1.0, 0.5, 2.0], "b": CORRELATED}}),
}
LATENESS = {"late": busy(0.3, 1.5), "slow": busy(0.5, 1.5), "switch": busy(0.8, 2.0)}


def drawn_noise(what, graphs):
    """(N, m, R): row i of B_g v(k), g being the graph that agent i used."""
    shape = (STEPS_PER_BLOCK, what.run.replicas)
    v = [[normals(what.run.seed, Stream.PROCESS, j, block, shape) for block in (0, 1)] for j in range(3)]
    v = np.stack([np.concatenate(blocks)[: len(graphs)] for blocks in v], axis=1)
    gain = np.sqrt(what.run.dt) * what.noise_gain
    return np.einsum("kij,kjr->kir", gain[graphs, np.arange(3)], v)


@pytest.mark.parametrize("case", CASES)
def test_innovations_are_the_noise_that_was_added(case):
    """Exactly, whoever was late, whatever was heard, whichever graph each agent used."""
    what = CASES[case]
    trajectory = late_timers.run(what, **LATENESS)
    graphs = trajectory.agent_modes[1:]
    assert (graphs != trajectory.modes[:, None]).mean() > 0.05
    assert (trajectory.used == -1).any()
    observation = observed(trajectory)
    found = residuals(observation, 0, 400)
    np.testing.assert_allclose(found, drawn_noise(what, graphs), atol=1e-12)
    part = residuals(observation, 120, 130)
    np.testing.assert_array_equal(part, found[120:130])


@pytest.mark.parametrize("case", ["consensus", "correlated"])
def test_timing_does_not_change_what_is_tested_of_the_noise(case):
    """The same noise on time and late: the same p-values, where it is the same in every graph."""
    what = CASES[case]
    runs = [observed(run) for run in (simulate(what), late_timers.run(what, **LATENESS))]
    on_time, late = (ResidualSums(run, order_events(run).position).tests() for run in runs)
    assert late.p_covariance == pytest.approx(on_time.p_covariance)
    assert late.p_whiteness == pytest.approx(on_time.p_whiteness)


def test_regression_frees_innovations_of_those_made_before():
    """Against a loop: within a step, each less its regression on those that were made earlier."""
    what = CASES["noise by graph"]
    observation = observed(late_timers.run(what, **LATENESS))
    position, timers, step = order_events(observation).position, observation.timers, observation.step
    regression = Regression(observation, 400, position)
    for first, last in ((0, 150), (150, 400)):
        reception = ReceivedValues.of(observation, first, last)
        regression.add(reception, residuals(observation, first, last, reception), first)
    e = residuals(observation, 0, 400)
    places = {}
    for g in range(2):
        for i in range(3):
            for j in step.neighbours(g, i).tolist():
                places[g, i, j] = 3 + len(places)
    size = 3 + len(places)
    score, covariance = np.zeros(size), np.zeros((size, size))
    for k in range(400):
        noise = process_noise(step, timers.graphs[k])
        before = []
        for i in np.argsort(position[k]):
            known = np.linalg.lstsq(noise[np.ix_(before, before)], noise[before, i], rcond=None)[0] if before else []
            free = e[k, i] - sum((c * e[k, j] for c, j in zip(known, before, strict=True)), np.zeros(2))
            variance = noise[i, i] - sum(c * noise[i, j] for c, j in zip(known, before, strict=True))
            before.append(i)
            phi = np.zeros((size, 2))
            phi[i] = 1.0
            g = timers.graphs[k, i]
            for d, j in enumerate(step.neighbours(g, i).tolist()):
                s = timers.used[k, i, d]
                phi[places[g, i, j]] = 0.0 if s < 0 else observation.states[s, j] - observation.states[k, i]
            score += phi @ free
            covariance += variance * phi @ phi.T
    np.testing.assert_allclose(regression.statistic()[0], score, atol=1e-9)
    np.testing.assert_allclose(regression.statistic()[1], covariance, atol=1e-9)


IN_DETAIL = [
    f"residuals: {what}"
    for what in (
        "noise by graph",
        "noise over time",
        "constant state",
        "largest",
        "lags to 100",
        "replicas",
        "stale values",
    )
]


@pytest.mark.parametrize("case", ["consensus", "noise by graph"])
def test_calibration(case):
    """25 late runs of 250 steps."""
    laws = [CASES[case].with_run(seed=seed, duration=25) for seed in range(25)]
    results = [compare(late_timers.run(law, timing_seed=seed, **LATENESS)) for seed, law in enumerate(laws)]
    names = ["system error", *(f"error of agent {i}" for i in (1, 2, 3)), "covariance"]
    names += [f"residuals: {what}" for what in ("covariance", "whiteness", "gains", "common gain")]
    # Noise that is correlated may be part of the values that are used: then no test of these.
    detail = IN_DETAIL[:-1] if case == "noise by graph" else IN_DETAIL
    assert [test.name for test in results[0].tests] == [*names, "switching", *detail]
    assert_calibrated(results)


LONG = real_time(duration=400, replicas=16)


def supported(result):
    return [law.supported for law in (result.laws.pattern, result.laws.sequential, result.laws.continuous)]


def test_a_late_machine_is_not_a_wrong_theory():
    """Agents that lose half their time: deadlines are missed, the sequential law fails, the model given the log not."""
    run = late_timers.run(LONG, late=busy(0.5, 6.0), slow=busy(0.5, 3.0))
    result = compare(run)
    assert (result.verdict, result.exit_code, supported(result)) == ("late", 4, [True, False, False])
    assert (compare(run, max_missed=1.0).verdict, compare(run, max_missed=0.2).verdict) == ("agrees", "late")
    assert result.timing.missed_share > 0.3
    assert "of the deadlines were missed" in result.laws.sequential.why
    document = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert (document["law"], document["system_error"]) == ("pattern", document["laws"]["pattern"]["system_error"])
    assert document["timing"]["deadlines"]["share"] == result.timing.missed_share
    said = {"follows_model": True, "prediction": False, "missed": result.timing.missed_share, "max_missed": 0.05}
    assert document["real_time"] == said
    assert set(document["laws"]) == {"pattern", "sequential", "continuous", "why"}


def test_ideal_timers_go_with_the_sequential_law():
    result = compare(simulate(LONG))
    # Steps of 0.1 are seen in a run of this length.
    assert (result.verdict, supported(result)) == ("agrees", [True, True, False])
    assert "as in this log" in result.laws.sequential.why
    assert result.laws.sequential.system_error.predicted == pytest.approx(predict(LONG).emulated.system_error)
    assert result.laws.continuous.system_error.predicted == predict(LONG).continuous.system_error


def other_gain(factor):
    """Agent 2 gives its neighbours this weight, in every graph."""

    def change(model):
        nominal = model.nominal.copy()
        extra = (factor - 1.0) * nominal[:, 1] * [1.0, 0.0, 1.0]
        nominal[:, 1] += extra
        nominal[:, 1, 1] -= extra.sum(axis=1)
        return dataclasses.replace(model, nominal=nominal)

    return change


@pytest.mark.parametrize(
    ("truth", "found_by"),
    [
        (other_gain(0.8), "residuals: gains"),
        (lambda model: dataclasses.replace(model, noise_gain=1.1 * model.noise_gain), "residuals: covariance"),
    ],
)
def test_power_on_a_late_machine(truth, found_by):
    """Runs of a wrong law, 4,000 steps: rejected, and by the test that should."""
    result = compare(late_timers.run(LONG, truth=truth, **LATENESS))
    assert result.verdict == "disagrees"
    assert min(result.tests, key=lambda test: test.p).name == found_by
    assert result.laws.pattern.supported is False
    assert "an agent did not follow its law" in result.laws.pattern.why


def test_what_is_said_to_be_used_but_was_not():
    """Agents that hear late, but say that they heard at once."""
    trajectory = late_timers.run(LONG, slow=busy(0.8, 15.0))
    used = np.where(trajectory.used >= 0, np.arange(4000)[:, None, None], -1)
    result = compare(dataclasses.replace(trajectory, used=used))
    assert result.verdict == "disagrees"
    assert any(test.rejected and test.name.startswith("residuals") for test in result.tests)


def test_clocks_that_disagree_leave_the_innovations():
    trajectory = late_timers.run(CASES["consensus"])
    made = trajectory.made.copy()
    made[1:, 1] += 250_000_000
    result = compare(dataclasses.replace(trajectory, made=made))
    assert (result.verdict, result.laws.pattern.supported) == ("late", None)
    names = [f"residuals: {what}" for what in ("covariance", "whiteness", "gains", "common gain")]
    assert [test.name for test in result.tests] == [*names, "switching", *IN_DETAIL]
    document = result.to_json()
    assert "their clocks disagree" in document["laws"]["why"]
    assert (document["law"], document["system_error"]) == ("sequential", document["laws"]["sequential"]["system_error"])


def test_timing_by_hand():
    what = real_time(duration=0.5, speed=4.0, seed=5)
    trajectory = simulate(what)
    step = predict(what).step
    ideal = measure_timing(observed(trajectory))
    assert (ideal.period_ms, ideal.missed, ideal.ideal_share, ideal.outdated_share) == (25.0, 0, 1.0, 0.0)
    assert ideal.lateness_ms["max"] == ideal.jitter_ms["max"] == 0.0

    first = int(np.argmin(phases(what)))  # nobody else is heard first
    made, used, graphs = trajectory.made.copy(), trajectory.used.copy(), trajectory.agent_modes.copy()
    made[3, first] += 130_000_000  # due at 0.2 + phase: 1.3 periods late, and so
    made[4, first] = made[3, first]  # the next one is late by 0.3
    used[2, first, 0] -= 1
    used[0, first, 0] = -1
    graphs[5, first] = 1 - graphs[5, first]
    used[4, first] = -1
    neighbours = len(step.neighbours(graphs[5, first], first))
    used[4, first, :neighbours] = 4
    late = measure_timing(observed(dataclasses.replace(trajectory, made=made, used=used, agent_modes=graphs)))
    assert (late.steps, late.missed, late.never_received, late.outdated_graphs) == (15, 1, 1, 1)
    assert (late.uses - late.ideal_uses, late.staleness_steps["max"]) == (2, 2)
    edges, counts = late.histogram
    assert [late.lateness_ms["max"], late.jitter_ms["max"], edges[-1]] == pytest.approx([1.3 * 25] * 3)
    assert counts.sum() == 15


def test_runs_cut_short():
    """Numbers of the complete beginning in which nobody uses a value from after it; no verdict."""
    trajectory = late_timers.run(CASES["consensus"], **LATENESS)
    states = trajectory.states.copy()
    states[300, 1] = np.nan
    gap = dataclasses.replace(trajectory, states=states, completeness=Completeness(1203, 1202, 1))
    result = compare(gap)
    assert (result.verdict, result.timing.steps) == ("incomplete", 3 * result.steps)
    assert 250 < result.steps < 300
    states[20, 1] = np.nan
    result = compare(dataclasses.replace(gap, states=states))
    assert (result.timing, result.laws, result.tests) == (None, None, [])
    json.dumps(result.to_json(), allow_nan=False)


def test_logs_that_do_not_say_enough():
    trajectory = late_timers.run(CASES["consensus"])
    with pytest.raises(InputError, match="expected graph, values used and time in every state"):
        compare(dataclasses.replace(trajectory, used=None))
    graphs = trajectory.agent_modes.copy()
    graphs[8, 1] = -1
    with pytest.raises(InputError, match="agent 2: graph or time of step 7 missing"):
        compare(dataclasses.replace(trajectory, agent_modes=graphs))


@pytest.mark.parametrize(
    ("noise", "start", "why"),
    [
        (1.0, "zero", "steady state"),
        (1.0, [1.0, 2.0, -4.0], "steady state"),
        (0.0, [1.0, 2.0, -4.0], "its errors have no standard error"),
    ],
)
def test_other_starts_and_no_noise(noise, start, why):
    result = compare(late_timers.run(real_time({"process": noise}, start=start), **LATENESS), max_missed=1.0)
    assert result.verdict == "agrees"
    assert result.laws.continuous.supported is None
    assert why in result.laws.continuous.why
    assert (result.laws.pattern.supported is None) == (noise == 0.0)
    json.dumps(result.to_json(), allow_nan=False)


def test_lockstep_has_no_timing():
    document = compare(simulate(real_time(pace="lockstep"))).to_json()
    assert (document["law"], document["timing"], document["laws"]) == ("synchronous", None, None)


def test_shares_in_percent():
    assert [percent(share) for share in (0.0, 1e-6, 0.0731, 0.5, 0.9995, 1.0)] == [
        "0 %", "less than 0.01 %", "7.31 %", "50 %", "more than 99.9 %", "100 %"
    ]  # fmt: skip
