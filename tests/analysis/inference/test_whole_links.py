"""Losses that take both directions of a link: predictions, runs and verdicts."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from p_values import assert_covered

from experiments import compare, line_ring
from msg_analysis.experiment.experiment import Experiment, ExperimentError
from msg_analysis.experiment.limits import unpredictable
from msg_analysis.twin.simulate import simulate

GOLDEN = {
    0.05: {0.2: 1.313873, 0.5: 2.095401, 0.8: 5.221667},
    0.2: {0.2: 1.570856, 0.5: 2.468401, 0.8: 6.066275},
    0.4: {0.2: 2.302632, 0.5: 3.384615, 0.8: 7.943925},
}
"""System error of a ring of five by dt and loss, by brute-force Kronecker algebra that is not ours."""
ARCS = {"mesh": {"arcs": [[1, 2, 0.5], [2, 1, 2.0], [2, 3], [3, 2, 0.3], [3, 1]]}}


def whole(loss: Any = 0.5, dt: float = 0.2, **changes: Any) -> Experiment:
    run = {"dt": dt, "duration": 60, "replicas": 4} | changes.pop("run", {})
    noise = {"loss": loss, "whole_link": True} | changes.pop("noise", {})
    graphs = {"graphs": {"ring": {"cycle": [1, 2, 3, 4, 5]}}, "switching": {}}
    return line_ring(5, **graphs | changes, noise=noise, run=run)


@pytest.mark.parametrize("dt", GOLDEN)
def test_rings(dt: float) -> None:
    for loss, error in GOLDEN[dt].items():
        assert whole(loss, dt).predict().emulated.system_error == pytest.approx(error, abs=1e-6)


@pytest.mark.parametrize("tracking", [False, True])
def test_directed_links_by_enumeration(tracking: bool) -> None:
    """Unequal weights, and a link of one direction: the mean of W C W^T over all 2^3 losses, step by step."""
    leaders = {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.8}} if tracking else {}
    law = whole({"edges": [[1, 2, 0.4], [2, 3, 0.6]], "arcs": []}, 0.1, agents=3, graphs=ARCS, **leaders)
    probability = {(0, 1): 0.4, (1, 2): 0.6}
    a = law.graph_list[0].adjacency
    steps = []
    for first in (0, 1):
        for second in (0, 1):
            there, chance = a.copy(), 1.0
            for (i, j), up in zip(probability, (first, second), strict=True):
                chance *= 1 - probability[i, j] if up else probability[i, j]
                there[i, j] *= up
                there[j, i] *= up
            z = np.diag(there.sum(axis=1)) - there + np.diag([0.0, 0.8, 0.0]) * tracking
            steps.append((chance, np.eye(3) - 0.1 * z))
    centre = np.eye(3) - (0.0 if tracking else 1.0 / 3.0)
    moments = np.zeros((3, 3))
    for _ in range(4000):
        moments = sum(chance * w @ moments @ w.T for chance, w in steps) + 0.1 * np.eye(3)
        moments = centre @ moments @ centre.T
    np.testing.assert_allclose(law.predict().emulated.covariance, moments, rtol=1e-8)


def test_variance_of_the_error_of_a_run() -> None:
    """Of 200 runs; a standard deviation of 200 is within 18 % but with probability 4e-4."""
    law = whole(0.5, run={"duration": 100, "replicas": 1})
    errors = []
    for seed in range(200):
        x = simulate(law.with_run(seed=seed)).states[:, :, 0]
        errors.append(np.square(x - x.mean(axis=1, keepdims=True)).sum(axis=1).mean())
    variance = law.plan(0.05).precision.variance
    expected = math.sqrt((variance.path + variance.replica) / law.steps)
    assert np.std(errors, ddof=1) == pytest.approx(expected, rel=0.18)


def test_correct_runs_and_directions_that_are_lost_alone() -> None:
    law = whole()
    runs = [simulate(law.with_run(seed=seed)) for seed in range(12)]
    for run in runs[:2]:
        assert run.lost is not None
        assert 0.45 < run.lost.mean() < 0.55
    found = [compare(run) for run in runs]
    assert_covered(found)
    alone = simulate(law.with_noise(whole_link=None))
    wrong = compare(dataclasses.replace(alone, record=dataclasses.replace(alone.record, experiment=law)))
    assert (wrong.verdict, wrong.causes[0].kind) == ("disagrees", "loss")
    assert "one direction of a link was lost without the other" in wrong.causes[0].words


@pytest.mark.parametrize(
    "changes",
    [{"noise": {"on_loss": "hold"}}, {"noise": {"delay": 1}}, {"noise": {"link": 0.1}}, {"run": {"pace": "realtime"}}],
)
def test_what_has_no_prediction(changes: dict[str, Any]) -> None:
    law = whole(**changes)
    assert "noise.whole_link: true: has no exact prediction with" in (unpredictable(law) or "")
    assert compare(simulate(law)).verdict == "unpredicted"


@pytest.mark.parametrize(
    ("loss", "message"),
    [(0.0, "expected with noise.loss"), ({"arcs": [[1, 2, 0.5]]}, "expected one probability for both directions")],
)
def test_mistakes(loss: Any, message: str) -> None:
    with pytest.raises(ExperimentError, match=message):
        whole(loss)
