"""The sequential law: agents one after the other in every period."""

import dataclasses
import functools

import numpy as np
import pytest

from experiments import line_ring, predict, simulate
from msg_analysis.model.graph_path import past_modes
from msg_analysis.model.step_model import build_run_model, build_step_model, phases

CORRELATED = [[1.0, 0.3, 0.0, 0.0], [0.0, 0.5, 0.2, 0.0], [0.0, 0.0, 2.0, 0.0], [0.1, 0.0, 0.0, 0.7]]
GRAPHS = {"a": {"path": [1, 2, 3, 4]}, "b": {"arcs": [[1, 2], [2, 3, 2.0], [3, 1], [1, 3], [3, 4], [4, 1]]}}


def in_turn(**changes):
    """Four agents on a path and on weighted arcs."""
    run = {"dt": 0.1, "pace": "realtime", "replicas": 1, "seed": 5} | changes.pop("run", {})
    return line_ring(**{"graphs": GRAPHS, "switching": {"generator": [[-1.0, 1.0], [2.0, -2.0]]}} | changes, run=run)


TRACKING = {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.7, "reference": 2.5}}
GROUNDED = {"problem": "tracking", "leaders": {"agents": [2], "gain": float("inf"), "reference": 1.0}}
DISCRETE = {"time": "discrete", "switching": {"transition": [[0.9, 0.1], [0.3, 0.7]]}, "run": {"dt": 1.0}}
CASES = {
    "consensus": in_turn(),
    "correlated": in_turn(noise={"process": CORRELATED}),
    "noise by graph": in_turn(noise={"process": {"a": 1.0, "b": CORRELATED}}),
    "tracking": in_turn(**TRACKING),
    "grounded": in_turn(**GROUNDED),
    "discrete": in_turn(**DISCRETE),
}


@pytest.mark.parametrize("case", CASES)
def test_a_period_is_its_micro_steps(case):
    """Against micro-steps that each change one agent, in the order of the phases."""
    what = CASES[case]
    step, run = build_step_model(what), build_run_model(what)
    random = np.random.default_rng(2)
    for mode in range(2):
        x, v = random.standard_normal((4, 7)), random.standard_normal((4, 7))
        found = run.weights[mode] @ x + run.noise_gain[mode] @ v + run.offsets[mode][:, None]
        for i in np.argsort(phases(what)):
            micro = np.eye(4)
            micro[i] = step.weights[mode, i]
            noise = np.zeros((4, 7))
            noise[i] = step.noise_gain[mode, i] @ v + step.offsets[mode, i]
            x = micro @ x + noise
        np.testing.assert_allclose(found, x, atol=1e-13)
        np.testing.assert_allclose(run.noise[mode], run.noise_gain[mode] @ run.noise_gain[mode].T, atol=1e-15)
    np.testing.assert_allclose(run.weights.sum(axis=2), 1.0 - run.offsets / (what.reference or 1.0), atol=1e-14)


@pytest.mark.parametrize("case", CASES)
def test_a_run_goes_on_from_its_past(case):
    """2,000 replicas: second moments at the start and 200 steps later, given the graphs since long before, within 5 of
    their standard errors; a right program fails with a probability below 1e-3.
    """
    what = CASES[case].with_run(replicas=2000, duration=200 * CASES[case].run.dt)
    trajectory, model = simulate(what), build_run_model(what)
    centre = np.eye(4) - (0.25 if what.problem == "consensus" else 0.0)
    y = centre @ (trajectory.states - what.reference)
    moment = np.zeros((4, 4))
    for g in past_modes(what, int(trajectory.modes[0]), 2000):
        moment = centre @ (model.weights[g] @ moment @ model.weights[g].T + model.noise[g]) @ centre
    moments = [moment]
    for g in trajectory.modes:
        moments.append(centre @ (model.weights[g] @ moments[-1] @ model.weights[g].T + model.noise[g]) @ centre)
    for k in (0, 1, 7, 199):
        measured, moment = y[k] @ y[k].T / 2000, moments[k]
        error = np.sqrt((np.outer(np.diag(moment), np.diag(moment)) + moment**2) / 2000)
        assert (np.abs(measured - moment) <= 5 * error + 1e-9).all()


@functools.cache
def many_pasts(time):
    """(2, 1000, 400): graphs of 1,000 pasts of each g(0); of the chain only, which all cases but one share."""
    what = CASES["discrete" if time == "discrete" else "consensus"]
    specs = [what.spec.model_copy(update={"run": what.run.model_copy(update={"seed": seed})}) for seed in range(1000)]
    seeded = [dataclasses.replace(what, spec=spec) for spec in specs]  # as by ``with_run``, which checks each again
    return np.array([[past_modes(one, mode, 400) for one in seeded] for mode in range(2)])


@pytest.mark.parametrize("case", CASES)
def test_the_past_is_stationary(case):
    """Second moments given the graphs of a past of 400 steps, over 1,000 pasts of each g(0): their mean within 5 of its
    standard errors, and of what is left of the beginning; a right program fails with a probability below 1e-3.
    """
    what = CASES[case]
    model, prediction = build_run_model(what), predict(what)
    centre = np.eye(4) - (0.25 if what.problem == "consensus" else 0.0)
    weights, noise = centre @ model.weights, centre @ model.noise @ centre
    for mode in range(2):
        pasts = many_pasts(what.time)[mode]
        moments = np.zeros((1000, 4, 4))
        for graphs in pasts.T:
            w = weights[graphs]
            moments = w @ moments @ w.transpose(0, 2, 1) + noise[graphs]
        exact = prediction.emulated.by_mode[mode] / model.stationary[mode]
        error = moments.std(axis=0) / np.sqrt(1000)
        assert (np.abs(moments.mean(axis=0) - exact) <= 5 * error + 1e-4 * np.abs(exact).max()).all()
