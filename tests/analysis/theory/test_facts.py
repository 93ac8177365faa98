"""The lemmas on eigenvalues, with multiplicities counted by graph theory."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import line_ring
from msg_analysis.errors import InputError
from msg_analysis.theory.facts import check_facts

MODELS = settings(max_examples=20, deadline=None, derandomize=True)


def switching_among(graphs, *, agents, time="continuous", seed=0, chain=None, **changes):
    n = len(graphs)
    if chain is None:
        chain = np.random.default_rng(seed).uniform(0.1, 1.0, (n, n))
        chain = chain / chain.sum(axis=1, keepdims=True) if time == "discrete" else chain - np.diag(chain.sum(axis=1))
    switching = {"generator" if time == "continuous" else "transition": np.asarray(chain).tolist()}
    run = {"duration": 10} | ({"dt": 0.01} if time == "continuous" else {})
    return line_ring(agents=agents, graphs=graphs, time=time, switching=switching, run=run, **changes)


def facts_of(graphs, **changes):
    return {fact.name: fact for fact in check_facts(switching_among(graphs, **changes))}


def closed_classes(graph):
    """Zero eigenvalues of the Laplacian: groups of agents that listen to nobody outside."""
    digraph = nx.from_numpy_array(graph.adjacency.T, create_using=nx.DiGraph)
    parts = nx.condensation(digraph)
    return sum(degree == 0 for _, degree in parts.in_degree())


@MODELS
@given(st.integers(0, 1000), st.integers(2, 4), st.integers(1, 3), st.booleans())
def test_nullities_of_random_networks_whose_union_connects_everybody(seed, m, n, directed):
    random = np.random.default_rng(seed)
    kind = "arcs" if directed else "edges"
    graphs = {f"g{i}": {kind: []} for i in range(n)}
    for j in range(2, m + 1):  # a tree from agent 1, its links spread over the graphs
        parent = int(random.integers(1, j))
        graphs[f"g{random.integers(n)}"][kind].append([parent, j, float(random.uniform(0.3, 2.0))])
    network = switching_among(graphs, agents=m, seed=seed)
    found = {fact.name: fact for fact in check_facts(network)}
    assert list(found) == ["N_c", "M_c", "Nbar_c", "Mbar_c"]
    extra = sum(closed_classes(graph) - 1 for graph in network.graph_list)
    for name, nullity in {"N_c": 1, "M_c": 1, "Nbar_c": n, "Mbar_c": n + 2 * extra}.items():
        fact = found[name]
        assert (fact.expected, fact.multiplicity, fact.nullity) == (nullity, nullity, nullity)
        assert fact.holds
        assert fact.others > 0.0
    for name, fact in facts_of(graphs, agents=m, seed=seed, time="discrete").items():
        assert fact.holds, fact
        assert fact.multiplicity == (1 if name in ("H_c", "A_c") else 0)
        assert fact.others < 1.0


@pytest.mark.parametrize("gain", [0.3, float("inf")])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_leaders_remove_the_special_eigenvalue(gain, time):
    graphs = {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3]]}}
    leaders = {"agents": [1], "gain": gain}
    found = facts_of(graphs, agents=3, problem="tracking", leaders=leaders, time=time)
    assert list(found) == (["N_k", "M_k"] if time == "continuous" else ["H_k", "A_k"])
    assert all(fact.holds and fact.multiplicity == 0 for fact in found.values())


def test_others_of_one_graph_are_its_own_eigenvalues():
    path = {"path": {"path": [1, 2, 3, 4]}}
    found = facts_of(path, agents=4, chain=[[0.0]])
    connectivity = 2 - np.sqrt(2)
    assert found["N_c"].others == pytest.approx(connectivity)
    assert found["M_c"].others == pytest.approx(connectivity)  # 0 + lambda_2
    discrete = facts_of(path, agents=4, time="discrete", chain=[[1.0]])
    assert discrete["Abar_c"].others == pytest.approx(np.exp(-2 * connectivity))


def test_slow_chains_are_told_from_zero_or_refused_like_large_ones():
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    slow = facts_of(graphs, agents=3, chain=[[-1e-7, 1e-7], [1e-7, -1e-7]])
    assert slow["M_c"].holds
    assert slow["M_c"].others == pytest.approx(2e-7, rel=1e-6)
    with pytest.raises(InputError, match="rounding hides"):
        facts_of(graphs, agents=3, chain=[[-1e-11, 1e-11], [1e-11, -1e-11]])
    with pytest.raises(InputError, match="1600 rows"):
        facts_of({"path": {"path": list(range(1, 41))}}, agents=40, chain=[[0.0]])
