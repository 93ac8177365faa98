"""The twin against a naive loop, and what it draws against what it should have drawn."""

import numpy as np
import pytest
import scipy.stats
from tests.analysis.twin.test_links import LAWS, four_agents

from experiments import new_record, predict, simulate
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.step_model import build_step_model


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
    """30 independent seeds, 30 replicas, forty steps after a stationary start."""
    # z of the mean over seeds (replicas share lost messages), p > 3e-5 by Student's t with 29 degrees of freedom, for 4
    # agents of 17 cases: a right program fails with probability about 2e-3. An error wrong by a third fails.
    duration = 40 if LAWS[law].get("time") == "discrete" else 2
    setup = four_agents(law, air, replicas=30, duration=duration, start="stationary")
    means = []
    for seed in range(30):
        states = simulate(setup.with_run(seed=seed)).states[-1]
        deviation = states - (states.mean(axis=0) if setup.problem == "consensus" else setup.reference)
        means.append((deviation**2).mean(axis=1))
    spread = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    z = (np.mean(means, axis=0) - predict(setup).emulated.node_errors) / np.where(spread > 0, spread, 1.0)
    assert 2 * scipy.stats.t.sf(np.abs(z).max(), len(means) - 1) > 3e-5


def test_stationary_start_has_the_covariance_of_its_graph() -> None:
    """Chi-square on the half-vectorised covariance of 22,000 replicas, p > 1e-4: the false-alarm rate."""
    # So many replicas have no past: their start is normal. tests/analysis/theory/test_sequential.py has those with one.
    setup = four_agents("tracking", "plain", replicas=22_000, start="stationary")
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
    setup = four_agents("consensus", "plain")
    first, again, other = simulate(setup), simulate(setup.with_run(duration=34)), simulate(setup.with_run(seed=6))
    for one, two, three in ((first.states, again.states, other.states), (first.modes, again.modes, other.modes)):
        assert np.array_equal(one, two[: len(one)])
        assert not np.array_equal(one[1:], three[1:])
