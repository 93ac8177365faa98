"""Errors given the path of the graphs: against the law of all states of a short run, stacked."""

import dataclasses

import numpy as np
import pytest

from msg_analysis.inference.errors import given_path as module
from msg_analysis.inference.errors.given_path import given_path
from msg_analysis.inference.errors.time_means import time_means
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.model.experiment.experiment import ValidExperiment
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
    trajectory = simulate(ValidExperiment.parse(document))
    return Observation.of(trajectory, predict(trajectory.record.experiment))


def by_hand(observation):
    """Mean and covariance of the time means of the node errors of one replica mean, from N(mu, S) of all states."""
    experiment, m, steps = observation.prediction.experiment, 3, observation.steps
    dt, noise = experiment.run.dt, experiment.noise
    consensus = experiment.problem == "consensus"
    size = m * steps
    transfer, sources = np.zeros((size, m)), np.zeros((size, 0))
    transfer[:m] = np.eye(m)
    for k in range(1, steps):
        graph = experiment.graph_list[observation.modes[k - 1]].adjacency
        weights = dt * graph
        for i in range(m):
            for d, j in enumerate(np.flatnonzero(graph[i])):
                if observation.lost is not None and observation.lost[k - 1, i, d]:
                    weights[i, j] = 0.0
        step = np.eye(m) + weights - np.diag(weights.sum(axis=1)) - np.diag(dt * experiment.leader_gains)
        added = [np.sqrt(dt) * experiment.noise_gain[observation.modes[k - 1]], noise.broadcast * weights]
        added += [noise.link * np.diag(row) for row in weights.T]
        new = np.concatenate(added, axis=1)
        rows, before = slice(m * k, m * k + m), slice(m * k - m, m * k)
        transfer[rows] = step @ transfer[before]
        sources = np.concatenate([sources, np.zeros((size, new.shape[1]))], axis=1)
        sources[rows] = step @ sources[before]
        sources[rows, -new.shape[1] :] = new
    centre = np.eye(m) - (1.0 / m if consensus else 0.0)
    forms = [np.kron(np.eye(steps), np.outer(row, row)) / steps for row in centre]
    spread = sources @ sources.T
    replicas, mean, covariance = observation.replicas, np.zeros(m), np.zeros((m, m))
    for start in (observation.start - experiment.reference).T:
        mu = transfer @ start
        for a in range(m):
            mean[a] += (np.trace(forms[a] @ spread) + mu @ forms[a] @ mu) / replicas
            for b in range(m):
                both = forms[a] @ spread @ forms[b]
                covariance[a, b] += (2 * np.trace(both @ spread) + 4 * mu @ both @ mu) / replicas**2
    return mean, covariance


@pytest.mark.parametrize("case", CASES)
def test_against_the_law_of_all_states(case):
    observation = observe(CASES[case])
    means = time_means(observation)
    found = given_path(observation, means)
    mean, covariance = by_hand(observation)
    np.testing.assert_allclose(found.expected, mean, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    y = observation.states[:-1] - observation.step.reference
    if observation.prediction.experiment.problem == "consensus":
        y = y - y.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(found.measured, (y**2).mean(axis=(0, 2)), rtol=1e-12)
    np.testing.assert_allclose(found.predicted, means.nodes @ means.predicted, rtol=1e-12)
    error = found.system_error
    assert error.measured == pytest.approx((found.measured - mean + found.predicted).sum())
    assert error.standard_error == pytest.approx(np.sqrt(covariance.sum()), rel=1e-9)
    assert [node.z for node in found.node_errors] == pytest.approx(
        (found.measured - mean) / np.sqrt(np.diag(covariance))
    )


def test_it_is_left_out_where_it_would_take_long(monkeypatch):
    observation = observe(BASE)
    means = time_means(observation)
    assert given_path(observation, dataclasses.replace(means, joint=False)) is None
    monkeypatch.setattr(module, "MAX_NUMBERS", 1)
    assert given_path(observation, means) is None


def test_slow_switching_makes_it_much_better():
    """20 switches: the path makes most of the variance of the plain mean."""
    slow = BASE | {
        "switching": {"generator": [[-0.05, 0.05], [0.05, -0.05]]},
        "graphs": {"line": {"path": [1, 2, 3]}, "all": {"complete": True}},
        "run": {"dt": 0.1, "duration": 400, "replicas": 4, "seed": 1},
    }
    observation = observe(slow)
    found = given_path(observation, time_means(observation))
    assert 0.05 < found.variance_ratio < 0.5
