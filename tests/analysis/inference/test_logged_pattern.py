"""The logged-pattern law against every state written out as a combination of all noise of the run."""

import dataclasses

import numpy as np
import pytest

from msg_analysis.common import arrays
from msg_analysis.common.arrays import in_file
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import realtime_laws as module
from msg_analysis.inference.estimates import covariance_test, estimates
from msg_analysis.inference.event_order import EventOrder, newest_steps, order_events, sampled
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.pattern_events import Periods
from msg_analysis.inference.realtime_laws import PatternUnavailableError, pattern_means
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

CORRELATED = [[1.0, 0.3, 0.0], [0.0, 0.5, 0.2], [0.0, 0.0, 2.0]]
STEPS = 90


def experiment(run=None, **changes):
    document = {
        "name": "pattern",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[1, 2], [2, 3, 2.0], [3, 1], [1, 3]]}},
        "switching": {"generator": [[-3.0, 3.0], [2.0, -2.0]]},
        "run": {"dt": 0.1, "duration": STEPS / 10, "replicas": 2, "seed": 3, "pace": "realtime"} | (run or {}),
    }
    return Experiment.parse(document | changes)


TRACKING = {"problem": "tracking", "leaders": {"agents": [1], "gain": 0.7, "reference": 2.0}}
CASES = {
    "consensus": experiment(),
    "zero": experiment(run={"start": "zero"}),
    "values": experiment(run={"start": [3.0, -1.0, 0.5]}),
    "correlated": experiment(noise={"process": CORRELATED}),
    "noise by graph": experiment(noise={"process": {"a": [1.0, 0.5, 2.0], "b": CORRELATED}}, **TRACKING),
    "agent without noise": experiment(noise={"process": [1.0, 0.0, 2.0]}),
    "tracking": experiment(**TRACKING),
}


def timing(late_timers, kind):
    busy = late_timers.busy
    return {
        "ideal": {},
        "late": {"late": busy(0.4, 2.5)},
        "slow": {"slow": busy(0.7, 3.0)},
        "all": {"late": busy(0.3, 1.5), "slow": busy(0.5, 1.5), "switch": busy(0.8, 2.0)},
    }[kind]


def observe(trajectory):
    return Observation.of(trajectory, predict(trajectory.record.experiment))


def written_out(observation):
    """Expectation and covariance of the time means of x x^T (consensus: less the agents' mean), entry by entry.

    Returns the mean (m, m) and the covariance of its m (m + 1) / 2 entries i >= j. Where every agent has its own noise,
    the covariance is the sum over the periods of what the noise of the period adds, given the noise before it; else its
    expectation.
    """
    step, timers = observation.step, observation.timers
    steps, m = timers.graphs.shape
    replicas = observation.replicas
    mean = np.full((steps + 1, m, replicas), np.nan)
    gain = np.full((steps + 1, m, steps * m), np.nan)
    seen = observation.states - step.reference
    noise, period = np.zeros((steps * m, replicas)), np.zeros(steps * m)
    mean[0], gain[0] = observation.start - step.reference, 0.0
    known = {(0, i) for i in range(m)}
    neighbours_of = [[step.neighbours(g, i).tolist() for i in range(m)] for g in range(step.modes)]
    waiting = [(k, i) for k in range(steps) for i in range(m)]
    while waiting:
        left = []
        for k, i in waiting:
            g = timers.graphs[k, i]
            neighbours = neighbours_of[g][i]
            uses = [(int(timers.used[k, i, d]), j) for d, j in enumerate(neighbours)]
            uses = [(k, i) if s < 0 else (s, j) for s, j in uses]
            if (k, i) not in known or not known.issuperset(uses):
                left.append((k, i))
                continue
            row = step.nominal[g, i]
            mean[k + 1, i] = row[i] * mean[k, i] + sum(
                row[j] * mean[use] for j, use in zip(neighbours, uses, strict=True)
            )
            gain[k + 1, i] = row[i] * gain[k, i] + sum(
                row[j] * gain[use] for j, use in zip(neighbours, uses, strict=True)
            )
            gain[k + 1, i, k * m : (k + 1) * m] += step.noise_gain[g, i]
            known.add((k + 1, i))
            rest = seen[k + 1, i] - row[i] * seen[k, i]
            rest = rest - sum(row[j] * seen[use] for j, use in zip(neighbours, uses, strict=True))
            noise[k * m + i] = rest / (step.noise_gain[g, i, i] or 1.0)
            period[k * m + i] = np.ceil(timers.made[k + 1, i] / np.round(step.dt * 1e9))
        assert len(left) < len(waiting)
        waiting = left
    times = np.round(np.arange(steps) * step.dt * 1e9)
    newest = (timers.made[None] <= times[:, None, None]).sum(axis=1) - 1
    x, b = mean[newest, range(m)], gain[newest, range(m)]
    if observation.prediction.experiment.problem == "consensus":
        x, b = x - x.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    expected = (np.einsum("kir,kjr->ij", x, x) / replicas + np.einsum("kin,kjn->ij", b, b)) / steps
    entries = [(i, j) for i in range(m) for j in range(i + 1)]
    forms = [np.einsum("kn,kl->nl", b[:, i], b[:, j]) / steps for i, j in entries]
    forms = [(form + form.T) / 2 for form in forms]
    linear = [
        (np.einsum("kn,kr->nr", b[:, i], x[:, j]) + np.einsum("kn,kr->nr", b[:, j], x[:, i])) / steps
        for i, j in entries
    ]
    forms, linear = np.array(forms), np.array(linear)
    if all((gains == np.diag(np.diag(gains))).all() for gains in step.noise_gain):
        covariance = np.zeros((len(forms), len(forms)))
        for number in range(1, steps):
            now, before = period == number, period < number
            within = forms[:, now][:, :, now]
            slope = 2 * forms[:, now][:, :, before] @ noise[before] + linear[:, now]
            covariance += 2 * np.einsum("aij,bij->ab", within, within) / replicas
            covariance += np.einsum("air,bir->ab", slope, slope) / replicas**2
        return expected, covariance
    covariance = 2 * np.einsum("aij,bij->ab", forms, forms) / replicas
    return expected, covariance + np.einsum("air,bir->ab", linear, linear) / replicas**2


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", ["ideal", "late", "slow", "all"])
def test_against_all_noise_written_out(late_timers, case, kind):
    """Expectation and standard errors of the system error, of all nodes, and chi-square of all moments."""
    observation = observe(late_timers.run(CASES[case], **timing(late_timers, kind)))
    order = order_events(observation)
    assert order.contradiction is None
    means = pattern_means(observation, order)
    system = observation.prediction.system
    expected, covariance = written_out(observation)
    np.testing.assert_allclose(system.lifted(means.expected_moments), expected, atol=1e-12 * np.abs(expected).max())
    total, nodes = estimates(means, system)
    diagonal = [0, 2, 5]
    error = np.sqrt(covariance[np.ix_(diagonal, diagonal)].sum())
    x = sampled(observation, order)[:-1] - observation.step.reference
    if system.dimension == 2:
        x = x - x.mean(axis=1, keepdims=True)
    measured = np.einsum("kir,kjr->ij", x, x) / x.shape[0] / x.shape[2]
    assert total.standard_error == pytest.approx(error, rel=1e-8)
    assert total.measured == pytest.approx(np.trace(measured))
    assert total.z == pytest.approx((np.trace(measured) - np.trace(expected)) / error, rel=1e-6)
    for node, place, i in zip(nodes, diagonal, range(3), strict=True):
        assert node.standard_error == pytest.approx(np.sqrt(covariance[place, place]), rel=1e-7)
        assert node.measured == pytest.approx(measured[i, i])
    off = np.array([(measured - expected)[i, j] for i in range(3) for j in range(i + 1)])
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    found = covariance_test(means, system)
    assert found.chi2 == pytest.approx(off / scale @ inverse @ (off / scale), rel=1e-5)
    assert found.dof == np.linalg.matrix_rank(covariance / np.outer(scale, scale), tol=1e-9, hermitian=True)


def test_what_has_to_be_remembered(late_timers):
    """Nothing with ideal timers; with slow messages what others still use; noise of a step half made, if correlated."""
    ideal = observe(simulate(CASES["correlated"]))
    assert Periods(ideal, order_events(ideal)).largest == 3
    slow = observe(late_timers.run(CASES["consensus"], slow=late_timers.busy(0.7, 3.0)))
    assert 3 < Periods(slow, order_events(slow)).largest < 12
    late = late_timers.run(CASES["correlated"], late=late_timers.busy(0.4, 2.5))
    late = observe(late)
    assert Periods(late, order_events(late)).largest > 5


def test_ideal_periods_are_the_sequential_law():
    observation = observe(simulate(experiment(noise={"process": CORRELATED}, **TRACKING)))
    periods = Periods(observation, order_events(observation))
    system = observation.prediction.system
    for number in range(1, STEPS):
        g = observation.modes[number - 1]
        np.testing.assert_allclose(periods[number].matrix, system.matrices[g], atol=1e-14)
        np.testing.assert_allclose(periods[number].noise, system.noise[g], atol=1e-14)
    np.testing.assert_array_equal(newest_steps(observation), np.tile(np.arange(STEPS + 1)[:, None], (1, 3)))
    np.testing.assert_array_equal(sampled(observation, order_events(observation)), observation.states)


def test_a_clock_that_jumps(late_timers):
    """All that happens between two ticks has one time; what was used tells the order."""
    trajectory = late_timers.run(CASES["consensus"], **timing(late_timers, "all"))
    tick = 70_000_000
    made = -(-trajectory.made // tick) * tick
    observation = observe(dataclasses.replace(trajectory, made=made))
    order = order_events(observation)
    assert order.contradiction is None
    expected, covariance = written_out(observation)
    means = pattern_means(observation, order)
    np.testing.assert_allclose(observation.prediction.system.lifted(means.expected_moments), expected, rtol=1e-10)
    error = np.sqrt(covariance[np.ix_([0, 2, 5], [0, 2, 5])].sum())
    assert estimates(means, observation.prediction.system)[0].standard_error == pytest.approx(error, rel=1e-8)


def test_clocks_that_disagree(late_timers):
    trajectory = late_timers.run(CASES["consensus"])
    ahead = trajectory.made.copy()
    ahead[1:, 1] += 250_000_000
    observation = observe(dataclasses.replace(trajectory, made=ahead))
    with pytest.raises(PatternUnavailableError, match=r"a value that agent 2 computed 0\.\d+ units of time later"):
        pattern_means(observation, order_events(observation))
    back = trajectory.made.copy()
    back[50, 1] = back[48, 1]
    order = order_events(observe(dataclasses.replace(trajectory, made=back)))
    assert order.contradiction is not None


def test_blocks_change_nothing(late_timers, monkeypatch):
    observation = observe(late_timers.run(CASES["correlated"], **timing(late_timers, "all")))
    order = order_events(observation)
    whole = pattern_means(observation, order)
    monkeypatch.setattr("msg_analysis.inference.observation.BLOCK_NUMBERS", 40)
    monkeypatch.setattr("msg_analysis.inference.pattern_events.CACHED_NUMBERS", 50)
    monkeypatch.setattr("msg_analysis.inference.realtime_laws.math.isqrt", lambda _: 7)
    monkeypatch.setattr(arrays, "LARGE", 1)
    split = pattern_means(observation, order)
    for name in ("measured", "predicted", "covariance", "system_series", "system_variances"):
        np.testing.assert_allclose(getattr(split, name), getattr(whole, name), rtol=1e-9, atol=1e-14)
    assert whole.system_variances.sum() / STEPS**2 == pytest.approx(whole.trace @ whole.covariance @ whole.trace)


def test_less_is_tested_when_there_is_much(late_timers, monkeypatch):
    observation = observe(late_timers.run(CASES["tracking"], **timing(late_timers, "all")))
    system, order = observation.prediction.system, order_events(observation)
    whole = estimates(pattern_means(observation, order), system)
    entries = Periods(observation, order).largest
    for forms, joint in ((3, False), (1, False)):
        work = STEPS * entries**2 * (forms**2 + (3 * forms + 4) * entries)
        monkeypatch.setattr(module, "MAX_WORK", work)
        means = pattern_means(observation, order)
        error, nodes = estimates(means, system)
        assert means.joint is joint
        assert error.z == pytest.approx(whole[0].z)
        assert len(nodes) == 3
        assert [node.measured for node in nodes] == pytest.approx([node.measured for node in whole[1]])
        assert [node.predicted for node in nodes] == pytest.approx([node.predicted for node in whole[1]])
        assert (nodes[0].z is None) == (forms == 1)
    monkeypatch.setattr(module, "MAX_WORK", 1)
    with pytest.raises(PatternUnavailableError, match="too many to compute"):
        pattern_means(observation, order)
    monkeypatch.setattr(module, "MAX_ENTRIES", 3)
    with pytest.raises(PatternUnavailableError, match="expected at most 3"):
        pattern_means(observation, order)


def test_order_in_blocks_and_in_files(late_timers, monkeypatch):
    """With clocks that jump, agents that catch up, and many states of one time: as at once."""
    trajectory = late_timers.run(CASES["consensus"], **timing(late_timers, "all"))
    tick = 300_000_000
    observation = observe(dataclasses.replace(trajectory, made=-(-trajectory.made // tick) * tick))
    whole = order_events(observation)
    assert sorted(whole.position.ravel().tolist()) == list(range(3 * STEPS))
    by_time = np.argsort(whole.position.ravel())
    made, used = observation.timers.made, observation.timers.used
    assert (np.diff(made[1:].ravel()[by_time]) >= 0).all()
    for k, i in np.ndindex(whole.position.shape):
        if k:
            assert whole.position[k - 1, i] < whole.position[k, i]
        for d, j in enumerate(observation.step.neighbours(int(observation.timers.graphs[k, i]), i).tolist()):
            if used[k, i, d] > 0:
                assert whole.position[used[k, i, d] - 1, j] < whole.position[k, i]
    monkeypatch.setattr("msg_analysis.inference.observation.BLOCK_NUMBERS", 90)
    monkeypatch.setattr("msg_analysis.inference.event_order.TIES_AT_ONCE", 2)
    monkeypatch.setattr(arrays, "LARGE", 1)
    split = order_events(observation)
    assert in_file(split.position)
    assert np.array_equal(split.position, whole.position)
    assert np.array_equal(split.newest, whole.newest)
    assert np.array_equal(sampled(observation, split), sampled(observation, whole))


def test_the_order_in_lockstep():
    """Of the states of a run in which all agents step at the same time, that by step and agent."""
    observation = observe(simulate(experiment(run={"pace": "lockstep"}))).as_timed()
    one, other = EventOrder.of_lockstep(STEPS, 3), order_events(observation)
    assert np.array_equal(one.position, other.position)
    assert np.array_equal(one.newest, other.newest)
    for first, last in ((0, 1), (0, 5), (7, 60), (50, STEPS + 2)):
        steps, agents = one.events(first, last)
        expected = [(k, i) for i in range(3) for k in range(STEPS) if first <= k + 1 < last]
        assert list(zip(steps.tolist(), agents.tolist(), strict=True)) == expected
