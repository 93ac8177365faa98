"""The twin against a naive loop, and what it draws against what it should have drawn."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, Stream, generator
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.graph_path import mode_path
from msg_analysis.model.step_model import build_step_model
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import new_record, simulate

CORRELATED = [[1.0, 0.3, 0.0], [0.3, 0.8, 0.0], [0.0, 0.5, 0.9]]
CASES = {
    "consensus": {"graphs": {"a": {"path": [1, 2, 3]}, "b": {"edges": [[1, 3, 0.5]]}}},
    "correlated": {
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"cycle": [1, 2, 3]}},
        "noise": {"process": CORRELATED},
    },
    "tracking": {
        "problem": "tracking",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"arcs": [[3, 1, 2.0], [1, 2], [2, 3]]}},
        "leaders": {"agents": [2], "gain": 0.7, "reference": 2.5},
    },
    "grounded": {
        "problem": "tracking",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"star": {"center": 1}}},
        "leaders": {"agents": [1], "gain": float("inf"), "reference": -1.0},
    },
    "noise by graph": {
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"cycle": [1, 2, 3]}},
        "noise": {"process": {"b": CORRELATED, "a": [0.0, 2.0, 1.0]}},
    },
    "noise of grounded leaders by graph": {
        "problem": "tracking",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"star": {"center": 1}}},
        "noise": {"process": {"a": 0.3, "b": CORRELATED}},
        "leaders": {"agents": [1], "gain": float("inf"), "reference": -1.0},
    },
    "discrete": {
        "time": "discrete",
        "graphs": {"a": {"path": [1, 2, 3]}, "b": {"complete": True}},
        "agents": 3,
        "noise": {"process": CORRELATED},
    },
}


def experiment(case: str, **run: object) -> Experiment:
    document: dict = {"name": "case"} | CASES[case]
    discrete = document.get("time") == "discrete"
    document["switching"] = (
        {"transition": [[0.9, 0.1], [0.3, 0.7]]} if discrete else {"generator": [[-1.0, 1.0], [2.0, -2.0]]}
    )
    document["run"] = {"dt": 1.0 if discrete else 0.1, "duration": 600 if discrete else 60, "seed": 5} | run
    return Experiment.parse(document)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("replicas", [1, 3])
def test_equals_a_loop_over_numbers_to_the_last_bit(case: str, replicas: int) -> None:
    """x_i(k+1) = sum_j W_ij x_j(k) + (noise_i(k) + offset_i), one Python float after the other."""
    setup = experiment(case, replicas=replicas)
    trajectory = simulate(setup)
    model = build_step_model(setup)
    sources: dict[tuple[int, int], np.ndarray] = {}
    x = trajectory.states[0].tolist()
    for k, mode in enumerate(trajectory.modes):
        block, within = divmod(k, STEPS_PER_BLOCK)
        following = []
        for i in range(3):
            row = []
            for r in range(replicas):
                total = None
                for j in range(3):
                    if model.weights[mode, i, j] or j == i:
                        term = float(model.weights[mode, i, j]) * x[j][r]
                        total = term if total is None else total + term
                noise = None
                for j in range(3):
                    if model.noise_gain[mode, i, j]:
                        if (j, block) not in sources:
                            shape = (STEPS_PER_BLOCK, replicas)
                            random = generator(5, Stream.PROCESS, j, block)
                            sources[j, block] = random.standard_normal(shape)
                        term = float(model.noise_gain[mode, i, j]) * float(sources[j, block][within, r])
                        noise = term if noise is None else noise + term
                row.append(total + ((noise or 0.0) + float(model.offsets[mode, i])))
            following.append(row)
        x = following
        assert x == trajectory.states[k + 1].tolist(), k


@pytest.mark.parametrize("case", CASES)
def test_agents_alone_equal_the_whole(case: str) -> None:
    setup = experiment(case, replicas=2)
    trajectory = simulate(setup)
    model = build_step_model(setup)
    laws = [agent_law(trajectory.record, model, i) for i in range(3)]
    for k, mode in enumerate(trajectory.modes):
        x = trajectory.states[k]
        for i, law in enumerate(laws):
            state = law.advance(mode, [x[j].tobytes() for j in law.neighbours(mode)])
            assert state == trajectory.states[k + 1, i].tobytes()


@pytest.mark.parametrize("case", CASES)
def test_mean_square_error_is_the_predicted_one(case: str) -> None:
    """4,000 independent replicas of independent seeds, a hundred steps after a stationary start.

    |z| < 4.5 for each of 3 agents and 7 cases: a right program fails with probability 2e-4.
    """
    setup = experiment(case, replicas=100, duration=10 if case != "discrete" else 100)
    steady = predict(setup).to_json()
    errors = np.array(steady["discrete" if case == "discrete" else "emulated"]["node_errors"])
    means = []
    for seed in range(40):
        states = simulate(setup.with_run(seed=seed)).states[-1]
        deviation = states - (states.mean(axis=0) if setup.problem == "consensus" else setup.reference)
        means.append((deviation**2).mean(axis=1))
    spread = np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    z = (np.mean(means, axis=0) - errors) / np.where(spread > 0, spread, 1.0)
    assert np.abs(z).max() < 4.5


def test_stationary_start_has_the_covariance_of_its_graph() -> None:
    """Chi-square on the half-vectorised covariance of 22,000 replicas, p > 1e-4: the false-alarm rate.

    So many replicas have no past: their start is normal. tests/analysis/theory/test_sequential.py has those with one.
    """
    setup = experiment("tracking", replicas=22_000)
    prediction = predict(setup)
    record = new_record(setup)
    mode = int(mode_path(setup, build_step_model(setup).initial)[0])
    share = prediction.to_json()["stationary"][mode]
    expected = np.array(prediction.to_json()["emulated"]["mode_second_moments"][mode]) / share
    factor = np.linalg.cholesky(expected)
    white = np.linalg.solve(factor, record.start - setup.reference)
    n = white.shape[1]
    scatter = white @ white.T / n
    statistic = n / 2 * ((scatter - np.eye(3)) ** 2).sum()
    assert scipy.stats.chi2.sf(statistic, 6) > 1e-4


def test_same_seed_same_run_other_seed_other_run() -> None:
    setup = experiment("consensus", replicas=2)
    first, again, other = simulate(setup), simulate(setup), simulate(setup.with_run(seed=6))
    assert np.array_equal(first.states, again.states)
    assert np.array_equal(first.modes, again.modes)
    assert not np.array_equal(first.states[1], other.states[1])
    assert not np.array_equal(first.modes, other.modes)


def test_another_agent_changes_nobody_elses_noise() -> None:
    """Agents 1 and 2 exchange nothing with agents 3 and 4, who come later, in this graph: their states stay."""
    chain = {"generator": [[-1.0, 1.0], [1.0, -1.0]]}
    run = {"duration": 5, "start": [1.0, 2.0], "seed": 3}
    small = {"name": "small", "graphs": {"a": {"path": [1, 2]}, "b": {"path": [1, 2]}}, "switching": chain}
    large = small | {
        "name": "large",
        "graphs": {"a": {"arcs": [[1, 2], [2, 1], [2, 3]]}, "b": {"arcs": [[1, 2], [2, 1], [3, 4]]}},
    }
    two = simulate(Experiment.parse(small | {"run": run}))
    four = simulate(Experiment.parse(large | {"run": run | {"start": [1.0, 2.0, 0.0, 0.0]}}))
    assert np.array_equal(two.states, four.states[:, :2])


def test_longer_run_begins_like_the_shorter_one() -> None:
    setup = experiment("consensus")
    short, long = simulate(setup), simulate(setup.with_run(duration=120))
    assert np.array_equal(short.states, long.states[: len(short.states)])
    assert np.array_equal(short.modes, long.modes[: len(short.modes)])
