"""Indices of graphs against networkx, bounds against brute force over random networks."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import network

from experiments import line_ring, predict
from msg_analysis.experiment.graphs import Graph
from msg_analysis.theory.graph_indices import error_bounds, graph_indices

MODELS = settings(max_examples=30, deadline=None, derandomize=True)


@MODELS
@given(st.integers(0, 1000), st.integers(2, 7), st.booleans())
def test_resistances_are_those_of_networkx(seed, m, weighted):
    random = np.random.default_rng(seed)
    graph = nx.from_prufer_sequence(random.integers(0, m, m - 2).tolist())
    graph.add_edges_from(nx.gnp_random_graph(m, 0.3, seed=seed + 1).edges)
    for a, b in graph.edges:
        graph[a][b]["weight"] = float(random.uniform(0.2, 3.0)) if weighted else 1.0
    found = graph_indices(Graph.of("g", nx.to_numpy_array(graph, nodelist=range(m))))
    centrality = nx.information_centrality(graph, weight="weight")
    np.testing.assert_allclose(found.information_centrality, [centrality[i] for i in range(m)], rtol=1e-9)
    pairs = [(i, j) for i in range(m) for j in range(i)]
    total = sum(nx.resistance_distance(graph, *pair, weight="weight", invert_weight=False) for pair in pairs)
    assert found.kirchhoff_index == pytest.approx(total, rel=1e-9)


def test_no_resistances_where_there_are_none():
    assert graph_indices(Graph.of("g", np.array([[0.0, 1.0], [0.0, 0.0]]))) is None
    assert graph_indices(Graph.of("g", np.zeros((3, 3)))) is None


@MODELS
@given(
    st.integers(0, 10_000),
    st.integers(3, 6),
    st.integers(2, 4),
    st.sampled_from(["continuous", "discrete"]),
    st.sampled_from(["consensus", "tracking"]),
    st.sampled_from([0.01, 1.0, 100.0]),
)
def test_bounds_hold_for_equal_noise(seed, m, n, time, problem, rate):
    gain, shared = [0.5, 5.0, np.inf][seed % 3], {"directed": False, "noise": 0.7, "dt": 0.001}
    prediction = predict(network(seed, m, n, time=time, problem=problem, rate=rate, gain=gain, **shared))
    bounds = error_bounds(prediction)
    law = prediction.continuous_moments or prediction.emulated
    assert law.system_error <= bounds.upper * (1 + 1e-10)
    assert bounds.upper == prediction.static.system_error
    assert (bounds.lower is None) == (time == "discrete")
    assert (bounds.lower or 0.0) <= law.system_error * (1 + 1e-10)


def test_lower_bound_is_half_the_trace_of_the_averaged_graph():
    experiment = network(1, 5, 3, directed=False, noise=2.0)
    laplacians = np.stack([graph.laplacian for graph in experiment.graph_list])
    averaged = np.tensordot(experiment.chain.stationary, laplacians, axes=1)
    expected = 4.0 * np.trace(np.linalg.pinv(averaged)) / 2.0
    assert error_bounds(predict(experiment)).lower == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(
    ("directed", "noise", "reason"),
    [
        (True, {"process": 1.0}, "directed"),
        (False, {"process": [1.0, 1.0, 1.0, 2.0]}, "same, and independent"),
        (False, {"process": 1.0, "loss": 0.1}, "loss"),
    ],
)
def test_no_bounds_where_they_do_not_hold(directed, noise, reason):
    bounds = error_bounds(predict(network(2, 4, 2, directed=directed).with_noise(**noise)))
    assert (bounds.lower, bounds.upper) == (None, None)
    assert reason in bounds.note


def test_in_discrete_time_the_averaged_graph_is_no_lower_bound():
    """Two agents whose disagreement is multiplied by .95 and .85 in turn do better than with .9 all the time."""
    weights = [-np.log(0.95) / 2, -np.log(0.85) / 2]
    graphs = {"weak": {"edges": [[1, 2, weights[0]]]}, "strong": {"edges": [[1, 2, weights[1]]]}}
    switching = {"transition": [[0.001, 0.999], [0.999, 0.001]]}
    prediction = predict(line_ring(time="discrete", graphs=graphs, switching=switching))
    assert prediction.emulated.system_error < 1 / (1 - 0.9**2) - 0.05
    bounds = error_bounds(prediction)
    assert bounds.lower is None
    assert prediction.emulated.system_error < bounds.upper
