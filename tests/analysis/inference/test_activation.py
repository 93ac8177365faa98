"""Agents that leave out steps: predictions, runs and verdicts agent by agent."""

import dataclasses
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from p_values import assert_covered

from experiments import TRACKING, compare, line_ring, logged
from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.errors import InputError
from msg_analysis.experiment import limits
from msg_analysis.experiment.experiment import Experiment, ExperimentError
from msg_analysis.experiment.limits import prediction_method
from msg_analysis.experiment.links import ActiveAgents
from msg_analysis.theory.sampling import sampled_prediction
from msg_analysis.twin.simulate import simulate

GOLDEN = {0.05: 1.053297, 0.2: 1.268261, 0.4: 1.861361}
"""System error of a ring of five that makes 0.7 of its steps, by dt; by Kronecker algebra that is not ours."""
RING = {"ring": {"cycle": [1, 2, 3, 4, 5]}}
DIRECTED = {"mesh": {"arcs": [[1, 2, 0.5], [2, 1, 2.0], [2, 3], [3, 2, 0.3], [1, 3]]}}
LEADER = {"mesh": {"arcs": [[1, 2], [2, 3], [3, 2, 0.5], [1, 3]]}}  # agent 1 hears nobody
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "directed": {"agents": 3, "graphs": DIRECTED},
    "hears nobody": {"agents": 3, "graphs": LEADER},
    "air": {"noise": {"broadcast": 0.5, "link": 0.4, "loss": 0.2}},
    "held": {"noise": {"loss": 0.3, "on_loss": "hold"}},
    "late": {"noise": {"delay": 2, "link": 0.3}},
    "tracking": TRACKING,
    "discrete time": {"time": "discrete", "run": {"dt": 1.0, "duration": 600}},
    "real time": {"run": {"pace": "realtime"}},
    "real time, air": {"noise": {"link": 0.4, "loss": 0.2}, "run": {"pace": "realtime"}},
}


def lazy(activation: float = 0.7, dt: float = 0.05, **changes: Any) -> Experiment:
    run = {"dt": dt, "duration": 30, "replicas": 4} | changes.pop("run", {})
    noise = {"activation": activation} | changes.pop("noise", {})
    return line_ring(changes.pop("agents", 5), **{"graphs": RING, "switching": {}} | changes, noise=noise, run=run)


def enumerated(w: np.ndarray, noise: np.ndarray, activation: float, centre: np.ndarray) -> np.ndarray:
    """Second moments (m, m) of the steady state: the mean of W C W^T over all 2^m sets of agents, step by step."""
    m = len(w)
    there = np.array(list(product((0.0, 1.0), repeat=m)))  # (2^m, m)
    chances = np.prod(np.where(there, activation, 1.0 - activation), axis=1)[:, None, None]
    steps = np.where(there[:, :, None], w, np.eye(m))
    added = (chances * there[:, :, None] * there[:, None, :] * noise).sum(axis=0)
    moments = np.zeros((m, m))
    for _ in range(4000):
        after = (chances * (steps @ moments @ steps.transpose(0, 2, 1))).sum(axis=0) + added
        moments = centre @ after @ centre.T
    return moments


@pytest.mark.parametrize("dt", GOLDEN)
def test_rings(dt: float) -> None:
    assert lazy(dt=dt).predict().emulated.system_error == pytest.approx(GOLDEN[dt], abs=1e-6)


@pytest.mark.parametrize("kind", ["consensus", "leader", "held leader", "correlated noise", "discrete time"])
def test_by_enumeration(kind: str) -> None:
    leader = {"problem": "tracking", "leaders": {"agents": [2], "gain": "inf" if kind == "held leader" else 0.8}}
    gain = np.array([[1.0, 0.5, 0.0], [0.0, 0.7, 0.0], [0.0, 0.3, 2.0]]) if kind == "correlated noise" else np.eye(3)
    time = {"time": "discrete", "run": {"dt": 1.0}} if kind == "discrete time" else {}
    changes = (leader if "leader" in kind else {}) | time
    law = lazy(0.6, 0.1, agents=3, graphs=DIRECTED, noise={"process": gain.tolist()}, **changes)
    a = np.zeros((3, 3))
    for source, target, weight in ((1, 2, 0.5), (2, 1, 2.0), (2, 3, 1.0), (3, 2, 0.3), (1, 3, 1.0)):
        a[target - 1, source - 1] = weight
    z = np.diag(a.sum(axis=1)) - a + np.diag([0.0, 0.8 if kind == "leader" else 0.0, 0.0])
    w, noise = (scipy.linalg.expm(-z), gain @ gain.T) if time else (np.eye(3) - 0.1 * z, 0.1 * gain @ gain.T)
    centre = np.eye(3) if "leader" in kind else np.eye(3) - 1.0 / 3.0
    if kind == "held leader":
        centre[1, 1] = 0.0
    found = law.predict().emulated.covariance
    np.testing.assert_allclose(found, enumerated(w, noise, 0.6, centre), rtol=1e-8, atol=1e-12)


def test_many_agents_are_sampled() -> None:
    """Twelve of them, by the mean of D M D over independent coins D; a 99.9 % interval of the sampled error."""
    law = lazy(0.4, 0.2, agents=12, graphs={"ring": {"cycle": list(range(1, 13))}})
    assert [prediction_method(each)[0] for each in (lazy(), law)] == ["exact", "sampled"]
    a = law.written_graphs[0].adjacency
    change, centre = -0.2 * (np.diag(a.sum(axis=1)) - a), np.eye(12) - 1.0 / 12.0
    moments = np.zeros((12, 12))
    for _ in range(6000):
        felt = change @ moments @ change.T + 0.2 * np.eye(12)
        felt = 0.4**2 * felt + 0.4 * 0.6 * np.diag(np.diag(felt))
        moments = centre @ (moments + 0.4 * (change @ moments + moments @ change.T) + felt) @ centre.T
    found = sampled_prediction(law, precision=0.02)
    half = (found.interval[1] - found.interval[0]) / 2.0
    assert abs(found.system_error - np.trace(moments)) < 3.3 / 1.96 * half
    with pytest.raises(InputError, match=r"noise\.activation: .*2\^12 graphs"):
        law.predict()


@pytest.mark.parametrize("leader", [False, True])
def test_sampled_by_matrices(leader: bool) -> None:
    """In discrete time, where there are no sparse steps: a 99.9 % interval of the sampled errors."""
    tracking = {"problem": "tracking", "leaders": {"agents": [2], "gain": "inf"}} if leader else {}
    law = lazy(0.6, 1.0, agents=3, graphs=DIRECTED, time="discrete", **tracking)
    exact, found = law.predict().emulated, sampled_prediction(law, precision=0.04)
    for error, sampled, (low, high) in (
        (exact.system_error, found.system_error, found.interval),
        *zip(exact.node_errors, found.node_errors, found.node_intervals, strict=True),
    ):
        assert abs(sampled - error) <= 3.3 / 1.96 * (high - low) / 2.0 + 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_correct_runs(kind: str) -> None:
    law = lazy(**KINDS[kind])
    runs = [simulate(law.with_run(seed=seed)) for seed in range(12)]
    if kind in ("plain", "hears nobody"):
        rests = (runs[0].states[1:] == runs[0].states[:-1]).all(axis=2)
        assert 0.2 < rests.mean() < 0.4
    found = [compare(run) for run in runs]
    assert_covered(found)
    assert all("links" in [test.name for test in one.tests] for one in found)


def test_an_agent_that_makes_fewer_steps(tmp_path: Path) -> None:
    """One that hears nobody, read from a bag: its steps are known by the names of the graphs alone."""
    law = lazy(agents=3, graphs=LEADER, run={"duration": 200, "replicas": 1})
    assert isinstance(law.links, ActiveAgents)
    made = np.array([0.5, 0.7, 0.7])
    graphs, path = dataclasses.replace(law.links, up=made, down=1.0 - made).drawn(3, law.steps)
    gain = np.broadcast_to(law.noise_gain[0], (len(graphs), 3, 3))
    wrong = dataclasses.replace(law, graph_list=tuple(graphs), switching_law=path, noise_gain=gain)
    write_trajectory(logged(simulate(wrong), law), tmp_path / "bag")
    run = read_bag(tmp_path / "bag")
    assert run.completeness.complete
    found = compare(run)
    assert (found.verdict, found.causes[0].kind, found.causes[0].agent) == ("disagrees", "link", 1)
    assert found.causes[0].words.startswith("agent 1 leaves out a step after one that it made 1.6")


def test_an_agent_that_moves_in_steps_that_it_leaves_out() -> None:
    run = simulate(lazy())
    states = run.states.copy()
    rests = np.flatnonzero((states[1:, 2] == states[:-1, 2]).all(axis=1))
    states[rests[5] + 1 :, 2] += 1e-3
    found = compare(dataclasses.replace(run, states=states))
    assert (found.verdict, found.causes[0].agent) == ("disagrees", 3)


@pytest.mark.parametrize(
    "changes",
    [
        {"noise": {"activation": 0.5}, "switching": {}},
        {"switching": {"links": {"up": 1, "down": 1}}},
    ],
)
def test_a_path_that_does_not_fit(changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """One error, and nothing is drawn, on a machine with 1 GB, in which the states fit."""
    monkeypatch.setattr(limits, "available_memory", lambda: 10**9)
    graphs = {"ring": {"cycle": list(range(1, 1001)), "weight": 0.1}}
    with pytest.raises(ExperimentError, match=r"run: 50000 steps with up to 50000 graphs of 2000 arcs need 2\.4"):
        line_ring(1000, graphs=graphs, **changes, run={"duration": 2500, "replicas": 1})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"activation": 0.0}, "noise.activation: 0.0: expected a number > 0"),
        ({"activation": 1.5}, "noise.activation: 1.5: expected a number <= 1"),
        (
            {
                "graphs": {**RING, "line": {"path": [1, 2, 3, 4, 5]}},
                "switching": {"rates": {"ring": {"line": 1.0}, "line": {"ring": 1.0}}},
            },
            "noise.activation: 0.7: expected one graph that does not switch, not several graphs",
        ),
        ({"switching": {"links": {"up": 1, "down": 1}}}, "not switching.links: remove one of them"),
        ({"switching": {"schedule": [[0, "ring"]]}}, "not switching.schedule: remove one of them"),
        ({"protocol": {"name": "saturated"}}, "not a protocol: remove one of them"),
        ({"run": {"start": "stationary"}}, "run.start: stationary: expected 'zero' or values"),
    ],
)
def test_mistakes(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ExperimentError) as error:
        lazy(**changes)
    assert message in str(error.value)


def test_all_steps_are_made() -> None:
    assert lazy(1.0).links is None
    assert lazy(1.0).predict().continuous_moments is not None
    assert lazy(0.9).predict().continuous_moments is None
