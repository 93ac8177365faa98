"""The variance of a time mean: autocovariances summed by brute force, one graph in closed form, and twin runs."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from tests.analysis.theory.test_message_steps import Brute, parse

from experiments import Experiment, line_ring, predict, simulate
from msg_analysis.errors import InputError
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.time_mean_variance import mean_variance

PATH, RING = {"path": [1, 2, 3]}, {"cycle": [1, 2, 3]}


def uneven(graphs: dict[str, Any], rate: float = 0.7, **changes: Any) -> Experiment:
    """One graph, or two that are left at this rate, of agents with different noise."""
    fields = {"noise": {"process": [1.0, 0.5, 2.0]}, "run": {"dt": 0.15, "duration": 30}}
    return line_ring(3, rate, graphs=graphs, **({"switching": {}} if len(graphs) == 1 else {}) | fields | changes)


def by_autocovariances(chain: Any, law: Any, maps: Any, noise: Any, form: Any) -> tuple[float, float]:
    """N times the variance of the time mean of y^T H y: of infinitely many replicas, and of one; no loss is random.

    ``chain`` (n, n) and ``law`` (n,) of the modes, that is, graphs and patterns of lost messages; ``maps`` and
    ``noise`` (n, d, d) of each. T = E[M M; mode] by iteration of its recursion, nothing packed; then sums over lags.
    """

    def after(modes: np.ndarray) -> np.ndarray:
        return np.tensordot(chain, modes, axes=(0, 0))

    def moved(moments: np.ndarray) -> np.ndarray:
        return maps @ moments @ maps.transpose(0, 2, 1)

    second, fourth = np.zeros_like(noise), np.zeros((*noise.shape, *noise.shape[1:]))
    added = law[:, None, None] * noise
    for _ in range(3000):
        before, cross = fourth, np.einsum("nab,ncd->nabcd", moved(second) + added / 2.0, noise)
        for _ in range(4):
            fourth = np.einsum("nxa,nabcd->nbcdx", maps, fourth)
        fourth = after(fourth + cross + cross.transpose(0, 3, 4, 1, 2))
        second = after(moved(second) + added)
        if np.abs(fourth - before).max() < 1e-12 * np.abs(fourth).max():
            break
    mean = float(np.einsum("nab,ab->", second, form))
    shared = np.einsum("nabcd,cd->nab", fourth, form)  # E[tr(H M) M], and E[y^T H y y y^T] of one replica
    alone = shared + 2.0 * np.einsum("nacbd,cd->nab", fourth, form)
    found = []
    for state in (shared - mean * second, alone - mean * second):
        weight = np.einsum("nab,ab->n", second, form) - mean * law
        total = -float(np.einsum("nab,ab->", state, form))
        for _ in range(20000):
            total += 2.0 * float(np.einsum("nab,ab->", state, form))
            state, weight = after(moved(state) + weight[:, None, None] * noise), weight @ chain
            if np.abs(state).max() < 1e-13 * abs(total):
                break
        found.append(total)
    return found[0], found[1]


def patterns(prediction: Prediction) -> tuple[Any, Any, Any, Any]:
    """Chain, law, maps and noise of graphs and patterns of lost messages, whose weight falls to the agent itself."""
    step, lift, chains, laws, maps, noises = prediction.step, prediction.system.lift, [], [], [], []
    links = [(i, j) for i, j in np.argwhere(step.nominal.any(axis=0)).tolist() if i != j]
    for graph, lost in itertools.product(range(step.modes), itertools.product((False, True), repeat=len(links))):
        weights, noise = step.nominal[graph].copy(), step.noise_gain[graph] @ step.noise_gain[graph].T
        chance = math.prod(
            step.losses[link] if gone else 1.0 - step.losses[link] for link, gone in zip(links, lost, strict=True)
        )
        for (i, j), gone in zip(links, lost, strict=True):
            if gone:
                weights[i, i] += weights[i, j]
                weights[i, j] = 0.0
        heard = weights * ~np.eye(step.agents, dtype=bool)
        noise += step.broadcast**2 * heard @ heard.T + step.link**2 * np.diag((heard**2).sum(axis=1))
        chains.append(step.transition[:, graph] * chance)
        laws.append(step.stationary[graph] * chance)
        maps.append(lift.T @ weights @ lift)
        noises.append(lift.T @ noise @ lift)
    chain = np.repeat(np.stack(chains, axis=1), 2 ** len(links), axis=0)
    return chain, np.array(laws), np.stack(maps), np.stack(noises)


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
    found, system = mean_variance(prediction), prediction.system
    form = np.eye(system.dimension)
    path, alone = by_autocovariances(system.chain, system.stationary, system.matrices, system.noise, form)
    assert found.exact
    assert found.path == pytest.approx(path, rel=1e-8)
    assert found.of(1) == pytest.approx(alone, rel=1e-8)
    assert found.of(4) == pytest.approx(path + (alone - path) / 4.0, rel=1e-8)


@pytest.mark.parametrize("loss", [0.3, 0.9])
@pytest.mark.parametrize("noise", [{}, {"link": 2.0}, {"broadcast": 1.5, "link": 0.5}])
@pytest.mark.parametrize("more", [{}, {"problem": "tracking", "leaders": {"agents": [2], "gain": 0.4}}])
def test_losses(loss: float, noise: dict[str, Any], more: dict[str, Any]) -> None:
    """With the noise of a message that is lost, too, which several may share."""
    graphs = {"path": {"arcs": [[1, 2, 3.0], [2, 1, 2.0], [2, 3, 3.0]]}, "pair": {"edges": [[1, 2, 0.2]]}}
    prediction = predict(uneven(graphs, noise={"process": 1.0, "loss": loss} | noise, **more))
    found = mean_variance(prediction)
    path, alone = by_autocovariances(*patterns(prediction), np.eye(prediction.system.dimension))
    assert found.path == pytest.approx(path, rel=1e-6)
    assert found.of(1) == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize(
    "case",
    [
        "own, bursts",
        "real time, own, delay",
        "real time, held, bursts",
        "real time, delay",
        "held, grounded",
        "held, bursts",
    ],
)
def test_messages_that_are_kept_or_late(case: str) -> None:
    experiment = parse(case)
    found, brute = mean_variance(predict(experiment)), Brute(case, experiment)
    centre, form = np.eye(brute.size), np.diag([1.0] * brute.m + [0.0] * (brute.size - brute.m))
    if experiment.problem == "consensus":
        centre[:, : brute.m] -= 1.0 / brute.m
    maps = centre @ brute.maps()
    own, drawn = maps[:, :, : brute.size], maps[:, :, brute.size :]
    read = np.flatnonzero(own.any(axis=(0, 1)) | form.any(axis=0))
    square = np.ix_(range(len(maps)), read, read)
    noise = drawn @ drawn.transpose(0, 2, 1)
    path, alone = by_autocovariances(*brute.laws(), own[square], noise[square], form[np.ix_(read, read)])
    assert found.path == pytest.approx(path, rel=1e-6)
    assert found.of(1) == pytest.approx(alone, rel=1e-6)


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


@pytest.mark.parametrize("noise", [{"loss": 0.3, "on_loss": "hold", "link": 0.5}, {"loss": 0.6, "broadcast": 0.5}])
def test_of_a_large_network_it_is_sampled(noise: dict[str, Any]) -> None:
    """Within four of the standard errors that it states: fixed seed; of such tests 1 in 5000 would fail by chance."""
    prediction = predict(uneven({"path": PATH, "ring": RING}, noise={"process": 1.0} | noise))
    exact, near = mean_variance(prediction), mean_variance(prediction, most_work=0.0, sampled=3e8)
    assert exact.exact
    assert exact.error(4) == 0.0
    assert not near.exact
    for replicas in (1, 4):
        ratio = math.sqrt(near.of(replicas) / exact.of(replicas))
        assert ratio == pytest.approx(1.0, abs=4.0 * near.error(replicas))
        assert near.error(replicas) < 0.05


def test_runs_scatter_so_much() -> None:
    """80 runs of 2000 steps: the sum of squares over the variance, chi-square with 79 degrees: 1 % false alarms."""
    prediction = predict(uneven({"path": PATH, "ring": RING}, noise={"process": 1.0, "loss": 0.2, "link": 0.3}))
    means = []
    for seed in range(80):
        run = simulate(prediction.experiment.with_run(seed=seed, duration=300.0))
        states = run.states[:-1] - run.states[:-1].mean(axis=1, keepdims=True)
        means.append((states**2).sum(axis=1).mean())
    steps = 2000
    statistic = 79 * float(np.var(means, ddof=1)) / (mean_variance(prediction).of(2) / steps)
    low, high = scipy.special.chdtri(79, [0.995, 0.005])
    assert low < statistic < high


def test_no_fourth_moments() -> None:
    """Losses of messages with large weights: second moments exist, fourth do not."""
    graphs = {"mixed": {"arcs": [[1, 2, 1.0], [2, 1, 1.0], [2, 3, 1.0], [3, 1, 1.0]]}}
    run = {"dt": 0.95, "duration": 28.5}
    prediction = predict(uneven(graphs, noise={"process": 1.0, "loss": 0.3}, run=run))
    assert np.isfinite(prediction.emulated.system_error)
    chain, _, maps, _ = patterns(prediction)
    fourth = sum(p * np.kron(np.kron(w, w), np.kron(w, w)) for p, w in zip(chain[0], maps, strict=True))
    assert np.abs(np.linalg.eigvals(fourth)).max() > 1.4
    with pytest.raises(InputError, match="fourth moments of the states do not exist"):
        mean_variance(prediction)


@pytest.mark.parametrize(
    ("fields", "percent"),
    [
        ({"noise": {"loss": 0.9, "on_loss": "hold"}, "run": {"dt": 0.3, "duration": 1800, "replicas": 16}}, 0.561),
        ({"noise": {"loss": 0.5}, "run": {"dt": 0.6, "duration": 3600, "replicas": 16}}, 0.643),
    ],
)
def test_strong_losses_as_runs_measured_them(fields: dict[str, Any], percent: float) -> None:
    """Standard deviations of the means of 500 runs of another simulator, whose standard error is 3.2 %; within two."""
    prediction = predict(line_ring(graphs={"a": {"complete": True}}, switching={}, agents=3, **fields))
    found = math.sqrt(mean_variance(prediction).of(16) / 6000) / prediction.emulated.system_error
    assert 100.0 * found == pytest.approx(percent, rel=0.064)
