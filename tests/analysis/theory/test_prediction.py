"""Predictions against the golden files, networkx, the paper's example and one-matrix Lyapunov solves."""

import json
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
import scipy.linalg

from msg_analysis.errors import NotAvailableError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory.prediction import predict, stationary_start_factor

GOLDEN = Path(__file__).parents[2] / "data" / "golden"
LINE_RING = {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}}


def experiment(**changes):
    document = {
        "name": "test",
        "problem": "consensus",
        "time": "continuous",
        "graphs": LINE_RING,
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 10},
    }
    return Experiment.parse(document | changes)


def one_graph(graph, **changes):
    return experiment(graphs={"only": graph}, switching={"generator": [[0.0]]}, **changes)


def assert_contains(document, golden, path=""):
    """Every key of the golden document, numbers to a relative 1e-8 of the largest one of their array."""
    if isinstance(golden, dict):
        for key, value in golden.items():
            assert_contains(document[key], value, f"{path}.{key}")
    elif golden is None or isinstance(golden, str) or (isinstance(golden, list) and isinstance(golden[0], str)):
        assert document == golden, path
    else:
        scale = np.abs(golden).max()
        np.testing.assert_allclose(document, golden, rtol=1e-8, atol=1e-8 * scale, err_msg=path)


@pytest.mark.parametrize("name", ["line_ring", "tracking", "discrete", "air"])
def test_golden(name):
    document = predict(Experiment.load(GOLDEN / f"{name}.yaml")).to_json()
    assert_contains(document, json.loads((GOLDEN / f"{name}.predict.json").read_text()))
    json.dumps(document, allow_nan=False)


def test_noise_on_the_air_belongs_to_steps_only():
    document = predict(Experiment.load(GOLDEN / "air.yaml")).to_json()
    assert document["continuous"] is None
    assert document["static"] is None


def test_discrete_time_has_no_other_laws():
    document = predict(Experiment.load(GOLDEN / "discrete.yaml")).to_json()
    assert "continuous" not in document
    assert "emulated" not in document


@pytest.mark.parametrize(
    ("forward", "backward", "certainty"), [(1.0, 1.0, 0.73561), (0.1, 1.0, 0.53439), (1.0, 0.1, 0.94031)]
)
def test_first_example_of_the_paper(forward, backward, certainty):
    rates = {"rates": {"line": {"ring": forward}, "ring": {"line": backward}}, "scale": 0.5}
    prediction = predict(experiment(switching=rates))
    assert round(prediction.continuous.to_json()["system_certainty"], 5) == certainty
    if forward == backward:
        nodes = np.round(prediction.continuous.to_json()["node_certainty"], 5)
        np.testing.assert_array_equal(nodes, [2.90277, 4.25156, 5, 4.25156, 2.90277])


@pytest.mark.parametrize(
    ("graph", "oracle"),
    [
        ({"path": [1, 2, 3, 4, 5]}, nx.path_graph(5)),
        ({"cycle": [1, 2, 3, 4, 5]}, nx.cycle_graph(5)),
        ({"star": {"center": 1}}, nx.star_graph(4)),
        (
            {"edges": [[1, 2], [2, 3], [3, 1], [3, 4], [4, 5]]},
            nx.Graph([(0, 1), (1, 2), (2, 0), (2, 3), (3, 4)]),
        ),
    ],
)
def test_one_graph_is_resistance_and_information_centrality(graph, oracle):
    prediction = predict(one_graph(graph, agents=5))
    m, resistance = 5, nx.effective_graph_resistance(oracle)
    information = nx.information_centrality(oracle)  # 1 / sum of resistances from the node, in networkx
    expected = [(1 / information[i] - resistance / m) / (2 * m) for i in range(m)]
    for moments in (prediction.continuous, prediction.static):
        assert moments.system_error == pytest.approx(resistance / (2 * m), rel=1e-10)
        np.testing.assert_allclose(moments.node_errors, expected, rtol=1e-10)


def test_one_grounded_leader_is_half_the_sum_of_resistances():
    prediction = predict(
        one_graph(
            {"edges": [[1, 2], [2, 3], [3, 1], [3, 4]]},
            problem="tracking",
            leaders={"agents": [3], "gain": float("inf"), "reference": 1.0},
        )
    )
    information = nx.information_centrality(nx.Graph([(0, 1), (1, 2), (2, 0), (2, 3)]))
    assert prediction.continuous.system_error == pytest.approx(0.5 / information[2], rel=1e-10)
    assert prediction.continuous.node_errors[2] == 0.0
    assert prediction.continuous.to_json()["node_certainty"][2] is None


def test_grounded_leaders_are_the_limit_of_large_gains():
    leaders = {"agents": [2, 5], "reference": 1.0}
    noise = {"process": [0.5, 1.0, 2.0, 1.0, 1.0]}
    grounded = experiment(problem="tracking", leaders=leaders | {"gain": float("inf")}, noise=noise)
    # Only the continuous law has the limit (no step is short enough for the gain).
    from msg_analysis.theory.jump_system import JumpSystem
    from msg_analysis.theory.moments import MomentSolver

    gain = np.diag([0.0, 1e8, 0.0, 0.0, 1e8])
    z = np.stack([graph.laplacian for graph in grounded.graph_list]) + gain
    f = grounded.noise_gain[0]
    q = f @ f.T
    chain = grounded.chain
    system = JumpSystem("continuous", z, np.stack([q, q]), chain.matrix, chain.stationary, np.eye(5))
    large = MomentSolver(system).steady()
    np.testing.assert_allclose(predict(grounded).continuous.by_mode, large, rtol=1e-6, atol=1e-7)


def test_grounded_leader_in_discrete_time_is_its_own_noise():
    prediction = predict(
        experiment(
            problem="tracking",
            time="discrete",
            switching={"transition": [[0.9, 0.1], [0.2, 0.8]]},
            leaders={"agents": [3], "gain": float("inf"), "reference": 1.0},
            noise={"process": [1.0, 1.0, 0.7, 1.0, 1.0]},
            run={"dt": 1.0, "duration": 10},
        )
    )
    assert prediction.emulated.node_errors[2] == pytest.approx(0.49)


def test_static_is_the_weighted_mean_of_single_graphs():
    weights = {"generator": [[-1.0, 1.0], [3.0, -3.0]]}
    prediction = predict(experiment(switching=weights))
    single = [predict(one_graph(graph)).continuous.covariance for graph in LINE_RING.values()]
    np.testing.assert_allclose(prediction.static.covariance, 0.75 * single[0] + 0.25 * single[1], rtol=1e-10)


def test_disconnected_graphs_have_no_static_baseline():
    graphs = {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3]]}}
    prediction = predict(experiment(graphs=graphs, agents=3))
    assert prediction.static_moments is None
    assert prediction.to_json()["static"] is None
    assert prediction.continuous.system_error > 0.0


def test_a_graph_in_which_no_leader_is_heard_has_no_static_baseline():
    graphs = {"deaf": {"arcs": [[1, 2]]}, "all": {"path": [1, 2, 3]}}
    leaders = {"agents": [1], "gain": 1.0, "reference": 0.0}
    assert predict(experiment(graphs=graphs, agents=3, problem="tracking", leaders=leaders)).static_moments is None


def test_without_noise_certainty_is_undefined():
    document = predict(experiment(noise={"process": 0.0})).to_json()
    assert document["emulated"]["system_error"] == 0.0
    assert document["emulated"]["system_certainty"] is None


def test_start_factor_is_the_symmetric_root_of_the_conditional_covariance():
    e = Experiment.load(GOLDEN / "tracking.yaml")
    golden = json.loads((GOLDEN / "tracking.predict.json").read_text())
    for mode in range(3):
        factor = stationary_start_factor(e, mode)
        target = np.array(golden["emulated"]["mode_second_moments"][mode]) / golden["stationary"][mode]
        np.testing.assert_allclose(factor, scipy.linalg.sqrtm(target).real, rtol=1e-7, atol=1e-9)


def test_start_factor_of_consensus_has_no_mean():
    e = experiment()
    factor = stationary_start_factor(e, 1)
    np.testing.assert_allclose(factor.sum(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(factor @ factor.T, predict(e).emulated.by_mode[1] / 0.5, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "law", "reason"),
    [
        ({"noise": {"process": 1, "loss": 0.1}}, "continuous", "with noise on the air, loss or delay: use emulated"),
        ({"noise": {"process": 1, "delay": 1}}, "static", "with noise on the air, loss or delay: use emulated"),
        ({"time": "discrete", "switching": {}}, "continuous", "in discrete time: use emulated"),
        ({"graphs": {"a": {"edges": [[1, 2]]}, "b": {"edges": [[2, 3]]}}}, "static", "keep the agents together"),
    ],
)
def test_a_law_that_does_not_exist_is_an_error_with_the_reason(changes: dict, law: str, reason: str) -> None:
    document = {
        "name": "net",
        "agents": 3,
        "graphs": {"a": {"path": [1, 2, 3]}} | ({} if "time" in changes else {"b": {"cycle": [1, 2, 3]}}),
        "switching": {"generator": [[-1, 1], [1, -1]]},
        "run": {"duration": 10} if "time" in changes else {"dt": 0.05, "duration": 10},
    }
    prediction = predict(Experiment.parse(document | changes))
    with pytest.raises(NotAvailableError, match=reason):
        getattr(prediction, law)
    assert prediction.emulated.system_error > 0
