"""Errors given the path of the graphs: against the products of all steps of a short run."""

import dataclasses

import numpy as np
import pytest

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference import given_path as module
from msg_analysis.inference.estimates import covariance_test, estimates
from msg_analysis.inference.given_path import GivenPath, means_given_path
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.time_means import time_means
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

BASE = {
    "name": "tiny",
    "graphs": {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0], [1, 2]]}},
    "agents": 3,
    "switching": {"generator": [[-2.0, 2.0], [1.0, -1.0]]},
    "noise": {"process": [1.0, 0.5, 2.0]},
    "run": {"dt": 0.1, "duration": 1.2, "replicas": 2, "seed": 3, "start": [1.0, -1.0, 3.0]},
}
CASES = {
    "consensus": BASE,
    "tracking": BASE | {"problem": "tracking", "leaders": {"agents": [1], "gain": 1.5, "reference": 2.0}},
    "stationary start": BASE | {"run": BASE["run"] | {"start": "stationary"}},
    "air": BASE | {"noise": {"process": 0.5, "link": 0.8, "broadcast": 0.6, "loss": 0.4}},
}


def observe(document):
    trajectory = simulate(Experiment.parse(document))
    return Observation.of(trajectory, predict(trajectory.record.experiment))


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
    """Mean given the path, and sum of the covariances given the states, of the time means of the node errors.

    E[sum | x(k+1)] is a quadratic function of x(k+1) = W x + B v: with c + b.v + v^T A v in the noise v of a step, the
    covariance of two of these is b.b' + 2 tr(A A'). Its matrix is the sum of P^T H P over products P of later steps.
    """
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
def test_against_products_of_steps(case):
    observation = observe(CASES[case])
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


def test_less_is_tested_when_there_is_much(monkeypatch):
    observation = observe(CASES["tracking"])
    whole, system = means_given_path(observation), observation.prediction.system
    for kind, forms, nodes in (("nodes", 3, 3), ("system", 1, 0)):
        monkeypatch.setattr(module, "MAX_WORK", observation.steps * 9 * (forms**2 + 5 * forms * 3))
        less = means_given_path(observation)
        assert (less.joint, len(less.nodes)) == (False, nodes), kind
        for one, other in zip(estimates(less, system)[1], estimates(whole, system)[1], strict=True):
            assert one.measured == pytest.approx(other.measured)
            assert one.predicted == pytest.approx(other.predicted)
            assert one.z == (pytest.approx(other.z) if nodes else None)
        assert estimates(less, system)[0].z == pytest.approx(estimates(whole, system)[0].z)
        assert covariance_test(less, system).p is None
        assert len(GivenPath(time_means(observation), less).node_errors) == nodes
    monkeypatch.setattr(module, "MAX_WORK", 1)
    assert means_given_path(observation) is None


def test_many_kinds_of_losses_are_left_out(monkeypatch):
    observation = observe(CASES["air"])
    assert means_given_path(observation) is not None
    monkeypatch.setattr(module, "MAX_NUMBERS", 1)
    assert means_given_path(observation) is None


def test_blocks_change_nothing(monkeypatch):
    observation = observe(CASES["air"])
    whole = means_given_path(observation)
    monkeypatch.setattr(module, "SMALL_BLOCK", 50)
    split = means_given_path(observation)
    for field in dataclasses.fields(whole):
        np.testing.assert_allclose(getattr(split, field.name), getattr(whole, field.name), rtol=1e-11)


def test_slow_switching_makes_it_much_better():
    """20 switches: the path makes most of the variance of the plain mean."""
    slow = BASE | {
        "switching": {"generator": [[-0.05, 0.05], [0.05, -0.05]]},
        "graphs": {"line": {"path": [1, 2, 3]}, "all": {"complete": True}},
        "run": {"dt": 0.1, "duration": 400, "replicas": 4, "seed": 1},
    }
    observation = observe(slow)
    found = GivenPath(time_means(observation), means_given_path(observation))
    assert 0.05 < found.variance_ratio < 0.5
