"""Predictions against the golden files, networkx, the paper's example and one-matrix Lyapunov solves."""

import json

import networkx as nx
import numpy as np
import pytest
import scipy.linalg

from experiments import GOLDEN, TRACKING, Experiment, line_ring, predict
from msg_analysis.errors import NotAvailableError
from msg_analysis.theory.prediction import stationary_start_factor

DISCRETE = {"time": "discrete", "graphs": {"a": {"path": [1, 2, 3]}}, "switching": {}, "run": {"dt": 1}}


def one_graph(graph, **changes):
    return line_ring(graphs={"only": graph}, switching={}, **changes)


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


@pytest.mark.parametrize(
    ("graph", "oracle"),
    [
        ({"path": [1, 2, 3, 4, 5]}, nx.path_graph(5)),
        ({"cycle": [1, 2, 3, 4, 5]}, nx.cycle_graph(5)),
        ({"star": {"center": 1}}, nx.star_graph(4)),
        ({"edges": [[1, 2], [2, 3], [3, 1], [3, 4], [4, 5]]}, nx.Graph([(0, 1), (1, 2), (2, 0), (2, 3), (3, 4)])),
    ],
)
def test_one_graph_is_resistance_and_information_centrality(graph, oracle):
    prediction = predict(one_graph(graph, agents=5))
    m, resistance = 5, sum(nx.resistance_distance(oracle, i, j) for i in range(5) for j in range(i))
    information = nx.information_centrality(oracle)  # 1 / sum of resistances from the node, in networkx
    expected = [(1 / information[i] - resistance / m) / (2 * m) for i in range(m)]
    for moments in (prediction.continuous, prediction.static):
        assert moments.system_error == pytest.approx(resistance / (2 * m), rel=1e-10)
        np.testing.assert_allclose(moments.node_errors, expected, rtol=1e-10)


def test_static_is_the_weighted_mean_of_single_graphs():
    prediction = predict(line_ring(5, switching={"generator": [[-1.0, 1.0], [3.0, -3.0]]}))
    single = [predict(one_graph({kind: [1, 2, 3, 4, 5]})).continuous.covariance for kind in ("path", "cycle")]
    np.testing.assert_allclose(prediction.static.covariance, 0.75 * single[0] + 0.25 * single[1], rtol=1e-10)


def test_graphs_that_do_not_keep_agents_together_have_no_static_baseline() -> None:
    prediction = predict(line_ring(graphs={"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3]]}}))
    assert prediction.static_moments is None
    assert prediction.to_json()["static"] is None
    assert prediction.continuous.system_error > 0.0
    graphs = {"deaf": {"arcs": [[1, 2]]}, "all": {"path": [1, 2, 3]}}
    assert predict(line_ring(graphs=graphs, **TRACKING)).static_moments is None


def test_start_factor_is_the_symmetric_root_of_the_conditional_covariance():
    e = Experiment.load(GOLDEN / "tracking.yaml")
    golden = json.loads((GOLDEN / "tracking.predict.json").read_text())
    for mode in range(3):
        factor = stationary_start_factor(e, mode)
        target = np.array(golden["emulated"]["mode_second_moments"][mode]) / golden["stationary"][mode]
        np.testing.assert_allclose(factor, scipy.linalg.sqrtm(target).real, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "law", "reason"),
    [
        (
            {"noise": {"process": 1, "loss": 0.1}},
            "continuous",
            "with noise on the air, loss, delay or activation: use emulated",
        ),
        (
            {"noise": {"process": 1, "delay": 1}},
            "static",
            "with noise on the air, loss, delay or activation: use emulated",
        ),
        (DISCRETE, "continuous", "in discrete time: use emulated"),
        ({"graphs": {"a": {"edges": [[1, 2]]}, "b": {"edges": [[2, 3]]}}}, "static", "keep the agents together"),
    ],
)
def test_a_law_that_does_not_exist_is_an_error_with_the_reason(changes: dict, law: str, reason: str) -> None:
    prediction = predict(line_ring(3, agents=3, **changes))
    with pytest.raises(NotAvailableError, match=reason):
        getattr(prediction, law)
    assert prediction.emulated.system_error > 0
