"""Runs whose messages are noisy, late, lost or held, next to laws given what their log says was heard.

Runs come from a simulator of its own (``tests.support.message_runs``). Expectations are computed from the log by brute
force: every state as a combination of the start and of all noise.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from msg_analysis.inference.hypothesis_tests.innovations import InnovationSums, innovations
from msg_analysis.inference.hypothesis_tests.losses import LossTally, loss_test
from msg_analysis.inference.observed.heard_values import HeardValues
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.observed.repeated_noise import RepeatedNoise
from msg_analysis.inference.realtime.event_order import newest_steps, order_events
from msg_analysis.inference.realtime.logged_pattern import means_in_lockstep, pattern_means
from msg_analysis.inference.verdict.compare import compare
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.theory.prediction import predict
from tests.support.message_runs import message_run
from tests.support.switching_systems import LINE_RING

AIR = {"broadcast": 0.4, "link": 0.6}
LATE = {"late": 0.4, "latency": 0.5}
TRACKING = {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.7, "reference": 1.5}}
CASES = {
    "lockstep, held": ({"loss": 0.5, "on_loss": "hold"}, {}, {}),
    "lockstep, held, noisy": ({"loss": 0.5, "on_loss": "hold", **AIR}, {}, {}),
    "lockstep, own, delay": ({"loss": 0.4, "delay": 2, **AIR}, {}, {}),
    "lockstep, held, delay, tracking": ({"loss": 0.4, "on_loss": "hold", "delay": 1, **AIR}, TRACKING, {}),
    "real time, noisy": (AIR, {}, {}),
    "real time, own": ({"loss": 0.4, **AIR}, {}, LATE),
    "real time, held": ({"loss": 0.4, "on_loss": "hold", **AIR}, {}, LATE),
    "real time, held, tracking": ({"loss": 0.4, "on_loss": "hold", "link": 0.5}, TRACKING, LATE),
    "real time, held, broadcast": ({"loss": 0.4, "on_loss": "hold", "broadcast": 0.5, "delay": 1}, {}, LATE),
}


def experiment(noise, more=None, **run):
    pace = run.pop("pace", "lockstep")
    run = {"dt": 0.2, "duration": 4, "start": [1.0, -2.0, 0.5, 0.0, 1.0], "pace": pace, "seed": 4} | run
    return ValidExperiment.parse(LINE_RING | {"noise": {"process": 1.0, **noise}, "run": run} | (more or {}))


def observed(case, seed=1, **run):
    noise, more, late = CASES[case]
    what = experiment(noise, more, pace="realtime" if "real time" in case else "lockstep", **run)
    return Observation.of(message_run(what, seed, **late), predict(what))


class Unrolled:
    """All states of a run as combinations of a constant 1 and of independent standard normal numbers."""

    def __init__(self, observation):
        what, step = observation.prediction.experiment, observation.step
        timed = observation if observation.timers else observation.as_timed()
        steps, m = timed.timers.graphs.shape
        links = np.argwhere(step.listens()).tolist()
        weights = [
            np.eye(m) - what.step_length * (np.diag(g.adjacency.sum(axis=1)) - g.adjacency + np.diag(what.leader_gains))
            for g in what.graph_list
        ]
        size = 1 + m * steps + m * (steps + 1) + len(links) * (steps + 1)
        unit, numbers = np.eye(size), iter(range(1, size))
        states = {(0, i): observation.start[i, 0] * unit[0] - what.reference * unit[0] for i in range(m)}
        process = {(k, i): math.sqrt(what.step_length) * unit[next(numbers)] for k in range(steps) for i in range(m)}
        broadcast = {(k, i): step.broadcast * unit[next(numbers)] for k in range(steps + 1) for i in range(m)}
        link = {(k, i, j): step.link * unit[next(numbers)] for k in range(steps + 1) for i, j in links}
        order = np.arange(steps * m)
        if observation.timers:
            order = np.argsort(order_events(observation).position.ravel())
        for k, i in np.column_stack(np.unravel_index(order, (steps, m))).tolist():
            graph = int(timed.timers.graphs[k, i])
            total = weights[graph][i, i] * states[k, i]
            for d, j in enumerate(step.neighbours(graph, i).tolist()):
                s = int(timed.timers.used[k, i, d])
                heard = states[k, i] if s < 0 else states[s, j] + broadcast[s, j] + link[s, i, j]
                total = total + weights[graph][i, j] * heard
            states[k + 1, i] = total + process[k, i]
        newest = newest_steps(timed)[:steps]
        self.sampled = np.array([[states[int(newest[k, i]), i] for i in range(m)] for k in range(steps)])
        if what.problem == "consensus":
            self.sampled -= self.sampled.mean(axis=1, keepdims=True)

    def node_errors(self):
        """(m,) expected time means."""
        return (self.sampled**2).sum(axis=2).mean(axis=0)

    def variance(self):
        """Of the time mean of the system error: v^T Q v with v = (1, normal numbers)."""
        flat = self.sampled.reshape(-1, self.sampled.shape[2])
        form = flat.T @ flat / len(self.sampled)
        return float(2.0 * (form[1:, 1:] ** 2).sum() + 4.0 * (form[0, 1:] ** 2).sum())


def means_of(observation):
    if observation.timers:
        return pattern_means(observation, order_events(observation))
    return means_in_lockstep(observation)


@pytest.mark.parametrize("case", CASES)
def test_expectation_and_variance_given_the_log(case):
    """The expectation exactly; the variance, which is a function of the states, in the mean over many replicas.

    It is a mean over 20,000 replicas with relative spread of about 1: 3 % are four standard errors.
    """
    observation = observed(case, replicas=20_000)
    brute, means = Unrolled(observation), means_of(observation)
    frame = observation.prediction.system.frame
    expected = frame @ means.expected_moments @ frame.T
    np.testing.assert_allclose(np.diag(expected), brute.node_errors(), rtol=1e-10)
    assert means.joint
    variance = means.trace @ means.covariance @ means.trace * observation.replicas
    assert variance == pytest.approx(brute.variance(), rel=0.03)
    measured = means.trace @ means.measured
    assert abs(measured - brute.node_errors().sum()) < 4 * math.sqrt(brute.variance() / observation.replicas)


@pytest.mark.parametrize("case", [case for case in CASES if CASES[case][0].get("link")])
def test_innovations_are_freed_of_noise_that_is_known(case):
    """Against a Cholesky factor of the covariance of all innovations of an agent."""
    observation = observed(case, duration=12)
    step, steps = observation.step, observation.steps
    reception = HeardValues.of(observation, 0, steps)
    e = innovations(observation, 0, steps, reception)
    parts = []
    repeated = RepeatedNoise.of(observation)
    if repeated is None:
        pytest.skip("every message is used once")
    for first in range(0, steps, 7):  # in blocks
        piece = HeardValues.of(observation, first, min(first + 7, steps))
        parts.append(repeated.free(e[first : first + 7], piece))
    freed, variances = (np.concatenate(part) for part in zip(*parts, strict=True))
    for i in range(step.agents):
        covariance = step.dt * np.eye(steps)
        for k in range(steps):
            for late in range(steps):
                for d, w in enumerate(reception.weights[k, i]):
                    for c, v in enumerate(reception.weights[late, i]):
                        same = (reception.senders[k, i, d], reception.used[k, i, d]) == (
                            reception.senders[late, i, c],
                            reception.used[late, i, c],
                        )
                        covariance[k, late] += same * w * v * step.link**2
        factor = np.linalg.cholesky(covariance)
        sizes = np.diag(factor)
        np.testing.assert_allclose(variances[:, i] + step.dt, sizes**2, rtol=1e-9)
        np.testing.assert_allclose(freed[:, i], sizes[:, None] * np.linalg.solve(factor, e[:, i]), atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_right_runs_agree(case):
    """Whole verdicts, one run each: with a right program, one of the nine disagrees with probability 9 %."""
    observation = message_run(
        experiment(
            CASES[case][0],
            CASES[case][1],
            pace="realtime" if "real time" in case else "lockstep",
            duration=60,
            replicas=2,
        ),
        seed=11,
        **CASES[case][2],
    )
    found = compare(observation)
    assert found.verdict == "agrees", [test for test in found.tests if test.rejected]
    names = {test.name for test in found.tests}
    assert {"system error", "covariance", "innovations: gains", "innovations: whiteness"} <= names
    assert found.system_error.predicted == pytest.approx(found.system_error.measured, rel=0.5)
