"""The logged-pattern law against every state written out as a combination of all noise of the run."""

import dataclasses

import late_timers
import numpy as np
import pytest
from late_timers import busy
from tests.analysis.inference.test_messages import Unrolled

from experiments import CORRELATED, TRACKING, directed, observed, simulate
from msg_analysis.common.arrays import LARGE_VARIABLE, in_file
from msg_analysis.inference.estimates import covariance_test, estimates
from msg_analysis.inference.event_order import EventOrder, order_events, sampled
from msg_analysis.inference.pattern_events import Periods
from msg_analysis.inference.realtime_laws import PatternUnavailableError, pattern_means

STEPS = 89  # the last block of sqrt(N) periods is a part of one
CHAIN = {"generator": [[-3.0, 3.0], [2.0, -2.0]]}


def real_time(process=1.0, start="stationary", pace="realtime", **changes):
    run = {"duration": STEPS / 10, "pace": pace, "start": start}
    return directed(switching=CHAIN, noise={"process": process}, run=run, **changes)


CASES = {
    "consensus": real_time(),
    "zero": real_time(start="zero"),
    "values": real_time(start=[3.0, -1.0, 0.5]),
    "correlated": real_time(CORRELATED),
    "noise by graph": real_time({"a": [1.0, 0.5, 2.0], "b": CORRELATED}, **TRACKING),
    "agent without noise": real_time([1.0, 0.0, 2.0]),
    "tracking": real_time(**TRACKING),
}
TIMING = {
    "ideal": {},
    "late": {"late": busy(0.4, 2.5)},
    "slow": {"slow": busy(0.7, 3.0)},
    "all": {"late": busy(0.3, 1.5), "slow": busy(0.5, 1.5), "switch": busy(0.8, 2.0)},
}


def made_late(case, timing="all"):
    """A run of a case with these timers."""
    return late_timers.run(CASES[case], **TIMING[timing])


def written_out(observation):
    """Expectation and covariance of the time means of x x^T (consensus: less the agents' mean), entry by entry."""
    # Returns the mean (m, m) and the covariance of its m (m + 1) / 2 entries i >= j. Where every agent has its own
    # noise, the covariance is the sum over the periods of what the noise of the period adds, given the noise before it;
    # else its expectation.
    (steps, m), replicas = observation.timers.graphs.shape, observation.replicas
    unrolled = Unrolled(observation, replicas)
    x, b = np.split(unrolled.sampled, [replicas], axis=2)
    mean, gain = (part.reshape(steps * m, -1) for part in np.split(unrolled.states[1:], [replicas], axis=2))
    seen = (observation.states[1:] - observation.step.reference).reshape(steps * m, -1)
    noise = np.linalg.lstsq(gain, seen - mean, rcond=None)[0]
    period = np.ceil(observation.timers.made[1:] / np.round(observation.step.dt * 1e9)).ravel()
    expected = (np.einsum("kir,kjr->ij", x, x) / replicas + np.einsum("kin,kjn->ij", b, b)) / steps
    i, j = np.tril_indices(m)
    forms = np.einsum("kan,kal->anl", b[:, i], b[:, j], optimize=True) / steps
    forms = (forms + forms.transpose(0, 2, 1)) / 2
    linear = (np.einsum("kan,kar->anr", b[:, i], x[:, j]) + np.einsum("kan,kar->anr", b[:, j], x[:, i])) / steps
    if all((gains == np.diag(np.diag(gains))).all() for gains in observation.step.noise_gain):
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
@pytest.mark.parametrize("timing", TIMING)
def test_against_all_noise_written_out(case, timing, monkeypatch):
    """Expectation and standard errors of the system error, of all nodes, and chi-square of all moments."""
    # In blocks of a few steps, and with all arrays in files.
    monkeypatch.setenv(LARGE_VARIABLE, "1")
    observation = dataclasses.replace(observed(made_late(case, timing)), block_numbers=40)
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
    assert means.system_variances.sum() / STEPS**2 == pytest.approx(error**2, rel=1e-8)
    assert total.measured == pytest.approx(np.trace(measured))
    assert total.z == pytest.approx((np.trace(measured) - np.trace(expected)) / error, rel=1e-6)
    for node, place, i in zip(nodes, diagonal, range(3), strict=True):
        assert node.standard_error == pytest.approx(np.sqrt(covariance[place, place]), rel=1e-7)
        assert node.measured == pytest.approx(measured[i, i])
    off = (measured - expected)[np.tril_indices(3)]
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    found = covariance_test(means, system)
    assert found.chi2 == pytest.approx(off / scale @ inverse @ (off / scale), rel=1e-5)
    assert found.dof == np.linalg.matrix_rank(covariance / np.outer(scale, scale), tol=1e-9, hermitian=True)


def test_what_has_to_be_remembered():
    """Nothing with ideal timers; with slow messages what others still use; noise of a step half made, if correlated."""
    ideal = observed(simulate(CASES["correlated"]))
    assert Periods(ideal, order_events(ideal)).largest == 3
    slow = observed(made_late("consensus", "slow"))
    assert 3 < Periods(slow, order_events(slow)).largest < 12
    late = observed(made_late("correlated", "late"))
    assert Periods(late, order_events(late)).largest > 5


def test_a_clock_that_jumps():
    """All that happens between two ticks has one time; what was used tells the order."""
    trajectory = made_late("consensus")
    tick = 70_000_000
    made = -(-trajectory.made // tick) * tick
    observation = observed(dataclasses.replace(trajectory, made=made))
    order = order_events(observation)
    assert order.contradiction is None
    expected, covariance = written_out(observation)
    means = pattern_means(observation, order)
    np.testing.assert_allclose(observation.prediction.system.lifted(means.expected_moments), expected, rtol=1e-10)
    error = np.sqrt(covariance[np.ix_([0, 2, 5], [0, 2, 5])].sum())
    assert estimates(means, observation.prediction.system)[0].standard_error == pytest.approx(error, rel=1e-8)


def test_clocks_that_disagree():
    trajectory = made_late("consensus", "ideal")
    ahead, back = trajectory.made.copy(), trajectory.made.copy()
    ahead[1:, 1] += 250_000_000
    observation = observed(dataclasses.replace(trajectory, made=ahead))
    with pytest.raises(PatternUnavailableError, match=r"a value that agent 2 computed 0\.\d+ units of time later"):
        pattern_means(observation, order_events(observation))
    back[50, 1] = back[48, 1]
    assert order_events(observed(dataclasses.replace(trajectory, made=back))).contradiction is not None


def test_less_is_tested_when_there_is_much():
    observation = observed(made_late("tracking"))
    system, order = observation.prediction.system, order_events(observation)
    whole = estimates(pattern_means(observation, order), system)
    entries = Periods(observation, order).largest
    for forms, joint in ((3, False), (1, False)):
        work = STEPS * entries**2 * (forms**2 + (3 * forms + 4) * entries)
        means = pattern_means(observation, order, most_work=work)
        error, nodes = estimates(means, system)
        assert means.joint is joint
        assert error.z == pytest.approx(whole[0].z)
        assert len(nodes) == 3
        assert [node.measured for node in nodes] == pytest.approx([node.measured for node in whole[1]])
        assert [node.predicted for node in nodes] == pytest.approx([node.predicted for node in whole[1]])
        assert (nodes[0].z is None) == (forms == 1)
    with pytest.raises(PatternUnavailableError, match="too many to compute"):
        pattern_means(observation, order, most_work=1)
    with pytest.raises(PatternUnavailableError, match="expected at most 3"):
        pattern_means(observation, order, most_entries=3)


def test_order_in_blocks_and_in_files(monkeypatch):
    """With clocks that jump, agents that catch up, and many states of one time: as at once."""
    trajectory = made_late("consensus")
    tick = 300_000_000
    observation = observed(dataclasses.replace(trajectory, made=-(-trajectory.made // tick) * tick))
    whole = order_events(observation)
    assert sorted(whole.position.ravel().tolist()) == list(range(3 * STEPS))
    by_time = np.argsort(whole.position.ravel())
    made, used = observation.timers.made, observation.timers.used
    assert (np.diff(made[1:].ravel()[by_time]) >= 0).all()
    assert (np.diff(whole.position, axis=0) > 0).all()
    for k, i in np.ndindex(whole.position.shape):
        for d, j in enumerate(observation.step.neighbours(int(observation.timers.graphs[k, i]), i).tolist()):
            assert used[k, i, d] <= 0 or whole.position[used[k, i, d] - 1, j] < whole.position[k, i]
    monkeypatch.setenv(LARGE_VARIABLE, "1")
    split = order_events(dataclasses.replace(observation, block_numbers=90), ties_at_once=2)
    assert in_file(split.position)
    assert np.array_equal(split.position, whole.position)
    assert np.array_equal(split.newest, whole.newest)
    assert np.array_equal(sampled(observation, split), sampled(observation, whole))


def test_the_order_in_lockstep():
    """Of the states of a run in which all agents step at the same time, that by step and agent."""
    observation = observed(simulate(real_time(pace="lockstep"))).as_timed()
    one, other = EventOrder.of_lockstep(STEPS, 3), order_events(observation)
    assert np.array_equal(one.position, other.position)
    assert np.array_equal(one.newest, other.newest)
    for first, last in ((0, 1), (0, 5), (7, 60), (50, STEPS + 2)):
        steps, agents = one.events(first, last)
        expected = [(k, i) for i in range(3) for k in range(STEPS) if first <= k + 1 < last]
        assert list(zip(steps.tolist(), agents.tolist(), strict=True)) == expected
