"""Chain, path, step model and the largest stable step against scipy, networkx and direct formulas."""

import itertools
import math
import re

import networkx as nx
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from experiments import Experiment, line_ring
from msg_analysis.common.arrays import FloatArray
from msg_analysis.experiment import validation
from msg_analysis.experiment.graphs import Graph, hops
from msg_analysis.experiment.markov_chain import MarkovChain, stationary_law
from msg_analysis.experiment.validation import connection_problems
from msg_analysis.model.graph_path import holding_periods, mode_path
from msg_analysis.model.step_model import build_step_model


def generator_of(seed: int, n: int) -> np.ndarray:
    rates = np.random.default_rng(seed).uniform(0.1, 2.0, (n, n))
    np.fill_diagonal(rates, 0.0)
    return rates - np.diag(rates.sum(axis=1))


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_stationary_law_is_the_left_null_vector(seed: int, n: int) -> None:
    gamma = generator_of(seed, n)
    law = stationary_law(gamma)
    null = scipy.linalg.null_space(gamma.T)[:, 0] if n > 1 else np.ones(1)
    np.testing.assert_allclose(law, null / null.sum(), rtol=1e-10)


def test_stationary_law_keeps_its_digits_at_any_rate() -> None:
    """Three graphs in a row, rates over 30 orders of magnitude: detailed balance gives the law by hand."""
    up, down = (1e-15, 1e15), (1.0, 1e-10)
    gamma = np.array([[-up[0], up[0], 0], [down[0], -down[0] - up[1], up[1]], [0, down[1], -down[1]]])
    weights = np.array([1.0, up[0] / down[0], up[0] / down[0] * up[1] / down[1]])
    np.testing.assert_allclose(stationary_law(gamma), weights / weights.sum(), rtol=1e-14)


def test_ergodicity() -> None:
    assert not MarkovChain("continuous", np.array([[-1.0, 1.0], [0.0, 0.0]])).ergodic
    flip = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert MarkovChain("discrete", flip).irreducible
    assert not MarkovChain("discrete", flip).ergodic
    assert MarkovChain("continuous", np.zeros((1, 1))).ergodic


@given(st.integers(0, 10_000), st.integers(1, 7), st.floats(0.05, 0.9))
def test_reachability_and_period_against_networkx(seed: int, n: int, density: float) -> None:
    jumps = np.random.default_rng(seed).random((n, n)) < density
    digraph = nx.from_numpy_array(jumps, create_using=nx.DiGraph)
    level = hops(jumps, [0])
    assert {v: d for v, d in enumerate(level.tolist()) if d >= 0} == nx.single_source_shortest_path_length(digraph, 0)
    chain = MarkovChain("discrete", jumps / np.maximum(jumps.sum(axis=1, keepdims=True), 1))
    assert chain.irreducible == nx.is_strongly_connected(digraph)
    period = math.gcd(*(len(cycle) for cycle in nx.simple_cycles(digraph)))
    assert not (chain.irreducible and jumps.any()) or chain.period == period


@given(st.integers(0, 10_000), st.integers(2, 8), st.floats(0.05, 0.4))
def test_whom_nothing_connects_against_networkx(seed: int, agents: int, density: float) -> None:
    hears = np.random.default_rng(seed).random((agents, agents)) < density
    np.fill_diagonal(hears, False)
    digraph = nx.from_numpy_array(hears.T, create_using=nx.DiGraph)
    reached = max(len(nx.descendants(digraph, v)) + 1 for v in digraph)
    found = connection_problems([Graph.of("graph", hears.astype(float))], None)
    assert len(found) == (reached < agents)
    for problem in found:
        lost, sources = re.fullmatch(
            r".*: agents? (.*) cannot be reached from agents? ([\d, ]*) in.*", problem
        ).groups()
        unreached, roots = ({int(label) - 1 for label in text.split(", ")} for text in (lost, sources))
        for root in roots:
            assert set(digraph) - nx.descendants(digraph, root) - {root} == unreached
        assert len(unreached) == agents - reached
        assert roots in list(nx.strongly_connected_components(digraph))


def setup(time: str, matrix: np.ndarray, steps: int, dt: float = 0.3, **switching: object) -> Experiment:
    n = len(matrix)
    key = "generator" if time == "continuous" else "transition"
    graphs = {f"g{i}": {"edges": [[1, 2, 0.1 + i]]} for i in range(n)}
    run = {"dt": dt, "duration": steps * dt, "seed": 11}
    return line_ring(time=time, graphs=graphs, switching={key: matrix.tolist()} | switching, run=run)


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_path_has_the_transition_probabilities(time: str) -> None:
    """Transition counts of 40,000 steps against expm(Gamma dt), Pearson chi-square per row, p > 1e-5 each."""
    # dt is a third of a mean holding time, so many holding periods fall between two steps. False-alarm rate 6e-5.
    gamma = generator_of(1, 3)
    matrix = gamma if time == "continuous" else scipy.linalg.expm(gamma * 0.3)
    case = setup(time, matrix, 40_000, 0.3 if time == "continuous" else 1.0)
    modes = mode_path(case, case.chain.stationary)
    expected = scipy.linalg.expm(gamma * 0.3)
    for i in range(3):
        following = modes[1:][modes[:-1] == i]
        counts = np.bincount(following, minlength=3)
        assert scipy.stats.chisquare(counts, expected[i] * len(following)).pvalue > 1e-5


@pytest.mark.parametrize("rate", [1e5, 1e9, 1e12])
def test_very_fast_switching_has_the_same_law(rate: float) -> None:
    """Graphs 1 and 2 alternate fast and graph 3 is rare: pairs of steps by chi-square, p > 1e-5: the false-alarm rate.

    Averaging (Simon and Ando 1961): within dt = 0.3 the fast pair is in its stationary law 2/3, 1/3.
    """
    gamma = np.array([[-rate, rate, 0.0], [2 * rate, -2 * rate - 3.0, 3.0], [1.5, 0.0, -1.5]])
    case = setup("continuous", gamma, 20_000)
    modes = mode_path(case, case.chain.stationary)
    slow = scipy.linalg.expm(np.array([[-1.0, 1.0], [1.5, -1.5]]) * 0.3)  # 3.0 from a third of the time
    within = np.array([2 / 3, 1 / 3])
    expected = np.vstack([[*(slow[0, 0] * within), slow[0, 1]]] * 2 + [[*(slow[1, 0] * within), slow[1, 1]]])
    for i in range(3):
        following = modes[1:][modes[:-1] == i]
        counts = np.bincount(following, minlength=3)
        assert scipy.stats.chisquare(counts, expected[i] * len(following)).pvalue > 1e-5


@pytest.mark.parametrize("rate", [1.0, 1e3, 1e6, 1e12])
def test_transition_of_two_graphs(rate: float) -> None:
    """In closed form: pi + (1 - pi) exp(-3 r dt), also where the least version of scipy has NaN."""
    chain = MarkovChain("continuous", np.array([[-rate, rate], [2 * rate, -2 * rate]]))
    left = np.exp(-0.3 * rate)
    expected = [[2 / 3 + left / 3, (1 - left) / 3], [2 * (1 - left) / 3, 1 / 3 + 2 * left / 3]]
    np.testing.assert_allclose(chain.transition(0.1), expected, rtol=1e-12)


def test_holding_times_are_exponential() -> None:
    """Kolmogorov-Smirnov on 5,000 holding times, p > 1e-4: the false-alarm rate."""
    chain = MarkovChain("continuous", generator_of(2, 2))
    path = chain.holding_periods(chain.stationary, np.random.default_rng(3))
    held = [time for mode, time in (next(path) for _ in range(10_000)) if mode == 0]
    assert scipy.stats.kstest(held, "expon", args=(0, -1 / chain.matrix[0, 0])).pvalue > 1e-4


def test_holding_periods_cover_every_step_once() -> None:
    case = setup("continuous", 5 * generator_of(4, 3), 500)
    found = list(holding_periods(case, case.chain.stationary))
    assert [s.sequence for s in found] == list(range(len(found)))
    assert found[0].first_step == 0
    assert found[-1].last_step == 499
    assert all(a.last_step + 1 == b.first_step for a, b in itertools.pairwise(found))
    assert all(s.first_step <= s.last_step for s in found)


def test_first_graph_can_be_given_and_one_never_switches() -> None:
    case = setup("continuous", generator_of(4, 3), 5, initial="g2")
    model = build_step_model(case)
    assert model.initial.tolist() == [0, 0, 1]
    assert mode_path(case, model.initial)[0] == 2
    case = setup("continuous", np.zeros((1, 1)), 7)
    assert mode_path(case, np.ones(1)).tolist() == [0] * 7


def test_step_of_grounded_leaders() -> None:
    """Euler: the leader's row vanishes and the reference moves into the offset; discrete time: followers forget it."""
    changes = {"graphs": {"a": {"path": [1, 2, 3]}}, "switching": {}, "noise": {"process": 2.0}}
    changes |= {"problem": "tracking", "leaders": {"agents": [1], "gain": math.inf, "reference": 3.0}}
    model = build_step_model(line_ring(**changes, run={"dt": 0.1}))
    np.testing.assert_allclose(model.weights[0], [[0, 0, 0], [0.1, 0.8, 0.1], [0, 0.1, 0.9]])
    np.testing.assert_allclose(model.offsets[0], [3.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(model.noise[0], np.diag([0, 0.4, 0.4]))
    model = build_step_model(line_ring(**changes, time="discrete"))
    followers = scipy.linalg.expm(-np.array([[2.0, -1.0], [-1.0, 1.0]]))
    np.testing.assert_allclose(model.weights[0][1:, 1:], followers)
    assert not model.weights[0][0].any()
    assert not model.weights[0][:, 0].any()
    # The limit of a large gain.
    laplacian = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    limit = scipy.linalg.expm(-(laplacian + np.diag([1e9, 0, 0])))
    np.testing.assert_allclose(model.weights[0], limit, atol=1e-8)
    np.testing.assert_allclose(model.noise[0], 4 * np.eye(3))


def contracts(laplacian: FloatArray, dt: float) -> bool:
    """Whether powers of I - dt L keep their size (a stable step) by taking one."""
    step = np.linalg.matrix_power(np.eye(len(laplacian)) - dt * laplacian, 5000)
    return bool(np.abs(step).max() < 10)


@pytest.mark.parametrize("seed", range(8))
def test_stability_limit_against_powers_of_the_step(seed: int) -> None:
    random = np.random.default_rng(seed)
    adjacency = random.uniform(0.2, 2, (5, 5)) * (random.random((5, 5)) < 0.6)
    if seed % 2:
        adjacency = adjacency + adjacency.T
    np.fill_diagonal(adjacency, 0)
    graph = Graph.of("graph", adjacency)
    limit = validation.stability_limit(graph, np.zeros(5))
    assert contracts(graph.laplacian, 0.99 * limit)
    assert not contracts(graph.laplacian, 1.01 * limit)


def test_stability_limit_of_leaders() -> None:
    star = Graph.of("star", np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], dtype=float))
    gains = np.array([math.inf, 0, 0])
    assert validation.stability_limit(star, gains) == 2.0  # followers alone: Z = I
    z = star.laplacian + np.diag([4.0, 0, 0])
    assert validation.stability_limit(star, np.array([4.0, 0, 0])) == pytest.approx(2 / np.linalg.eigvalsh(z)[-1])
    assert validation.stability_limit(Graph.of("none", np.zeros((3, 3))), np.zeros(3)) == math.inf
