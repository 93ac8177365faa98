"""What lies beyond the paper, against brute force: every pattern of losses written out, nothing reduced.

The oracles are built from the document of the experiment alone. Second moments are those of the stacked states
x(k), ..., x(k - d) of all agents, in full Kronecker form, and are stepped many thousand times.
"""

import itertools
import json

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import Experiment, line_ring, predict
from msg_analysis.errors import InputError
from msg_analysis.model.step_model import build_step_model
from msg_analysis.theory.first_steps import MomentsAt
from msg_analysis.theory.jump_system import emulated, held
from msg_analysis.theory.moments import MomentSolver, transient_mean
from msg_analysis.theory.solvers import DenseSolver

MODELS = settings(max_examples=40, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)
DT = 0.1
DOUBLINGS = 15  # 2^15 steps: whatever the start was, it is forgotten


def process_noise(random, m, names):
    kinds = [
        lambda: float(random.uniform(0.1, 2.0)),
        lambda: random.uniform(0.0, 2.0, m).tolist(),
        lambda: random.standard_normal((m, m)).tolist(),
    ]
    one = [kinds[random.integers(3)]() for _ in names]
    return dict(zip(names, one, strict=True)) if random.random() < 0.7 else one[0]


def document(seed, *, steps_only=True):
    """A random experiment: any graphs whose union connects everybody, any noise."""
    random = np.random.default_rng(seed)
    m, n = int(random.integers(2, 4)), int(random.integers(1, 4))
    names = [f"g{i}" for i in range(n)]
    directed, tracking, discrete = random.random(3) < (0.5, 0.5, 0.3)
    links = {name: {} for name in names}
    for i, j in itertools.permutations(range(1, m + 1), 2):
        for name in names:
            if random.random() < 0.3 and (directed or i < j):
                links[name][i, j] = float(random.uniform(0.2, 1.5))
    for i in range(1, m):  # everybody hears agent 1 in the union, in whatever graphs
        links[names[random.integers(n)]][i, i + 1] = float(random.uniform(0.5, 1.5))
    graphs = {name: {"arcs" if directed else "edges": [[*ij, w] for ij, w in links[name].items()]} for name in names}
    rates = random.uniform(0.1, 5.0, (n, n))
    np.fill_diagonal(rates, 0.0)
    generator = rates - np.diag(rates.sum(axis=1))
    given = {
        "name": "random",
        "problem": "tracking" if tracking else "consensus",
        "time": "discrete" if discrete else "continuous",
        "agents": m,
        "graphs": graphs,
        "switching": {"transition": scipy.linalg.expm(0.3 * generator).tolist()}
        if discrete
        else {"generator": generator.tolist()},
        "noise": {"process": process_noise(random, m, names)},
        "run": {"duration": 10.0} | ({} if discrete else {"dt": DT}),
    }
    if steps_only:
        for key in ("broadcast", "link", "loss"):
            if random.random() < 0.6:
                given["noise"][key] = float(random.uniform(0.05, 0.6))
        given["noise"]["delay"] = int(random.integers(3))
    if tracking:
        given["leaders"] = {"agents": [1], "gain": float(random.choice([0.4, 2.0, np.inf]))}
    return given


def gain_matrix(given, name):
    process = given["noise"]["process"]
    value = np.array(process[name] if isinstance(process, dict) else process)
    m = given["agents"]
    return np.eye(m) * value if value.ndim == 0 else np.diag(value) if value.ndim == 1 else value


def pull_matrix(given, name):
    """(Z, whether an agent is held at the reference)."""
    m = given["agents"]
    z = np.zeros((m, m))
    for kind, links in given["graphs"][name].items():
        for i, j, weight in links:
            for source, target in [(i, j)] if kind == "arcs" else [(i, j), (j, i)]:
                z[target - 1, target - 1] += weight
                z[target - 1, source - 1] -= weight
    grounded = np.zeros(m, dtype=bool)
    if "leaders" in given:
        if given["leaders"]["gain"] == np.inf:
            grounded[0] = True
        else:
            z[0, 0] += given["leaders"]["gain"]
    return z, grounded


def step_without_loss(given, name):
    """(W, B) of one graph."""
    z, grounded = pull_matrix(given, name)
    gain = gain_matrix(given, name)
    if given["time"] == "continuous":
        w, gain = np.eye(len(z)) - DT * z, np.sqrt(DT) * gain
        w[grounded], gain[grounded] = 0.0, 0.0
        return w, gain
    w = np.zeros_like(z)
    w[np.ix_(~grounded, ~grounded)] = scipy.linalg.expm(-z[np.ix_(~grounded, ~grounded)])
    return w, gain


def full_operators(given, name):
    """((M m)^2 operator, covariance of the noise) of one graph: every pattern of lost messages, one after the other."""
    noise = {"broadcast": 0.0, "link": 0.0, "loss": 0.0, "delay": 0} | given["noise"]
    m, blocks = given["agents"], noise["delay"] + 1
    w, gain = step_without_loss(given, name)
    links = [(i, j) for i, j in itertools.permutations(range(m), 2) if w[i, j] != 0.0]
    size = m * blocks
    operator, covariance = np.zeros((size**2, size**2)), np.zeros((size, size))
    for pattern in itertools.product([False, True], repeat=len(links)):
        chance = np.prod([noise["loss"] if lost else 1.0 - noise["loss"] for lost in pattern])
        if chance == 0.0:
            continue
        now, old = np.diag(np.diag(w)), np.zeros((m, m))
        for (i, j), lost in zip(links, pattern, strict=True):
            if lost:
                now[i, i] += w[i, j]
            else:
                old[i, j] = w[i, j]
        step = np.eye(size, k=-m)
        step[:m] = 0.0
        step[:m, :m] += now
        step[:m, -m:] += old
        operator += chance * np.kron(step, step)
        entering = gain @ gain.T + noise["broadcast"] ** 2 * old @ old.T
        entering += noise["link"] ** 2 * np.diag((old**2).sum(axis=1))
        covariance[:m, :m] += chance * entering
    return operator, covariance


def transition_and_law(given):
    if given["time"] == "discrete":
        chain = np.array(given["switching"]["transition"])
    else:
        chain = scipy.linalg.expm(DT * np.array(given["switching"]["generator"]))
    law = np.linalg.matrix_power(chain, 10_000)[0]
    return chain, law


def affine_step(given, law):
    """Matrix of one step of (second moments of all graphs, 1), for a graph that keeps its law."""
    chain, _ = transition_and_law(given)
    parts = [full_operators(given, name) for name in given["graphs"]]
    n, size = len(parts), len(parts[0][0])
    matrix = np.zeros((n * size + 1, n * size + 1))
    matrix[-1, -1] = 1.0
    for i, j in itertools.product(range(n), repeat=2):
        operator, covariance = parts[j]
        matrix[i * size : (i + 1) * size, j * size : (j + 1) * size] = chain[j, i] * operator
        matrix[i * size : (i + 1) * size, -1] += chain[j, i] * law[j] * covariance.ravel()
    return matrix


def agents_moments(given, vector):
    """(n, m, m) of the agents now: deviations from their mean (consensus) or from the reference."""
    m, n = given["agents"], len(given["graphs"])
    size = round(np.sqrt(len(vector[:-1]) / n))
    moments = vector[:-1].reshape(n, size, size)[:, :m, :m]
    if given["problem"] == "tracking":
        return moments
    centre = np.eye(m) - 1 / m
    return centre @ moments @ centre


def steady_by_stepping(given):
    _, law = transition_and_law(given)
    matrix = affine_step(given, law)
    for _ in range(DOUBLINGS):
        matrix = matrix @ matrix
    return agents_moments(given, matrix[:, -1])


@MODELS
@given(seeds)
def test_steps_with_everything_are_those_of_brute_force(seed):
    given = document(seed)
    prediction = predict(Experiment.parse(given))
    expected = steady_by_stepping(given)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(prediction.emulated.by_mode, expected, rtol=1e-7, atol=1e-8 * scale)
    np.testing.assert_allclose(prediction.emulated.covariance, expected.sum(axis=0), rtol=1e-7, atol=1e-8 * scale)
    dense = DenseSolver(prediction.system).steady()
    np.testing.assert_allclose(prediction.system.lifted(dense), expected, rtol=1e-7, atol=1e-8 * scale)
    json.dumps(prediction.to_json(), allow_nan=False)


@pytest.mark.parametrize(("seed", "steps"), [*((seed, 7) for seed in range(12)), (1, 3000), (2, 3000)])
def test_transient_with_everything_is_that_of_brute_force(seed, steps):
    """From a known start, which a delay takes to have been the same before (its messages: test_first_steps.py)."""
    given = document(seed)
    experiment = Experiment.parse(given)
    _, law = transition_and_law(given)
    blocks = given["noise"]["delay"] + 1
    x = np.random.default_rng(seed).standard_normal(given["agents"])
    stacked = np.tile(x, blocks)
    vector = np.concatenate([np.kron(law, np.kron(stacked, stacked)), [1.0]])
    matrix, total = affine_step(given, law), 0.0
    for _ in range(steps):
        total = total + agents_moments(given, vector).sum(axis=0)
        vector = matrix @ vector
    system = emulated(build_step_model(experiment), experiment.problem)
    y = system.reduced(x)
    law = system.stationary
    start = [MomentsAt(law, np.outer(law, y), law[:, None, None] * np.outer(y, y))]
    measured = transient_mean(system, MomentSolver(system).steady(), start, steps)
    np.testing.assert_allclose(system.lifted(measured), total / steps, rtol=1e-9, atol=1e-9)


@MODELS
@given(seeds)
def test_continuous_time_with_noise_by_graph_is_the_papers_equation(seed):
    """Z C + C Z^T - sum_j Gamma_ji C_j = pi_i Q_i: by pseudo-inverse (consensus), leaders deleted (tracking)."""
    given = document(seed, steps_only=False) | {"time": "continuous"}
    random = np.random.default_rng(seed)
    n, m = len(given["graphs"]), given["agents"]
    rates = random.uniform(0.1, 3.0, (n, n))
    np.fill_diagonal(rates, 0.0)
    gamma = rates - np.diag(rates.sum(axis=1))
    given["switching"], given["run"] = {"generator": gamma.tolist()}, {"dt": DT, "duration": 10.0}
    law = scipy.linalg.null_space(gamma.T)[:, 0]
    law /= law.sum()
    _, grounded = pull_matrix(given, "g0")
    keep = np.eye(m)[:, ~grounded]
    if given["problem"] == "consensus":
        keep = np.eye(m) - 1 / m
    z = [keep.T @ pull_matrix(given, name)[0] @ keep for name in given["graphs"]]
    q = [keep.T @ gain_matrix(given, name) @ gain_matrix(given, name).T @ keep for name in given["graphs"]]
    eye, inner = np.eye(len(z[0])), keep.T @ keep
    matrix = scipy.linalg.block_diag(*[np.kron(a, eye) + np.kron(eye, a) for a in z])
    matrix -= np.kron(gamma.T, np.kron(inner, inner))
    right = np.concatenate([share * a.ravel() for share, a in zip(law, q, strict=True)])
    solution = (np.linalg.pinv(matrix, rcond=1e-11) @ right).reshape(n, len(eye), len(eye))
    expected = keep @ solution @ keep.T
    measured = predict(Experiment.parse(given)).continuous.by_mode
    np.testing.assert_allclose(measured, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def fast(**noise):
    """The line and the ring, that switch fast."""
    chain = {"generator": [[-2.0, 2.0], [5.0, -5.0]]}
    return line_ring(5, switching=chain, noise=noise, run={"dt": 0.1, "duration": 10})


def test_noise_by_graph_with_names_and_without_steps():
    """The same for every graph is the same noise; each graph held for ever has its own."""
    gains = [1.0, 2.0, 0.0, 1.0, 1.0]
    one = predict(fast(process=gains))
    by_name = predict(fast(process={"ring": gains, "line": gains}))
    assert one.to_json() == by_name.to_json()
    prediction = predict(fast(process={"line": 2.0, "ring": 0.5}))
    assert prediction.static.system_error == pytest.approx(5 / 7 * 4.0 * 2.0 + 2 / 7 * 0.25 * 1.0, rel=1e-12)


def test_held_keeps_the_delay():
    experiment = fast(delay=2, process={"line": 1.0, "ring": 3.0})
    alone = held(emulated(build_step_model(experiment), "consensus"), 1)
    ring = {"graphs": {"ring": {"cycle": [1, 2, 3, 4, 5]}}, "switching": {}, "noise": {"delay": 2, "process": 3.0}}
    expected = predict(line_ring(5, **ring, run={"dt": 0.1, "duration": 10})).emulated.covariance
    np.testing.assert_allclose(alone.lifted(MomentSolver(alone).steady()[0]), expected, rtol=1e-12)


def complete(dt, **noise):
    """Four agents who all hear each other: stable below dt = 0.5 without delay, and below 1/3 with one step of it."""
    graphs, run = {"all": {"complete": True}}, {"dt": dt, "duration": 10 * dt}
    return line_ring(agents=4, graphs=graphs, switching={}, noise=noise, run=run)


def test_steps_that_delay_makes_unstable_are_refused():
    assert predict(complete(0.4)).emulated.system_error > 0.0
    assert predict(complete(0.33, delay=1)).emulated.system_error > 0.0
    with pytest.raises(InputError, match=r"grow without bound.* every dt below 0\.3333 is stable"):
        predict(complete(0.4, delay=1))


@pytest.mark.parametrize("process", [0.0, [[1.0] * 4] * 4])
def test_noise_that_does_not_show_instability_hides_nothing(process):
    """Without noise, or with the same noise for everybody, nothing grows from agreement; from elsewhere it does."""
    stable = predict(complete(0.4, process=process)).to_json()["emulated"]
    assert stable["system_error"] == 0.0
    assert stable["system_certainty"] is None
    with pytest.raises(InputError, match="without bound"):
        predict(complete(0.4, process=process, delay=1))


def test_agents_without_errors_have_no_certainty():
    """Noise at the end of a chain that nobody listens to: the others follow the leader exactly."""
    graphs = {"a": {"arcs": [[1, 2], [2, 3]]}, "b": {"arcs": [[1, 2], [1, 3]]}}
    noise = {"process": [0.0, 0.0, 1.0], "delay": 2}
    chain = line_ring(problem="tracking", graphs=graphs, leaders={"agents": [1]}, noise=noise)
    law = predict(chain).to_json()["emulated"]
    assert law["node_errors"][:2] == [0.0, 0.0]
    assert law["node_certainty"][:2] == [None, None]
    assert law["node_certainty"][2] > 0.0
