"""The lemmas on eigenvalues, with multiplicities counted by graph theory and exact arithmetic."""

from fractions import Fraction

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import line_ring
from msg_analysis.errors import InputError
from msg_analysis.theory.facts import check_facts

MODELS = settings(max_examples=20, deadline=None, derandomize=True)


def experiment(graphs, *, agents, time="continuous", leaders=None, seed=0, chain=None):
    n = len(graphs)
    if chain is None:
        chain = np.random.default_rng(seed).uniform(0.1, 1.0, (n, n))
        chain = chain / chain.sum(axis=1, keepdims=True) if time == "discrete" else chain - np.diag(chain.sum(axis=1))
    changes = {"problem": "tracking", "leaders": leaders} if leaders else {}
    switching = {"generator" if time == "continuous" else "transition": np.asarray(chain).tolist()}
    run = {"dt": 0.01, "duration": 1} if time == "continuous" else {"dt": 1, "duration": 10}
    return line_ring(agents=agents, graphs=graphs, time=time, switching=switching, run=run, **changes)


def by_name(facts):
    return {fact.name: fact for fact in facts}


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
    network = experiment(graphs, agents=m, seed=seed)
    found = by_name(check_facts(network))
    assert list(found) == ["N_c", "M_c", "Nbar_c", "Mbar_c"]
    extra = sum(closed_classes(graph) - 1 for graph in network.graph_list)
    for name, nullity in {"N_c": 1, "M_c": 1, "Nbar_c": n, "Mbar_c": n + 2 * extra}.items():
        fact = found[name]
        assert (fact.expected, fact.multiplicity, fact.nullity) == (nullity, nullity, nullity)
        assert fact.holds
        assert fact.others > 0.0
    for fact in check_facts(experiment(graphs, agents=m, seed=seed, time="discrete")):
        assert fact.holds, fact
        assert fact.multiplicity == (1 if fact.name in ("H_c", "A_c") else 0)
        assert fact.others < 1.0


def rank(matrix):
    """By elimination in rational numbers."""
    rows, found = [list(row) for row in matrix], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(found, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        for i in range(found + 1, len(rows)):
            factor = rows[i][column] / rows[found][column]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[found], strict=True)]
        found += 1
    return found


def test_nullities_in_exact_arithmetic():
    """The projected matrices of two connected graphs on three agents, in rational numbers: nullity 2, not 1."""
    exact = np.vectorize(Fraction, otypes=[object])
    line, ring = exact([[1, -1, 0], [-1, 2, -1], [0, -1, 1]]), exact([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]])
    flow, eye, zero = exact([[-1, 2], [1, -2]]), exact(np.eye(3, dtype=int)), exact(np.zeros((9, 9), dtype=int))
    v = eye - exact(np.ones((3, 3), dtype=int)) / 3
    line, ring = v @ line @ v, v @ ring @ v
    mean = np.block([[line, zero[:3, :3]], [zero[:3, :3], ring]]) - np.kron(flow, v)
    sums = [np.kron(x, eye) + np.kron(eye, x) for x in (line, ring)]
    second = np.block([[sums[0], zero], [zero, sums[1]]]) - np.kron(flow, np.kron(v, v))
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    found = by_name(check_facts(experiment(graphs, agents=3, chain=[[-1.0, 1.0], [2.0, -2.0]])))
    assert found["Nbar_c"].nullity == 6 - rank(mean) == 2
    assert found["Mbar_c"].nullity == 18 - rank(second) == 2


@pytest.mark.parametrize("gain", [0.3, float("inf")])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_leaders_remove_the_special_eigenvalue(gain, time):
    graphs = {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3]]}}
    leaders = {"agents": [1], "gain": gain}
    found = check_facts(experiment(graphs, agents=3, leaders=leaders, time=time))
    assert [fact.name for fact in found] == (["N_k", "M_k"] if time == "continuous" else ["H_k", "A_k"])
    assert all(fact.holds and fact.multiplicity == 0 for fact in found)


def test_others_of_one_graph_are_its_own_eigenvalues():
    path = {"path": {"path": [1, 2, 3, 4]}}
    found = by_name(check_facts(experiment(path, agents=4, chain=[[0.0]])))
    connectivity = 2 - np.sqrt(2)
    assert found["N_c"].others == pytest.approx(connectivity)
    assert found["M_c"].others == pytest.approx(connectivity)  # 0 + lambda_2
    discrete = by_name(check_facts(experiment(path, agents=4, time="discrete", chain=[[1.0]])))
    assert discrete["Abar_c"].others == pytest.approx(np.exp(-2 * connectivity))


def test_slow_chains_are_told_from_zero_or_refused_like_large_ones():
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    slow = by_name(check_facts(experiment(graphs, agents=3, chain=[[-1e-7, 1e-7], [1e-7, -1e-7]])))
    assert slow["M_c"].holds
    assert slow["M_c"].others == pytest.approx(2e-7, rel=1e-6)
    with pytest.raises(InputError, match="rounding hides"):
        check_facts(experiment(graphs, agents=3, chain=[[-1e-11, 1e-11], [1e-11, -1e-11]]))
    with pytest.raises(InputError, match="1600 rows"):
        check_facts(experiment({"path": {"path": list(range(1, 41))}}, agents=40, chain=[[0.0]]))
