"""Comparisons of runs with noise and loss on the air."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from p_values import assert_calibrated
from scipy import stats

from experiments import CORRELATED, TRACKING, compare, directed, observed, predict, simulate
from msg_analysis.inference.counts import loss_test
from msg_analysis.inference.estimates import covariance_test
from msg_analysis.inference.given_path import means_given_path
from msg_analysis.inference.received_values import ReceivedValues
from msg_analysis.inference.regression import Regression
from msg_analysis.inference.residuals import BroadcastSums, ResidualSums, residuals

AIR = {"broadcast": 0.3, "link": 0.2, "loss": 0.2}
SEEDS = range(30)


CASES = {
    "all": directed(noise=AIR),
    "nothing lost": directed(noise={"process": 0.2, "broadcast": 0.3, "link": 0.2}),
    "correlated": directed(noise=AIR | {"process": CORRELATED}, **TRACKING),
    "loss alone, start at zero": directed(noise={"loss": 0.4}, run={"start": "zero"}),
    "no process noise": directed(noise={"process": 0.0, "link": 0.3, "loss": 0.3}),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("predicted_once")
def test_calibration(case):
    """30 true runs of 400 steps."""
    results = [compare(simulate(CASES[case].with_run(seed=seed))) for seed in SEEDS]
    collected = {test.name for test in results[0].tests}
    names = {"system error, corrected", "covariance", "residuals: covariance", "residuals: gains"}
    assert names <= collected
    assert ("residuals: whiteness" in collected) == (case != "no process noise")
    assert ("loss" in collected) == (case != "nothing lost")
    assert ("broadcast" in collected) == (case in ("all", "nothing lost", "correlated"))
    assert_calibrated(results)


def test_many_second_moments_of_a_short_run():
    """28 second moments in 150 steps, 40 runs: few enough p-values below 5 %, by the binomial law at 1e-4."""
    graphs = {"line": {"path": list(range(1, 9))}, "ring": {"cycle": list(range(1, 9))}}
    what = directed(
        noise=AIR, graphs=graphs, run={"duration": 15}, switching={"generator": [[-20.0, 20.0], [20.0, -20.0]]}
    )
    prediction = predict(what)
    runs = [observed(simulate(what.with_run(seed=seed)), prediction) for seed in range(40)]
    tests = [covariance_test(means_given_path(run), prediction.system) for run in runs]
    assert {test.dof for test in tests} == {28}
    assert sum(test.p < 0.05 for test in tests) <= stats.binom.isf(1e-4, 40, 0.05)


def nominal(what):
    """W of the graphs, link by link."""
    gains = np.diag(np.where(np.isfinite(what.leader_gains), what.leader_gains, 0.0))
    return [np.eye(3) - what.run.dt * (graph.laplacian + gains) for graph in what.graph_list]


@pytest.mark.parametrize("most", [400, 12, 8])
def test_regression_against_a_loop(most):
    """Each difference of each graph; the pull of each agent in each graph; in both graphs together."""
    what = CASES["correlated"]
    observation, trajectory, weights = observed(what), simulate(what), nominal(what)
    regression = Regression(observation, most)
    for first, last in ((0, 150), (150, 400)):
        reception = ReceivedValues.of(observation, first, last)
        regression.add(reception, residuals(observation, first, last, reception))
    e = residuals(observation, 0, 400)
    process = what.run.dt * np.array(CORRELATED) @ np.array(CORRELATED).T
    links = [(i, j) for g in (0, 1) for i in range(3) for j in range(3) if j != i and weights[g][i, j]]
    size = {400: 3 + len(links) + 2, 12: 9, 8: 6}[most]
    assert len(regression.statistic()[0]) == size
    score, covariance = 0.0, 0.0
    for k, g in enumerate(trajectory.modes):
        noise, pulls = process.copy(), np.zeros((3, 2))
        every, x = [(i, np.ones(2)) for i in range(3)], trajectory.states[k]  # (agent, regressor), each of its own
        for graph in (0, 1):
            for i in range(3):
                senders = [j for j in range(3) if j != i and weights[graph][i, j]]
                for which, j in enumerate(senders):
                    came = graph == g and not trajectory.lost[k, i, which]
                    difference = came * (trajectory.published[k, j] - x[i])
                    pulls[i] += weights[graph][i, j] * difference
                    noise[i, i] += came * (what.noise.link * weights[graph][i, j]) ** 2
                    every.append((i, difference))
            leaders = np.flatnonzero(what.leader_gains)
            pulls[leaders] -= (graph == g) * what.run.dt * what.leader_gains[leaders, None] * (x[leaders] - 2.0)
            every += [(i, (graph == g) * (x[i] - 2.0)) for i in leaders]
        in_graph = [(i, (graph == g) * pulls[i]) for graph in (0, 1) for i in range(3)]
        chosen = {400: every, 12: every[:3] + in_graph, 8: every[:3] + list(enumerate(pulls))}[most]
        rows, phi = np.array([i for i, _ in chosen]), np.array([regressor for _, regressor in chosen])
        score = score + (e[k, rows] * phi).sum(axis=1)
        covariance = covariance + noise[np.ix_(rows, rows)] * (phi @ phi.T)
    np.testing.assert_allclose(regression.statistic()[0], score, atol=1e-9)
    np.testing.assert_allclose(regression.statistic()[1], covariance, atol=1e-9)


def test_blocks_change_nothing():
    observation = observed(CASES["correlated"])
    whole = ResidualSums(observation).tests(), loss_test(observation), BroadcastSums(observation).p_value()
    observation = dataclasses.replace(observation, block_numbers=70)
    split = ResidualSums(observation).tests(), loss_test(observation), BroadcastSums(observation).p_value()
    for one, other in zip(whole[:2], split[:2], strict=True):
        for ours, theirs in zip(dataclasses.astuple(other), dataclasses.astuple(one), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert split[2] == pytest.approx(whole[2])


def test_agents_that_moved_without_having_heard_anything():
    """Without process noise, who has lost everything stays where he is."""
    what = CASES["no process noise"]
    trajectory = simulate(what)
    step = int(np.flatnonzero((trajectory.modes == 0) & trajectory.lost[:, 0, 0])[3])
    moved = trajectory.states.copy()
    moved[step + 1 :] += np.array([1e-4, 0.0, 0.0])[:, None]
    result = ResidualSums(observed(dataclasses.replace(trajectory, states=moved))).tests()
    assert result.p_covariance == 0.0


def test_losses_by_hand():
    """Links of graph a: 12, 21, 23, 32; of b: 13, 21, 31, 32 (receiver, sender); counts, chi-squares of them."""
    observation, p = observed(directed(noise=AIR, run={"duration": 100})), 0.2
    receivers = ([(1, 2), (2, 1), (2, 3), (3, 2)], [(1, 3), (2, 1), (3, 1), (3, 2)])
    places = ([0, 0, 1, 0], [0, 0, 0, 1])
    xi = [
        {link: float(lost[link[0] - 1, place]) - p for link, place in zip(receivers[g], places[g], strict=True)}
        for g, lost in zip(observation.modes, observation.lost, strict=True)
    ]
    v = p * (1 - p)
    links = sorted({link for step in xi for link in step})
    sums = {link: [step[link] for step in xi if link in step] for link in links}
    chi2 = sum(sum(values) ** 2 / (len(values) * v) for values in sums.values())
    after = [a[link] * b[link] for a, b in pairwise(xi) for link in links if link in a and link in b]
    beside = [step[a] * step[b] for step in xi for a in step for b in step if a < b]
    chi2 += sum(sum(products) ** 2 / (len(products) * v * v) for products in (after, beside))
    test = loss_test(observation)
    assert test.lost == sum(value > 0 for values in sums.values() for value in values)
    assert test.expected == pytest.approx(p * sum(map(len, sums.values())))
    assert test.p == pytest.approx(stats.chi2.sf(chi2, len(links) + 2))


def test_losses_that_are_not_independent():
    """The right number on each link, but in bursts, or of all messages of a step together."""
    observation = observed(directed(noise={"loss": 0.25}, run={"duration": 200, "start": "zero"}))
    random = np.random.default_rng(1)
    shape = observation.lost.shape
    assert loss_test(observation).p > 1e-3
    bursts = np.repeat(random.random((shape[0] // 2, *shape[1:])) < 0.25, 2, axis=0)
    together = np.broadcast_to(random.random((shape[0], 1, 1)) < 0.25, shape)
    for lost in (bursts, together):
        assert loss_test(dataclasses.replace(observation, lost=lost)).p < 1e-6


@pytest.mark.parametrize("lost", [0, 3, 40])
def test_rare_losses_have_their_binomial_law(lost):
    """One loss in a thousand, 400 steps of 4 messages."""
    observation = observed(directed(noise={"loss": 0.001}, run={"start": "zero"}))
    logged = np.zeros_like(observation.lost)
    logged[10 : 10 + lost, 0, 0] = True
    test = loss_test(dataclasses.replace(observation, lost=logged))
    assert test.lost == lost
    assert test.expected == pytest.approx(1.6)
    assert test.p == pytest.approx(stats.binomtest(lost, 1600, 0.001).pvalue, rel=1e-6)


def test_broadcast_noise_that_is_repeated():
    observation = observed(directed(noise=AIR, run={"duration": 20}))
    assert BroadcastSums(observation).p_value() > 1e-3
    same = observation.states + (observation.published - observation.states)[:, :1]
    assert BroadcastSums(dataclasses.replace(observation, published=same)).p_value() < 1e-6
