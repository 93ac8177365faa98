"""The variance of a time mean: autocovariances summed by brute force, one graph in closed form, and twin runs."""

import itertools
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from experiments import Experiment, line_ring, predict, simulate
from msg_analysis.errors import InputError
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.time_mean_variance import mean_variance

PATH, RING = {"path": [1, 2, 3]}, {"cycle": [1, 2, 3]}


def uneven(graphs: dict[str, Any], rate: float = 0.7, **changes: Any) -> Experiment:
    """One graph, or two that are left at this rate, of agents with different noise."""
    fields = {"noise": {"process": [1.0, 0.5, 2.0]}, "run": {"dt": 0.15, "duration": 30}}
    return line_ring(3, rate, graphs=graphs, **({"switching": {}} if len(graphs) == 1 else {}) | fields | changes)


def by_brute_force(prediction: Prediction, patterns: list[list[tuple[float, np.ndarray]]]) -> tuple[float, float]:
    """N times the variance of the time mean of tr M, and of y^T y of one replica, by sums of autocovariances."""
    # ``patterns``: for every graph the probability and the matrix W of every pattern of lost messages, in reduced
    # coordinates. Moments are those of Kronecker powers of y, nothing is packed: C = E[y y], T = E[y y y y] and
    # X = E[M M] as vectors, by graph.
    system = prediction.system
    n, d, law = system.modes, system.dimension, system.stationary
    noise = [one.ravel() for one in system.noise]

    def symmetrized(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Sum over the six ways to give two places to a and the other two to b."""
        product = np.multiply.outer(a.reshape(d, d), b.reshape(d, d))
        other = np.multiply.outer(b.reshape(d, d), a.reshape(d, d))
        orders = (0, 1, 2, 3), (0, 2, 1, 3), (0, 2, 3, 1)
        return np.asarray(sum(each.transpose(order) for each in (product, other) for order in orders)).ravel()

    twice = [sum(p * np.kron(w, w) for p, w in some) for some in patterns]
    four = [sum(p * np.kron(np.kron(w, w), np.kron(w, w)) for p, w in some) for some in patterns]

    def steady(maps: list[np.ndarray], added: list[np.ndarray]) -> np.ndarray:
        size = len(added[0])
        matrix = np.block([[system.chain[i, j] * maps[i] for i in range(n)] for j in range(n)])
        right = np.concatenate([sum(system.chain[i, j] * added[i] for i in range(n)) for j in range(n)])
        return np.linalg.solve(np.eye(n * size) - matrix, right).reshape(n, size)

    second = steady(twice, [law[i] * noise[i] for i in range(n)])
    moved = [twice[i] @ second[i] for i in range(n)]
    triples = list(zip(moved, noise, law, strict=True))
    fourth = steady(four, [symmetrized(m, q) + p * symmetrized(q, q) / 2.0 for m, q, p in triples])
    of_path = steady(four, [np.kron(m, q) + np.kron(q, m) + p * np.kron(q, q) for m, q, p in triples])
    square = np.eye(d).ravel()
    mean = float((second @ square).sum())
    found = []
    for moments in (of_path, fourth):
        state = (np.kron(np.eye(d * d), square) @ moments.T).T - mean * second  # E[q (y y); i] less that of the mean
        weight = second @ square - mean * law  # E[q - mean; i]
        total = -float((state @ square).sum())
        for _ in range(20000):
            total += 2.0 * float((state @ square).sum())
            after = np.stack([twice[i] @ state[i] + weight[i] * noise[i] for i in range(n)])
            state, weight = system.chain.T @ after, system.chain.T @ weight
            if np.abs(state).max() < 1e-13:
                break
        found.append(total)
    return found[0], found[1]


def with_loss(prediction: Prediction, probability: float) -> list[list[tuple[float, np.ndarray]]]:
    """Every pattern of lost messages: the weight of a lost one falls to the agent itself."""
    step, lift = prediction.step, prediction.system.lift
    found = []
    for nominal in step.nominal:
        arcs = [(i, j) for i, j in np.argwhere(nominal != 0.0).tolist() if i != j]
        some = []
        for lost in itertools.product((False, True), repeat=len(arcs)):
            weights = nominal.copy()
            for (i, j), gone in zip(arcs, lost, strict=True):
                if gone:
                    weights[i, i] += weights[i, j]
                    weights[i, j] = 0.0
            count = sum(lost)
            chance = probability**count * (1.0 - probability) ** (len(arcs) - count)
            some.append((chance, lift.T @ weights @ lift))
        found.append(some)
    return found


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rate": 0.05},
        {"rate": 5.0},
        {"time": "discrete", "run": {"duration": 30}, "switching": {"transition": [[0.2, 0.8], [0.7, 0.3]]}},
        {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.4}},
        {"run": {"pace": "realtime", "dt": 0.15, "duration": 30}},
    ],
)
def test_it_is_the_sum_of_all_autocovariances(changes: dict[str, Any]) -> None:
    prediction = predict(uneven({"path": PATH, "ring": RING}, **changes))
    found = mean_variance(prediction)
    path, alone = by_brute_force(prediction, [[(1.0, matrix)] for matrix in prediction.system.matrices])
    assert found.followed
    assert found.path == pytest.approx(path, rel=1e-8)
    assert found.of(1) == pytest.approx(alone, rel=1e-8)
    assert found.of(4) == pytest.approx(path + (alone - path) / 4.0, rel=1e-8)


@pytest.mark.parametrize(("weight", "loss"), [(1.0, 0.3), (3.0, 0.5)])
def test_losses_to_the_first_order(weight: float, loss: float) -> None:
    """Of a step in which a loss moves an agent by 15 %, then 45 % of the difference: within 0.2 and 2 %."""
    graphs = {"path": {"edges": [[1, 2, weight], [2, 3, weight]]}, "pair": {"edges": [[1, 2, 0.2 * weight]]}}
    prediction = predict(uneven(graphs, noise={"process": 1.0, "loss": loss}))
    found = mean_variance(prediction)
    path, alone = by_brute_force(prediction, with_loss(prediction, loss))
    assert found.path == pytest.approx(path, rel=0.02 if weight > 1.0 else 0.002)
    assert found.of(1) == pytest.approx(alone, rel=0.02 if weight > 1.0 else 0.002)


def test_one_graph_in_closed_form() -> None:
    """Gaussian states: the covariance of y^T y at lag l is 2 tr(C_l C_l^T); no path, no scatter of it."""
    prediction = predict(uneven({"path": PATH}))
    weights, noise = prediction.system.matrices[0], prediction.system.noise[0]
    lag = scipy.linalg.solve_discrete_lyapunov(weights, noise)
    total = 2.0 * float((lag * lag).sum())
    for _ in range(5000):
        lag = weights @ lag
        total += 4.0 * float((lag * lag).sum())
    found = mean_variance(prediction)
    assert found.path == pytest.approx(0.0, abs=1e-9 * total)
    assert found.replica == pytest.approx(total, rel=1e-9)


def test_of_a_large_network_the_principal_axes_are_followed() -> None:
    graphs = {"path": {"path": [1, 2, 3, 4, 5, 6]}, "ring": {"cycle": [1, 3, 5, 2, 4, 6]}}
    prediction = predict(uneven(graphs, noise={"process": 1.0, "loss": 0.1}))
    exact = mean_variance(prediction)
    near = mean_variance(prediction, most_work=2.0 * 7.0**3)  # p = 6 of three axes
    assert exact.followed
    assert not near.followed
    assert near.path == pytest.approx(exact.path, rel=0.05)
    assert near.replica == pytest.approx(exact.replica, rel=0.005)


def test_runs_scatter_so_much() -> None:
    """120 runs of 2000 steps: the sum of squares over the variance, chi-square with 119 degrees: 1 % false alarms."""
    prediction = predict(uneven({"path": PATH, "ring": RING}, noise={"process": 1.0, "loss": 0.2, "link": 0.3}))
    means = []
    for seed in range(120):
        run = simulate(prediction.experiment.with_run(seed=seed, duration=300.0))
        states = run.states[:-1] - run.states[:-1].mean(axis=1, keepdims=True)
        means.append((states**2).sum(axis=1).mean())
    steps = 2000
    statistic = 119 * float(np.var(means, ddof=1)) / (mean_variance(prediction).of(2) / steps)
    low, high = scipy.special.chdtri(119, [0.995, 0.005])
    assert low < statistic < high


def test_no_fourth_moments() -> None:
    """Losses of messages with large weights: second moments exist, fourth do not."""
    graphs = {"mixed": {"arcs": [[1, 2, 1.0], [2, 1, 1.0], [2, 3, 1.0], [3, 1, 1.0]]}}
    run = {"dt": 0.95, "duration": 28.5}
    prediction = predict(uneven(graphs, noise={"process": 1.0, "loss": 0.3}, run=run))
    assert np.isfinite(prediction.emulated.system_error)
    fourth = sum(p * np.kron(np.kron(w, w), np.kron(w, w)) for p, w in with_loss(prediction, 0.3)[0])
    assert np.abs(np.linalg.eigvals(fourth)).max() > 1.4
    with pytest.raises(InputError, match="fourth moments of the states do not exist"):
        mean_variance(prediction)
