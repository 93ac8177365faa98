"""Leader sets against brute-force Kronecker algebra, networkx, and exact algorithms for paths and rings."""

import math
from functools import cache
from itertools import combinations
from typing import Any

import networkx as nx
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import Experiment, line_ring
from msg_analysis.errors import InputError
from msg_analysis.theory.leaders import (
    LeaderProblem,
    joint_robustness_centrality,
    resolve_law,
    select_leaders,
    system_error,
)


def random_document(seed: int, *, agents: int = 5, directed: bool = False, **changes: Any) -> dict[str, Any]:
    """Random weights, rates and noises of every graph; not every graph is connected, the union is, strongly."""
    random = np.random.default_rng(seed)
    modes = int(random.integers(1, 4))
    graphs: dict[str, Any] = {}
    for mode in range(modes):
        ring = [(i, i % agents + 1) for i in range(1, agents + 1)] if mode == 0 else []
        pairs = [p for p in combinations(range(1, agents + 1), 2) if random.random() < 0.3]
        if directed:
            pairs = [p if random.random() < 0.5 else p[::-1] for p in pairs]
        links = sorted(set(ring) | {p for p in pairs if p not in ring and p[::-1] not in ring})
        kind = "arcs" if directed else "edges"
        graphs[f"g{mode}"] = {kind: [[i, j, float(random.uniform(0.2, 1.5))] for i, j in links]}
    rates = random.uniform(0.1, 3.0, (modes, modes))
    np.fill_diagonal(rates, 0.0)
    document = {
        "name": "random",
        "agents": agents,
        "graphs": graphs,
        "switching": {"generator": (rates - np.diag(rates.sum(axis=1))).tolist()},
        "noise": {"process": {name: random.uniform(0.3, 1.5, agents).tolist() for name in graphs}},
        "run": {"dt": 0.05, "duration": 10},
    }
    return document | changes


def discrete_document(seed: int, **options: Any) -> dict[str, Any]:
    document = random_document(seed, **options)
    p = scipy.linalg.expm(np.array(document["switching"]["generator"]))
    return document | {"time": "discrete", "switching": {"transition": p.tolist()}, "run": {"duration": 10}}


def stationary(chain: np.ndarray) -> np.ndarray:
    n = len(chain)
    return np.linalg.lstsq(np.vstack([chain.T, np.ones(n)]), np.append(np.zeros(n), 1.0), rcond=None)[0]


def kronecker_error(experiment: Experiment, leaders: tuple[int, ...], law: str, gain: float = math.inf) -> float:
    """E(S) from the full n m^2 equations, written from the definitions."""
    m, laplacians = experiment.agents, [g.laplacian for g in experiment.graph_list]
    n, q = len(laplacians), [f @ f.T for f in experiment.noise_gain]
    matrix = experiment.chain.matrix
    lead = np.isin(np.arange(m), leaders)
    pull = np.diag(np.where(lead, 0.0 if math.isinf(gain) else gain, 0.0))
    follows = ~lead if math.isinf(gain) else np.ones(m, bool)
    select, d = np.eye(m)[follows], int(follows.sum())
    drift = [select @ (lap + pull) @ select.T for lap in laplacians]
    noise = [select @ own @ select.T for own in q]
    if law == "continuous":
        pi = stationary(matrix)
        system = scipy.linalg.block_diag(*[np.kron(z, np.eye(d)) + np.kron(np.eye(d), z) for z in drift])
        system -= np.kron(matrix.T, np.eye(d * d))
        right = np.concatenate([p * own.ravel() for p, own in zip(pi, noise, strict=True)])
        return float(np.trace(np.linalg.solve(system, right).reshape(n, d, d).sum(axis=0)))
    if law == "emulated":
        dt = experiment.step_length
        steps, chain = [np.eye(d) - dt * z for z in drift], scipy.linalg.expm(matrix * dt)
        noise = [dt * own for own in noise]
    else:
        steps, chain = [scipy.linalg.expm(-z) for z in drift], matrix
    pi = stationary(chain - np.eye(n))
    operator = np.kron(chain.T, np.eye(d * d)) @ scipy.linalg.block_diag(*[np.kron(w, w) for w in steps])
    right = chain.T @ np.array([p * own.ravel() for p, own in zip(pi, noise, strict=True)])
    solution = np.linalg.solve(np.eye(n * d * d) - operator, right.ravel())
    held = sum(p * float(np.trace(own[lead][:, lead])) for p, own in zip(pi, q, strict=True))
    error = float(np.trace(solution.reshape(n, d, d).sum(axis=0)))
    return error + (held if law == "discrete" and math.isinf(gain) else 0.0)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from([math.inf, 0.01, 3.0]))
def test_system_error_against_kronecker_algebra(seed: int, directed: bool, gain: float) -> None:
    leaders = [(0,), (1, 3), (0, 2, 4)][seed % 3]
    experiment = Experiment.parse(random_document(seed, directed=directed))
    twin = Experiment.parse(discrete_document(seed, directed=directed))
    for law, model in (("continuous", experiment), ("emulated", experiment), ("discrete", twin)):
        expected = kronecker_error(model, leaders, law, gain)
        numbers = [agent + 1 for agent in leaders]
        assert system_error(model, numbers, law=law, gain=gain) == pytest.approx(expected, rel=1e-9)


def test_leaders_of_the_experiment_do_not_count() -> None:
    consensus = Experiment.parse(random_document(1))
    led = {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.5, "reference": 7.0}}
    tracking = Experiment.parse(random_document(1) | led)
    assert system_error(tracking, [1, 4]) == system_error(consensus, [1, 4])
    assert joint_robustness_centrality(tracking, [1, 4]) == 1.0 / system_error(consensus, [1, 4])
    assert tracking.spec.leaders.agents == [2]


@pytest.mark.parametrize("graph", [nx.path_graph(7), nx.cycle_graph(6), nx.lollipop_graph(4, 3), nx.star_graph(5)])
def test_single_leader_of_one_graph_is_information_centrality(graph: Any) -> None:
    """E = 1 / (2 IC), Fitch and Leonard; networkx's centrality is one over the sum of the resistances."""
    links = [[i + 1, j + 1] for i, j in graph.edges]
    experiment = Experiment.parse({"name": "one", "graphs": {"g": {"edges": links}}})
    centrality = nx.information_centrality(graph)
    for agent in graph:
        expected = 2.0 * centrality[agent]
        assert joint_robustness_centrality(experiment, [agent + 1]) == pytest.approx(expected, rel=1e-10)


def between(distance: int) -> float:
    """E of the agents between two leaders: half the trace of the inverse of a Dirichlet path Laplacian."""
    return (distance**2 - 1) / 12


def best_on_path(agents: int, count: int) -> float:
    """Exact, over the place of the last leader so far (after Patterson, McGlohon and Dyagilev)."""

    @cache
    def least(last: int, left: int) -> float:
        if left == 0:
            beyond = agents - 1 - last
            return beyond * (beyond + 1) / 4
        return min(between(place - last) + least(place, left - 1) for place in range(last + 1, agents - left + 1))

    return min(first * (first + 1) / 4 + least(first, count - 1) for first in range(agents - count + 1))


def best_on_ring(agents: int, count: int) -> float:
    """Exact: distances between neighbouring leaders as equal as can be, since ``between`` is convex."""
    longer = agents % count
    return longer * between(agents // count + 1) + (count - longer) * between(agents // count)


@pytest.mark.parametrize(("agents", "count"), [(9, 1), (10, 2), (11, 3), (9, 4)])
@pytest.mark.parametrize("kind", ["path", "cycle"])
def test_optimal_leaders_on_paths_and_rings(kind: str, agents: int, count: int) -> None:
    experiment = Experiment.parse({"name": kind, "graphs": {"g": {kind: list(range(1, agents + 1))}}})
    best = (best_on_path if kind == "path" else best_on_ring)(agents, count)
    exhaustive = select_leaders(experiment, count, method="exhaustive")
    assert exhaustive.sets[0][0] == pytest.approx(best, rel=1e-10)
    assert exhaustive.evaluations == math.comb(agents, count)
    for method in ("greedy", "swap"):
        selection = select_leaders(experiment, count, method=method)
        assert selection.bound <= best * (1 + 1e-9)
        assert selection.sets[0][0] >= best * (1 - 1e-9)
        assert method == "greedy" or selection.sets[0][0] == pytest.approx(best, rel=1e-9)


def test_optimal_leaders_of_a_longer_path() -> None:
    """Too many sets to try them all; the exact algorithm has the answer."""
    experiment = Experiment.parse({"name": "path", "graphs": {"g": {"path": list(range(1, 25))}}})
    selection = select_leaders(experiment, 4)
    best = best_on_path(24, 4)
    assert selection.method == "swap"
    assert selection.sets[0][0] == pytest.approx(best, rel=1e-9)
    assert 0.4 * best < selection.bound <= best


def assert_supermodular(problem: LeaderProblem) -> None:
    """Of all sets of at most three: one more leader never hurts, and helps the less the more there are."""
    assert problem.supermodular
    everybody = frozenset(range(problem.agents))
    sets = [frozenset(s) for size in (1, 2, 3) for s in combinations(everybody, size)]
    worth = {leaders: problem.system_error(leaders) for leaders in sets}
    for base in (leaders for leaders in sets if len(leaders) < 3):
        for v in everybody - base:
            gain = worth[base] - worth[base | {v}]
            assert gain >= -1e-10 * worth[base]
            for u in everybody - base - {v} if len(base) == 1 else ():
                assert worth[base | {u}] - worth[base | {u, v}] <= gain + 1e-9 * worth[base]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from(["continuous", "emulated", "discrete"]), st.booleans())
def test_monotone_and_supermodular(seed: int, directed: bool, law: str, finite: bool) -> None:
    """Directed and weighted graphs, uneven noise, every law, any gain."""
    document = discrete_document if law == "discrete" else random_document
    experiment = Experiment.parse(document(seed, directed=directed))
    assert_supermodular(LeaderProblem(experiment, law, 0.7 if finite else math.inf))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.booleans(), st.integers(0, 2), st.sampled_from([0.0, 0.3]))
def test_supermodular_with_noise_on_the_air_loss_and_delay(seed: int, directed: bool, delay: int, loss: float) -> None:
    noise = {"process": 0.5, "link": 1.0, "broadcast": 0.7, "loss": loss, "delay": delay}
    experiment = Experiment.parse(random_document(seed, agents=4, directed=directed, noise=noise))
    assert_supermodular(LeaderProblem(experiment, "emulated"))


def test_negatively_correlated_noise_gets_no_guarantee() -> None:
    """F F^T < 0 between agents 1 and 2."""
    experiment = line_ring(noise={"process": [[1.0, 0.0, 0.0], [-0.9, 0.4, 0.0], [0.0, 0.0, 0.5]]})
    assert not LeaderProblem(experiment, "continuous").supermodular
    selection = select_leaders(experiment, 2, method="swap")
    assert selection.bound is None
    assert "negatively correlated" in str(selection.to_json()["note"])


def test_large_steps_get_no_guarantee() -> None:
    """With run.dt * degree > 1 the weights of a step are negative: no walkers."""
    graphs = {"g": {"star": {"center": 1}}}
    experiment = Experiment.parse({"name": "star", "agents": 6, "graphs": graphs, "run": {"dt": 0.25, "duration": 10}})
    assert not LeaderProblem(experiment, "emulated").supermodular
    assert LeaderProblem(experiment, "continuous").supermodular
    assert LeaderProblem(experiment.with_run(dt=0.2), "emulated").supermodular
    assert not LeaderProblem(experiment.with_run(dt=0.2), "emulated", gain=0.1).supermodular


def test_agents_that_hear_nobody_must_lead() -> None:
    """Agents 1 and 6 only speak: whoever leads, they must."""
    arcs = [[1, 2], [2, 3], [3, 4], [4, 3], [6, 5], [5, 4]]
    graphs = {"g": {"arcs": arcs}}
    experiment = line_ring(problem="tracking", graphs=graphs, switching={}, leaders={"agents": [1, 6]})
    assert system_error(experiment, [2, 3]) == math.inf
    assert joint_robustness_centrality(experiment, [2, 3]) == 0.0
    for method in ("exhaustive", "greedy", "swap"):
        selection = select_leaders(experiment, 2, method=method)
        assert [agents for _, agents in selection.sets] == [(1, 6)]
        assert {1, 6} < set(select_leaders(experiment, 3, method=method).sets[0][1])
        with pytest.raises(InputError, match="no set of 1 reaches all agents"):
            select_leaders(experiment, 1, method=method)


def test_noise_on_the_air_is_looked_at_in_the_steps_law() -> None:
    noise = {"process": 1.0, "link": 0.5, "broadcast": 0.3, "loss": 0.2}
    experiment = Experiment.parse(random_document(4, noise=noise))
    assert resolve_law(experiment) == "emulated"
    problem = LeaderProblem(experiment, "emulated")
    assert problem.supermodular
    quiet = Experiment.parse(random_document(4, noise={"process": 1.0}))
    assert problem.system_error(frozenset({0})) > system_error(quiet, [1], law="emulated")
    with pytest.raises(InputError, match=r"law continuous.*use emulated"):
        resolve_law(experiment, "continuous")


def test_limits_and_everybody() -> None:
    experiment = Experiment.parse(random_document(5))
    assert system_error(experiment, range(1, 6)) == 0.0
    assert select_leaders(experiment, 5, gain=2.0).sets[0][1] == (1, 2, 3, 4, 5)
    path = Experiment.parse({"name": "path", "graphs": {"g": {"path": list(range(1, 61))}}})
    with pytest.raises(InputError, match="5461512 sets of 5 leaders: use swap"):
        select_leaders(path, 5, method="exhaustive")
    experiment = Experiment.parse(random_document(7))
    with pytest.raises(InputError, match=r"run\.dt"):
        select_leaders(experiment, 1, law="emulated", gain=1000.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 0}, "count 0: expected 1 to 4"),
        ({"count": 5}, "count 5: expected 1 to 4.*at least one agent must follow"),
        ({"count": 6, "gain": 1.0}, "count 6: expected 1 to 5"),
        ({"gain": 0.0}, "gain 0.0: expected a number > 0"),
        ({"gain": math.nan}, "gain nan"),
        ({"top": 0}, "top 0"),
        ({"law": "discrete"}, "law discrete.*use continuous or emulated"),
        ({"method": "best"}, "method best: expected one of auto, exhaustive"),
    ],
)
def test_bad_questions(changes: dict[str, Any], message: str) -> None:
    experiment = Experiment.parse(random_document(6))
    with pytest.raises(InputError, match=message):
        select_leaders(experiment, **{"count": 2} | changes)


def test_document() -> None:
    document = select_leaders(Experiment.parse(random_document(8)), 2, method="swap", top=3).to_json()
    about = {"experiment": "random", "law": "continuous", "gain": "inf", "count": 2, "method": "swap"}
    assert about.items() <= {key: document[key] for key in about}.items()
    assert len(document["sets"]) == 3
    errors = [entry["system_error"] for entry in document["sets"]]
    assert errors == sorted(errors)
    assert all(entry["joint_centrality"] == 1 / entry["system_error"] for entry in document["sets"])
    assert sorted(document["order"]) == document["sets"][0]["agents"]
    assert min(document["sets"][0]["agents"]) >= 1
    bound = document["bound"]
    assert bound["gap"] == pytest.approx(errors[0] / bound["system_error"] - 1)
