"""The twin against a naive loop, and what it draws against what it should have drawn."""

from typing import Any

import numpy as np
import pytest
import scipy.stats
from tests.analysis.twin.test_links import LAWS, experiment

from experiments import Run, line_ring, new_record, predict, simulate
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.step_model import build_step_model

AIR = {"broadcast": 0.3, "link": 0.2, "loss": 0.3}


@pytest.mark.parametrize(
    ("law", "air"),
    [(law, "plain") for law in LAWS if "protocol" not in LAWS[law]]
    + [
        (law, air)
        for law in ("consensus", "tracking", "grounded", "discrete", "leaders of discrete time alone heard")
        for air in ("own", "late and lost")
    ],
)
def test_mean_square_error_is_the_predicted_one(law: str, air: str) -> None:
    """30 independent seeds, 60 replicas, forty steps after a stationary start.

    z of the mean over seeds (replicas share lost messages), p > 3e-5 by Student's t with 29 degrees of freedom, for 4
    agents of 17 cases: a right program fails with probability about 2e-3. An error wrong by a third fails.
    """
    duration = 40 if LAWS[law].get("time") == "discrete" else 2
    setup = experiment(law, air, replicas=60, duration=duration, start="stationary")
    means = []
    for seed in range(30):
        states = simulate(setup.with_run(seed=seed)).states[-1]
        deviation = states - (states.mean(axis=0) if setup.problem == "consensus" else setup.reference)
        means.append((deviation**2).mean(axis=1))
    spread = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    z = (np.mean(means, axis=0) - predict(setup).emulated.node_errors) / np.where(spread > 0, spread, 1.0)
    assert 2 * scipy.stats.t.sf(np.abs(z).max(), len(means) - 1) > 3e-5


def test_stationary_start_has_the_covariance_of_its_graph() -> None:
    """Chi-square on the half-vectorised covariance of 22,000 replicas, p > 1e-4: the false-alarm rate.

    So many replicas have no past: their start is normal. tests/analysis/theory/test_sequential.py has those with one.
    """
    setup = experiment("tracking", "plain", replicas=22_000, start="stationary")
    prediction = predict(setup)
    record = new_record(setup)
    mode = int(mode_path(setup, build_step_model(setup).initial)[0])
    share = prediction.to_json()["stationary"][mode]
    expected = np.array(prediction.to_json()["emulated"]["mode_second_moments"][mode]) / share
    factor = np.linalg.cholesky(expected)
    white = np.linalg.solve(factor, record.start - setup.reference)
    n = white.shape[1]
    scatter = white @ white.T / n
    statistic = n / 2 * ((scatter - np.eye(4)) ** 2).sum()
    assert scipy.stats.chi2.sf(statistic, 10) > 1e-4


def test_seeds_and_lengths() -> None:
    """Same seed, same run; a longer run begins like the shorter one."""
    setup = experiment("consensus", "plain")
    first, again, other = simulate(setup), simulate(setup), simulate(setup.with_run(seed=6))
    assert np.array_equal(first.states, again.states)
    assert np.array_equal(first.modes, again.modes)
    assert not np.array_equal(first.states[1], other.states[1])
    assert not np.array_equal(first.modes, other.modes)
    long = simulate(setup.with_run(duration=34))
    assert np.array_equal(first.states, long.states[: len(first.states)])
    assert np.array_equal(first.modes, long.modes[: len(first.modes)])


def test_another_agent_changes_nobody_elses_noise() -> None:
    """Agents 1 and 2 hear nothing of agents 3 and 4, who come later: their states and the fates of messages stay."""
    graphs = {"a": {"arcs": [[1, 2], [2, 1], [2, 3]]}, "b": {"arcs": [[1, 2], [2, 1], [3, 4]]}}
    shared = {"noise": AIR}
    two = simulate(line_ring(graphs={key: {"path": [1, 2]} for key in "ab"}, run={"start": [1, 2]}, **shared))
    four = simulate(line_ring(graphs=graphs, run={"start": [1, 2, 0, 0]}, **shared))
    assert np.array_equal(two.states, four.states[:, :2])
    assert np.array_equal(two.published, four.published[:, :2])
    assert np.array_equal(two.lost, four.lost[:, :2, :1])


def test_the_air_depends_on_nothing_else() -> None:
    """Other replicas, weights, process noise, another agent: the same messages are lost, in the same steps."""

    def flown(agents: int = 3, **changes: Any) -> Run:
        graphs = {key: {"path": list(range(1, agents + 1))} for key in "ab"}
        run = {"dt": 0.05, "replicas": 1, "seed": 5, "start": "zero"} | changes.pop("run", {})
        return simulate(line_ring(agents, **{"graphs": graphs, "noise": AIR} | changes, run=run))

    one = flown()
    heavy = {"a": {"edges": [[1, 2, 2.0], [2, 3]]}, "b": {"edges": [[1, 2], [2, 3, 3.0]]}}
    for other in (flown(graphs=heavy), flown(noise=AIR | {"process": 0.1}), flown(4)):
        noise, others = one.published - one.states, other.published - other.states
        np.testing.assert_allclose(noise, others[:, :3], atol=1e-12)
        assert np.array_equal(one.lost[:, :2], other.lost[:, :2])
    assert np.array_equal(one.lost, flown(run={"replicas": 7}).lost)
