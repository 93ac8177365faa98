# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Radius of the fourth moments against Kronecker powers of the matrices of every possible loss."""

import itertools
from functools import reduce

import numpy as np
import pytest
from tests.analysis.theory.test_message_steps import Brute, parse

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import build_run_model
from msg_analysis.theory.fourth_moments import (
    FourthMoment,
    advance,
    fourth_moment,
    fourth_radius,
    lyapunov_bound,
    random_steps,
    second_radius,
)
from msg_analysis.theory.prediction import predict

HEAVY = {  # found by a random search: the second moments are finite, the fourth are not
    "name": "heavy",
    "graphs": {
        "a": {"arcs": [[1, 2, 0.3], [1, 3, 3.0], [3, 2, 0.3]]},
        "b": {"arcs": [[2, 3, 3.0], [3, 1, 3.0]]},
    },
    "switching": {"generator": [[-0.05, 0.05], [0.05, -0.05]]},
    "noise": {"process": 1.0},
    "run": {"dt": 0.6, "duration": 60.0},
}
LOSSY = HEAVY | {
    "graphs": {
        "a": {"arcs": [[1, 3, 3.0], [3, 1, 3.0], [3, 2, 0.3]]},
        "b": {"arcs": [[1, 3, 3.0], [2, 1, 3.0], [3, 1, 3.0], [3, 2, 3.0]]},
    },
    "switching": {"generator": [[-0.2, 0.2], [0.2, -0.2]]},
    "noise": {"process": 1.0, "loss": 0.3},
    "run": {"dt": 0.323, "duration": 32.3},
}


def of(document, **noise):
    experiment = Experiment.parse(document | {"noise": document["noise"] | noise})
    prediction = predict(experiment)
    return build_run_model(experiment, prediction.step), prediction


def power(vector):
    """(d^4,) of a vector (d,), or the Kronecker power of a matrix."""
    return reduce(np.kron, [vector] * 4)


def kronecker_radius(document):
    """Of E[A^(4)] of all outcomes of the losses of a step in which lost messages are replaced by own values."""
    step, prediction = of(document)
    system = prediction.system
    blocks = []
    for mode in range(step.modes):
        lossy = np.argwhere(step.loss_variance[mode] > 0.0).tolist()
        total = 0.0
        for lost in itertools.product([0, 1], repeat=len(lossy)):
            weights, chance = step.nominal[mode].copy(), 1.0
            for (i, j), is_lost in zip(lossy, lost, strict=True):
                chance *= step.losses[i, j] if is_lost else 1.0 - step.losses[i, j]
                if is_lost:
                    weights[i, i] += weights[i, j]
                    weights[i, j] = 0.0
            total = total + chance * power(system.lift.T @ weights @ system.lift)
        blocks.append(total)
    whole = np.block([[p * block for p, block in zip(column, blocks, strict=True)] for column in step.transition.T])
    return float(np.abs(np.linalg.eigvals(whole)).max())


@pytest.mark.parametrize("document", [HEAVY, LOSSY], ids=["switching", "losses"])
def test_the_radius_is_that_of_the_kronecker_powers(document):
    step, prediction = of(document)
    found = prediction.fourth_moment
    assert found.radius == pytest.approx(kronecker_radius(document), rel=1e-8)
    assert found.radius > 1.0
    assert found.finite is False
    assert second_radius(prediction.system) < 1.0
    assert fourth_moment(step, prediction.system) == found


@pytest.mark.parametrize(
    "case",
    [
        "held",
        "own, by link",
        "own, bursts",
        "real time, own",
        "real time, held",
        "held, delay",
        "real time, own, delay",
    ],
)
def test_fourth_moments_from_a_known_start(case):
    """E[y^4] without noise, over three steps of messages that are lost, late, held or used one after the other.

    By Kronecker powers of the matrices of every outcome, in the coordinates of all states and all that was heard.
    """
    experiment = parse(case)
    prediction = predict(experiment)
    system = prediction.system
    steps = random_steps(build_run_model(experiment, prediction.step), system)
    brute = Brute(case, experiment)
    x = np.array([1.0, -2.0, 0.5][: experiment.agents])
    place = [*range(brute.m)]
    for j in [*range(brute.m), *[j for _, j in brute.links]]:
        place += [j] * (brute.delay + 1)
    chain, law = brute.laws()
    maps = brute.maps()[:, :, : brute.size]
    # The state after k steps is a product of maps: all sequences of modes, each with its probability.
    expected = np.zeros((4, brute.m))
    alive = [(law[mode], mode, x[place]) for mode in range(len(maps)) if law[mode] > 0.0]
    y = system.reduced(x)
    of_modes = system.of_modes(prediction.step.stationary)
    stack = of_modes[:, None, None, None, None] * power(y).reshape((len(y),) * 4)
    for k in range(3):
        expected[k] = sum(p * centred(z[: brute.m], experiment) ** 4 for p, _, z in alive)
        rows = system.output
        tensor = stack.sum(axis=0)
        np.testing.assert_allclose(np.einsum("abcd,ia,ib,ic,id->i", tensor, *[rows] * 4), expected[k], rtol=1e-9)
        if len(alive) * len(maps) > 300_000:
            break
        alive = [
            (p * chain[mode, after], after, maps[mode] @ z)
            for p, mode, z in alive
            for after in range(len(maps))
            if chain[mode, after] > 0.0
        ]
        stack = advance(steps, stack)
    assert k > 0


def centred(x, experiment):
    return x - x.mean() if experiment.problem == "consensus" else x


def test_bounds_hold_the_exact_radius():
    """From below by the second moments, from above by a Lyapunov function; both for the heavy and a light law."""
    for document in (HEAVY, HEAVY | {"run": {"dt": 0.1, "duration": 10.0}}):
        _, prediction = of(document)
        exact, system = prediction.fourth_moment.radius, prediction.system
        assert second_radius(system) ** 2 <= exact * (1.0 + 1e-9)
        assert exact <= lyapunov_bound(system) * (1.0 + 1e-9)


@pytest.mark.parametrize("noise", [{}, {"loss": 0.3}, {"loss": 0.3, "on_loss": "hold"}])
def test_means_with_weights_that_are_not_negative_have_light_tails(noise):
    step, prediction = of(HEAVY | {"run": {"dt": 0.1, "duration": 10.0}}, **noise)
    exact = fourth_radius(random_steps(step, prediction.system))
    assert exact <= second_radius(prediction.system)
    assert prediction.fourth_moment.finite is True


def test_what_is_too_large_is_bounded():
    """20 agents: bounds only, and still finite, since every agent takes a mean."""
    document = {
        "name": "large",
        "graphs": {"ring": {"cycle": list(range(1, 21))}, "star": {"star": {"center": 1}}},
        "agents": 20,
        "switching": {"generator": [[-1.0, 1.0], [1.0, -1.0]]},
        "noise": {"process": 1.0, "loss": 0.2},
        "run": {"dt": 0.05, "duration": 5.0},
    }
    _, prediction = of(document)
    found = prediction.fourth_moment
    assert found.radius is None
    assert found.lower == pytest.approx(found.upper**2)
    assert found.finite


@pytest.mark.parametrize(("lower", "upper", "finite"), [(1.1, None, False), (0.5, 0.9, True), (0.9, 1.2, None)])
def test_what_bounds_say(lower, upper, finite):
    assert FourthMoment.between(lower, upper).finite is finite
