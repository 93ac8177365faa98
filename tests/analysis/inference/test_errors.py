"""Time means, and errors given the path of the graphs: against plain loops and products of all steps."""

import dataclasses
import math

import numpy as np
import pytest

from experiments import observed, pieces
from msg_analysis.inference.estimates import covariance_test, estimates
from msg_analysis.inference.given_path import GivenPath, means_given_path
from msg_analysis.inference.time_means import expected_mean, time_means


@pytest.fixture(scope="module")
def observation():
    """In blocks of a few steps."""
    return dataclasses.replace(observed(pieces()), block_numbers=50)


def future(step, form):
    """(Y_g, kappa_g up to a constant): the summed expected future of y^T H y less its steady mean."""
    y, kappa = np.stack([form] * 2), np.zeros(2)
    for _ in range(4000):
        ahead = np.einsum("gj,jab->gab", step.transition, y)
        kappa = step.transition @ kappa + np.einsum("gab,gab->g", ahead, step.noise)
        kappa -= kappa[0]
        y = form + step.weights.transpose(0, 2, 1) @ ahead @ step.weights
    return y, kappa


def fourth_moments(mean, cov):
    """E[x_a x_b x_c x_d] of N(mean, cov) as a (d, d, d, d) array (Isserlis)."""
    second = cov + np.outer(mean, mean)
    e = np.einsum
    return (
        e("ab,cd->abcd", second, second)
        + e("ac,bd->abcd", second, second)
        + e("ad,bc->abcd", second, second)
        - 2 * e("a,b,c,d->abcd", mean, mean, mean, mean)
    )


def test_measured_is_the_mean_over_the_first_n_states(observation):
    means = time_means(observation)
    y = observation.states[:-1] - 2.0
    direct = (y**2).mean(axis=(0, 2))
    np.testing.assert_allclose(means.nodes @ means.measured, direct, rtol=1e-12)
    np.testing.assert_allclose(means.system_series, (y**2).mean(axis=2).sum(axis=1), rtol=1e-12)
    prediction = observation.prediction.emulated
    np.testing.assert_allclose(means.nodes @ means.predicted, prediction.node_errors, rtol=1e-10)


def test_standard_errors_by_fourth_moments(observation):
    """Cov(D_k | now) of all node errors, written out for every step, next graph and replica."""
    step = observation.prediction.step
    values = [future(step, np.diag(row)) for row in np.eye(3)]
    total, system = np.zeros((3, 3)), np.zeros(observation.steps)
    for k, g in enumerate(observation.modes):
        moved = [step.weights[g] @ (x - 2.0) for x in observation.states[k].T]
        covariance, means = np.zeros((3, 3)), np.zeros((2, 3))
        for j in range(2):
            for m in moved:
                fourth = fourth_moments(m, step.noise[g])
                second = step.noise[g] + np.outer(m, m)
                first = [np.sum(values[a][0][j] * second) for a in range(3)]
                means[j] += np.array([first[a] + values[a][1][j] for a in range(3)]) / 2
                for a in range(3):
                    for b in range(3):
                        product = np.einsum("ij,kl,ijkl", values[a][0][j], values[b][0][j], fourth)
                        covariance[a, b] += step.transition[g, j] * (product - first[a] * first[b]) / 4
        mean = step.transition[g] @ means
        for j in range(2):
            covariance += step.transition[g, j] * np.outer(means[j] - mean, means[j] - mean)
        total += covariance
        system[k] = covariance.sum()
    means = time_means(observation)
    measured = means.nodes @ means.covariance @ means.nodes.T
    np.testing.assert_allclose(measured, total / observation.steps**2, rtol=1e-8)
    np.testing.assert_allclose(means.system_variances, system, rtol=1e-8)


@pytest.mark.parametrize(
    ("switches", "first", "others", "enough"),
    [
        (0.5, 1.0, 1.0, False),  # hardly a switch is expected
        (20.0, 1.0, 1.0, True),
        (20.0, 100.0, 1.0, False),  # the first part has 84 % of the variance
        (math.inf, 100.0, 1.0, True),  # the path is given
    ],
)
def test_intervals_need_many_holding_times(observation, switches, first, others, enough):
    means = dataclasses.replace(
        time_means(observation), system_variances=np.repeat([first] + [others] * 19, 5), switches=switches
    )
    assert means.long_enough is enough


def test_expected_switches(observation):
    """Of the rarer kind of N steps, with the stationary law of two graphs: both kinds are equally frequent."""
    transition = observation.prediction.step.transition
    there, back = transition[0, 1], transition[1, 0]
    assert time_means(observation).switches == pytest.approx(observation.steps * there * back / (there + back))


@pytest.mark.parametrize("start", ["zero", [5.0, -1.0, 2.0]])
def test_known_starts_are_predicted_by_the_transient(start):
    """Oracle: the recursion of theory, started at x(0) and the logged g(0), one step after the other."""
    seen = observed(pieces(run={"start": start}))
    step = seen.prediction.step
    y = seen.states[0, :, 0] - 2.0
    law = np.eye(2)[seen.modes[0]]
    moments, total = law[:, None, None] * np.outer(y, y), np.zeros((3, 3))
    for _ in range(seen.steps):
        total += moments.sum(axis=0)
        w = step.weights
        inside = w @ moments @ w.transpose(0, 2, 1) + law[:, None, None] * step.noise
        moments, law = np.einsum("ji,jab->iab", step.transition, inside), law @ step.transition
    np.testing.assert_allclose(expected_mean(seen), total / seen.steps, rtol=1e-10)


def short(**changes):
    run = {"duration": 1.2, "start": [1.0, -1.0, 3.0]} | changes.pop("run", {})
    graphs = {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0], [1, 2]]}}
    fields = {"problem": "consensus", "leaders": None, "graphs": graphs, "noise": {"process": [1.0, 0.5, 2.0]}}
    return pieces(**fields | changes, run=run)


CASES = {
    "consensus": short(),
    "tracking": short(problem="tracking", leaders={"agents": [1], "gain": 1.5, "reference": 2.0}),
    "stationary start": short(run={"start": "stationary"}),
    "air": short(noise={"process": 0.5, "link": 0.8, "broadcast": 0.6, "loss": 0.4}),
}


def steps_by_hand(observation):
    """(W, B) of every step in the states themselves: x(k+1) - r = W (x(k) - r) + B v with v standard normal."""
    experiment, m = observation.prediction.experiment, 3
    dt, noise = experiment.run.dt, experiment.noise
    steps = []
    for k in range(observation.steps - 1):
        graph = experiment.graph_list[observation.modes[k]].adjacency
        weights = dt * graph
        for i in range(m):
            for d, j in enumerate(np.flatnonzero(graph[i])):
                if observation.lost is not None and observation.lost[k, i, d]:
                    weights[i, j] = 0.0
        step = np.eye(m) + weights - np.diag(weights.sum(axis=1)) - np.diag(dt * experiment.leader_gains)
        added = [np.sqrt(dt) * experiment.noise_gain[observation.modes[k]], noise.broadcast * weights]
        added += [noise.link * np.diag(row) for row in weights.T]
        steps.append((step, np.concatenate(added, axis=1)))
    return steps


def by_hand(observation):
    """Mean given the path, and sum of the covariances given the states, of the time means of the node errors."""
    # E[sum | x(k+1)] is a quadratic function of x(k+1) = W x + B v: with c + b.v + v^T A v in the noise v of a step,
    # the covariance of two of these is b.b' + 2 tr(A A'). Its matrix is the sum of P^T H P over products P of later
    # steps.
    m, steps, replicas = 3, observation.steps, observation.replicas
    law = steps_by_hand(observation)
    consensus = observation.prediction.experiment.problem == "consensus"
    centre = np.eye(m) - (1.0 / m if consensus else 0.0)
    forms = np.array([np.outer(row, row) / steps for row in centre])
    deviations = observation.states - observation.step.reference
    moment = np.mean([np.outer(x, x) for x in deviations[0].T], axis=0)
    mean, covariance = np.zeros(m), np.zeros((m, m))
    for k in range(steps):
        mean += np.einsum("aij,ij->a", forms, moment)
        if k == steps - 1:
            break
        step, noise = law[k]
        moment = step @ moment @ step.T + noise @ noise.T
        product, matrix = np.eye(m), forms.copy()
        for later, _ in law[k + 1 :]:
            product = later @ product
            matrix += product.T @ forms @ product
        quadratic = noise.T @ matrix @ noise
        for x in deviations[k].T:
            linear = 2.0 * noise.T @ matrix @ step @ x
            covariance += (linear @ linear.T + 2.0 * np.einsum("aij,bij->ab", quadratic, quadratic)) / replicas**2
    return mean, covariance


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("block_numbers", [50, 10**6])
def test_against_products_of_steps(case, block_numbers):
    observation = dataclasses.replace(observed(CASES[case]), block_numbers=block_numbers)
    means, given = time_means(observation), means_given_path(observation)
    mean, covariance = by_hand(observation)
    assert given.joint
    np.testing.assert_allclose(given.nodes @ given.predicted, mean, rtol=1e-10)
    np.testing.assert_allclose(given.nodes @ given.covariance @ given.nodes.T, covariance, rtol=1e-9)
    assert given.system_variances.sum() / observation.steps**2 == pytest.approx(covariance.sum(), rel=1e-9)
    y = observation.states[:-1] - observation.step.reference
    if observation.prediction.experiment.problem == "consensus":
        y = y - y.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(given.nodes @ given.measured, (y**2).mean(axis=(0, 2)), rtol=1e-12)
    found = GivenPath(means, given)
    predicted = means.nodes @ means.predicted
    measured = given.nodes @ given.measured
    assert found.expected == pytest.approx(mean.sum())
    error = found.system_error
    assert error.measured == pytest.approx((measured - mean + predicted).sum())
    assert error.standard_error == pytest.approx(np.sqrt(covariance.sum()), rel=1e-9)
    assert [node.z for node in found.node_errors] == pytest.approx((measured - mean) / np.sqrt(np.diag(covariance)))


def test_less_is_tested_when_there_is_much():
    observation = observed(CASES["tracking"])
    whole, system = means_given_path(observation), observation.prediction.system
    for kind, forms, nodes in (("nodes", 3, 3), ("system", 1, 0)):
        less = means_given_path(observation, most_work=observation.steps * 9 * (forms**2 + 5 * forms * 3))
        assert (less.joint, len(less.nodes)) == (False, nodes), kind
        for one, other in zip(estimates(less, system)[1], estimates(whole, system)[1], strict=True):
            assert one.measured == pytest.approx(other.measured)
            assert one.predicted == pytest.approx(other.predicted)
            assert one.z == (pytest.approx(other.z) if nodes else None)
        assert estimates(less, system)[0].z == pytest.approx(estimates(whole, system)[0].z)
        assert covariance_test(less, system).p is None
        assert len(GivenPath(time_means(observation), less).node_errors) == nodes
    assert means_given_path(observation, most_work=1) is None


def test_many_kinds_of_losses_are_left_out():
    assert means_given_path(observed(CASES["air"]), most_numbers=1) is None


def test_slow_switching_makes_it_much_better():
    """20 switches: the path makes most of the variance of the plain mean."""
    graphs = {"line": {"path": [1, 2, 3]}, "all": {"complete": True}}
    run = {"duration": 400, "replicas": 4, "seed": 1, "start": "stationary"}
    observation = observed(short(switching={"generator": [[-0.05, 0.05], [0.05, -0.05]]}, graphs=graphs, run=run))
    found = GivenPath(time_means(observation), means_given_path(observation))
    assert 0.05 < found.variance_ratio < 0.5
