"""Second moments against the paper's full Kronecker formulas, scipy and plain recursion."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_analysis.errors import InputError
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.theory import moments, solvers
from msg_analysis.theory.jump_system import JumpSystem, held
from msg_analysis.theory.moments import MomentSolver, mode_potential, transient_mean

MODELS = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def generator(random, n):
    rates = random.uniform(0.05, 2.0, (n, n))
    np.fill_diagonal(rates, 0.0)
    return rates - np.diag(rates.sum(axis=1))


def laplacian(random, m, directed=False):
    a = random.uniform(0.2, 1.5, (m, m)) * (random.random((m, m)) < 0.6)
    a[range(1, m), range(m - 1)] = 1.0  # a path, so that everybody hears agent 1
    np.fill_diagonal(a, 0.0)
    if not directed:
        a = a + a.T
    return np.diag(a.sum(axis=1)) - a


def covariance(random, m):
    f = random.standard_normal((m, m))
    return f @ f.T


def consensus(random, m, n, *, time="continuous", directed=False, dt=0.05, loss=False):
    """A consensus system, and the full matrices (Z or W) and noise that it came from."""
    lift = scipy.linalg.helmert(m).T
    z = np.stack([laplacian(random, m, directed) for _ in range(n)])
    gamma = generator(random, n)
    law = stationary_law(gamma)
    if time == "continuous":
        noise = np.stack([covariance(random, m)] * n)
        return JumpSystem(time, lift.T @ z @ lift, lift.T @ noise @ lift, gamma, law, lift), z, noise
    noise = np.stack([covariance(random, m) for _ in range(n)])  # differs from graph to graph
    w = np.eye(m) - dt * z
    variance = 0.2 * (dt * z * ~np.eye(m, dtype=bool)) ** 2 if loss else None
    chain = scipy.linalg.expm(gamma * dt * 5)
    return JumpSystem(time, lift.T @ w @ lift, lift.T @ noise @ lift, chain, law, lift, variance), w, noise


def step_operator(w, variance=None):
    """(m^2, m^2) matrix of C -> E[W C W^T], one matrix entry after the other."""
    m = len(w)
    operator = np.kron(w, w)
    if variance is not None:
        for i in range(m):
            for j in range(m):
                u = np.zeros(m)
                u[i], u[j] = u[i] + 1, u[j] - 1
                e = np.eye(m)[i]
                operator += variance[i, j] * np.outer(np.kron(e, e), np.kron(u, u))
    return operator


def brute_discrete(system, w, noise):
    """(n, m, m): the discrete twin of Proposition 3, unreduced, W projected from both sides."""
    n, m, _ = w.shape
    projector = np.eye(m) - 1 / m
    both = np.kron(projector, projector)
    blocks = np.zeros((n, m * m, n, m * m))
    right = np.zeros((n, m * m))
    for i in range(n):
        for j in range(n):
            variance = None if system.loss_variance is None else system.loss_variance[j]
            blocks[i, :, j] = system.chain[j, i] * both @ step_operator(w[j], variance) @ both
            right[i] += system.chain[j, i] * system.stationary[j] * both @ noise[j].ravel()
    solution = np.linalg.solve(np.eye(n * m * m) - blocks.reshape(n * m * m, -1), right.ravel())
    return solution.reshape(n, m, m)


def brute_continuous(system, z, noise):
    """(n, m, m): Proposition 3 as printed, with its pseudo-inverse of an n m^2 matrix."""
    n, m, _ = z.shape
    projector = np.eye(m) - 1 / m
    eye = np.eye(m)
    matrix = scipy.linalg.block_diag(*[np.kron(a, eye) + np.kron(eye, a) for a in projector @ z @ projector])
    matrix -= np.kron(system.chain.T, np.kron(projector, projector))
    right = np.concatenate(
        [p * (projector @ q @ projector).ravel() for p, q in zip(system.stationary, noise, strict=True)]
    )
    return (np.linalg.pinv(matrix, rcond=1e-11) @ right).reshape(n, m, m)


@MODELS
@given(seeds, st.integers(2, 5), st.integers(1, 3), st.booleans())
def test_continuous_steady_state_is_the_papers(seed, m, n, directed):
    system, z, noise = consensus(np.random.default_rng(seed), m, n, directed=directed)
    measured = system.lifted(MomentSolver(system).steady())
    np.testing.assert_allclose(measured, brute_continuous(system, z, noise), rtol=1e-8, atol=1e-9)


@MODELS
@given(seeds, st.integers(2, 5), st.integers(1, 3), st.booleans(), st.booleans())
def test_discrete_steady_state_with_noise_and_loss_that_depend_on_the_graph(seed, m, n, directed, loss):
    system, w, noise = consensus(np.random.default_rng(seed), m, n, time="discrete", directed=directed, loss=loss)
    measured = system.lifted(MomentSolver(system).steady())
    np.testing.assert_allclose(measured, brute_discrete(system, w, noise), rtol=1e-8, atol=1e-9)


@MODELS
@given(seeds, st.integers(2, 6))
def test_one_graph_is_scipys_lyapunov_and_stein(seed, m):
    random = np.random.default_rng(seed)
    system, _, _ = consensus(random, m, 1)
    oracle = scipy.linalg.solve_continuous_lyapunov(system.matrices[0], system.noise[0])
    np.testing.assert_allclose(MomentSolver(system).steady()[0], oracle, rtol=1e-10, atol=1e-12)
    system, _, _ = consensus(random, m, 1, time="discrete")
    oracle = scipy.linalg.solve_discrete_lyapunov(system.matrices[0], system.noise[0])
    np.testing.assert_allclose(MomentSolver(system).steady()[0], oracle, rtol=1e-10, atol=1e-12)


@MODELS
@given(seeds, st.integers(2, 5), st.integers(1, 4), st.sampled_from(["continuous", "discrete"]), st.booleans())
def test_dual_gives_the_same_error_as_primal(seed, m, n, time, loss):
    random = np.random.default_rng(seed)
    system, _, _ = consensus(random, m, n, time=time, directed=True, loss=loss and time == "discrete")
    solver = MomentSolver(system)
    forms = np.stack([covariance(random, m - 1) for _ in range(3)])
    dual = solver.dual(forms)
    primal = np.einsum("qab,iab->q", forms, solver.steady())
    if time == "continuous":
        other = np.einsum("i,qiab,iab->q", system.stationary, dual, system.noise)
    else:
        ahead = np.einsum("ij,qjab->qiab", system.chain, dual)
        other = np.einsum("i,qiab,iab->q", system.stationary, ahead, system.noise)
    np.testing.assert_allclose(other, primal, rtol=1e-12)


@MODELS
@given(seeds, st.integers(2, 4), st.integers(1, 3))
def test_poisson_equation(seed, m, n):
    """f - E[f(next) | now] = h - (steady mean of h) in every graph, the expectation written out."""
    random = np.random.default_rng(seed)
    system, _, _ = consensus(random, m, n, time="discrete")
    solver = MomentSolver(system)
    form = covariance(random, m - 1)
    dual = solver.dual(form[None])
    means, kappa = mode_potential(system, dual)
    assert means[0] == pytest.approx(np.trace(form @ solver.steady().sum(axis=0)), rel=1e-10)
    y = random.standard_normal(m - 1)
    for g in range(n):
        w, noise = system.matrices[g], system.noise[g]
        after = sum(
            system.chain[g, j] * (y @ w.T @ dual[0, j] @ w @ y + np.trace(dual[0, j] @ noise) + kappa[0, j])
            for j in range(n)
        )
        now = y @ dual[0, g] @ y + kappa[0, g]
        assert now - after == pytest.approx(y @ form @ y - means[0], rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("steps", [1, 7, 400])
def test_transient_mean_is_the_mean_of_the_plain_recursion(steps):
    system, _, _ = consensus(np.random.default_rng(4), 4, 3, time="discrete", loss=True)
    steady = MomentSolver(system).steady()
    y = np.array([1.0, -2.0, 0.5])
    law = np.array([0.0, 1.0, 0.0])
    moments, now, total = law[:, None, None] * np.outer(y, y), law, np.zeros((3, 3))
    for _ in range(steps):
        total += moments.sum(axis=0)
        after = np.zeros_like(moments)
        for j in range(3):
            full = system.lift @ moments[j] @ system.lift.T
            step = step_operator(np.eye(4), system.loss_variance[j]) - np.eye(16)
            spread = system.lift.T @ (step @ full.ravel()).reshape(4, 4) @ system.lift
            own = system.matrices[j] @ moments[j] @ system.matrices[j].T + spread + now[j] * system.noise[j]
            for i in range(3):
                after[i] += system.chain[j, i] * own
        moments, now = after, now @ system.chain
    measured = transient_mean(system, steady, law[:, None, None] * np.outer(y, y), law, steps)
    np.testing.assert_allclose(measured, total / steps, rtol=1e-11)


def test_transient_mean_from_the_steady_state_is_the_steady_state():
    system, _, _ = consensus(np.random.default_rng(5), 4, 2, time="discrete")
    steady = MomentSolver(system).steady()
    mean = transient_mean(system, steady, steady, system.stationary, 50)
    np.testing.assert_array_equal(mean, steady.sum(axis=0))


@pytest.mark.parametrize("rate", [1e3, 1e6, 1e9, 1e14])
def test_fast_switching_is_the_averaged_graph(rate):
    random = np.random.default_rng(6)
    slow, _, _ = consensus(random, 5, 3)
    fast = JumpSystem("continuous", slow.matrices, slow.noise, slow.chain * rate, slow.stationary, slow.lift)
    mean = np.einsum("i,iab->ab", slow.stationary, slow.matrices)
    oracle = scipy.linalg.solve_continuous_lyapunov(mean, slow.noise[0])
    solver = MomentSolver(fast)
    np.testing.assert_allclose(solver.steady().sum(axis=0), oracle, rtol=max(10 / rate, 1e-11), atol=10 / rate)
    dual = solver.dual(np.eye(4)[None])[0]
    assert np.einsum("i,iab,iab->", fast.stationary, dual, fast.noise) == pytest.approx(
        np.trace(oracle), rel=max(10 / rate, 1e-11)
    )


def test_slow_switching_is_the_mean_of_the_graphs_held_for_ever():
    system, _, _ = consensus(np.random.default_rng(7), 5, 3)
    slow = JumpSystem("continuous", system.matrices, system.noise, system.chain * 1e-9, system.stationary, system.lift)
    alone = [MomentSolver(held(slow, i)).steady()[0] for i in range(3)]
    oracle = np.tensordot(slow.stationary, np.stack(alone), axes=1)
    np.testing.assert_allclose(MomentSolver(slow).steady().sum(axis=0), oracle, rtol=1e-7)


def test_disconnected_graphs_with_connected_union():
    """Neither graph connects three agents, their union does: finite; each held for ever: refused."""
    lift = scipy.linalg.helmert(3).T
    z = np.array([[[1.0, -1, 0], [-1, 1, 0], [0, 0, 0]], [[0, 0, 0], [0, 1, -1], [0, -1, 1]]])
    noise = np.stack([np.eye(3)] * 2)
    gamma = np.array([[-1.0, 1.0], [1.0, -1.0]])
    system = JumpSystem("continuous", lift.T @ z @ lift, lift.T @ noise @ lift, gamma, np.array([0.5, 0.5]), lift)
    measured = system.lifted(MomentSolver(system).steady())
    np.testing.assert_allclose(measured, brute_continuous(system, z, noise), rtol=1e-9)
    with pytest.raises(InputError, match="union of the graphs"):
        MomentSolver(held(system, 0)).steady()


def test_unstable_steps_are_refused():
    system = JumpSystem("discrete", np.array([[[1.1]]]), np.ones((1, 1, 1)), np.ones((1, 1)), np.ones(1), np.eye(1))
    with pytest.raises(InputError, match="grow without bound"):
        MomentSolver(system).steady()


def test_too_large_says_the_size(monkeypatch):
    monkeypatch.setattr(solvers, "MAX_UNKNOWNS", 10)
    system, _, _ = consensus(np.random.default_rng(8), 4, 2)
    with pytest.raises(InputError, match="2 graphs of 4 agents give 12 coupled unknowns"):
        MomentSolver(system, method="dense")


def test_adjoint_solutions_are_kept_while_they_are_small(monkeypatch):
    system, _, _ = consensus(np.random.default_rng(8), 4, 2)
    solver = MomentSolver(system)
    one, other = np.eye(3)[None], np.diag([1.0, 2.0, 3.0])[None]
    first, second = solver.dual(one), solver.dual(other)
    assert solver.dual(one.copy()) is first
    assert not first.flags.writeable
    monkeypatch.setattr(moments, "MAX_KEPT", first.size + second.size)
    third = solver.dual(one + other)
    assert solver.dual(other) is second
    assert solver.dual(one + other) is not third
    np.testing.assert_allclose(third, first + second, rtol=1e-12)
