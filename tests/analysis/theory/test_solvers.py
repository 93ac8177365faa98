"""The matrix-free solvers on hard chains and graphs, against the dense reference, scipy and python-control.

The reference is itself checked against brute force in test_extensions.py.
"""

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import generator, system

from msg_analysis.errors import InputError
from msg_analysis.theory.jump_system import JumpSystem, held
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.solvers import DenseSolver, IterativeSolver

MODELS = settings(max_examples=30, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)
rates = st.sampled_from([1e-6, 1e-2, 1.0, 1e2, 1e6])


def agree(model, rtol=1e-9):
    """Matrix-free against dense: steady state and duals."""
    solver, dense = IterativeSolver(model), DenseSolver(model)
    expected = dense.steady()
    np.testing.assert_allclose(solver.steady(), expected, rtol=rtol, atol=rtol * np.abs(expected).max())
    assert solver.report.error <= 1e-12
    forms = np.stack([np.eye(model.dimension), np.diag(np.arange(model.dimension) == 0).astype(float)])
    expected = dense.dual(forms)
    np.testing.assert_allclose(solver.dual(forms), expected, rtol=rtol, atol=rtol * np.abs(expected).max())
    return solver


@MODELS
@given(seeds, st.integers(2, 7), st.integers(1, 4), rates, st.sampled_from(["symmetric", "directed", "chain"]))
def test_continuous_time_is_the_dense_solution(seed, m, n, rate, kind):
    random = np.random.default_rng(seed)
    agree(system(random, m, generator(random, n, rate), kind))


kinds = st.sampled_from(["symmetric", "directed", "chain"])


@MODELS
@given(seeds, st.integers(2, 7), st.integers(1, 4), rates, kinds, st.booleans())
def test_discrete_time_is_the_dense_solution(seed, m, n, rate, kind, loss):
    random = np.random.default_rng(seed)
    agree(system(random, m, generator(random, n, rate), kind, dt=0.03, loss=loss), rtol=1e-8)


@MODELS
@given(seeds, st.integers(4, 8), st.integers(2, 4), st.sampled_from([1e-2, 1.0, 1e2]), st.sampled_from([None, 0.1]))
def test_disconnected_graphs(seed, m, n, rate, dt):
    random = np.random.default_rng(seed)
    agree(system(random, m, generator(random, n, rate), "pieces", dt), rtol=1e-7)  # the dense one loses digits


@pytest.mark.parametrize("kind", ["symmetric", "directed", "pieces"])
@pytest.mark.parametrize("fast", [1e2, 1e5])
def test_groups_of_graphs_that_switch_fast_among_themselves(kind, fast):
    gamma = np.array([[0, fast, 1e-2, 0], [fast, 0, 0, 1e-2], [2e-2, 0, 0, fast], [0, 1e-2, fast, 0]])
    gamma -= np.diag(gamma.sum(axis=1))
    solver = agree(system(np.random.default_rng(3), 10, gamma, kind), rtol=1e-7)
    assert solver.report.iterations < 60


@pytest.mark.parametrize("dt", [None, 0.02])
@pytest.mark.parametrize("rate", [1e-4, 0.1, 1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("reversible", [True, False])
def test_large_systems_in_single_precision_are_as_accurate(rate, dt, reversible):
    """Products in single precision, against double precision throughout."""
    random = np.random.default_rng(4)
    model = system(random, 90, generator(random, 3, rate, reversible=reversible), dt=dt)
    solver = IterativeSolver(model)
    forms = np.stack([np.eye(89), np.zeros((89, 89))])
    measured, (dual, nothing) = solver.steady(), solver.dual(forms)
    assert not nothing.any()
    reference = IterativeSolver(model, single_from=1000)
    expected = reference.steady()
    np.testing.assert_allclose(measured, expected, rtol=1e-11, atol=1e-11 * expected.max())
    np.testing.assert_allclose(dual, reference.dual(forms)[0], rtol=1e-10, atol=1e-10)


def test_what_is_chosen():
    random = np.random.default_rng(5)
    reversible, other = generator(random, 3, reversible=True), generator(random, 3)

    def method(model):
        solver = MomentSolver(model)
        solver.steady()
        assert solver.report.iterations < 30
        return solver.report.method, solver.report.preconditioner

    assert method(system(random, 8, reversible)) == ("gmres", "two-level")
    assert method(system(random, 8, reversible, dt=0.05)) == ("gmres", "two-level")
    assert method(held(system(random, 8, other), 1)) == ("direct", "none")


PERIODIC = np.roll(np.eye(4), 1, axis=1)


@pytest.mark.parametrize("chain", [np.full((4, 4), 0.25), PERIODIC, 0.999 * PERIODIC + 0.001 * np.eye(4)])
def test_independent_and_periodic_graphs(chain):
    random = np.random.default_rng(6)
    slow = system(random, 12, generator(random, 4), dt=0.05)
    agree(JumpSystem("discrete", slow.matrices, slow.noise, chain, np.full(4, 0.25), slow.lift))


def test_gossip_of_random_pairs():
    """Independent pairwise averaging: E[W C W^T] is not the averaged graph's, yet few iterations do."""
    random, m, n = np.random.default_rng(7), 12, 20
    lift, steps = scipy.linalg.helmert(m).T, np.stack([np.eye(m)] * n)
    for step in steps:
        i, j = random.choice(m, 2, replace=False)
        step[np.ix_([i, j], [i, j])] = 0.5
    steps[0] = 1.0 / m
    noise = np.stack([np.eye(m - 1)] * n)
    model = JumpSystem("discrete", lift.T @ steps @ lift, noise, np.full((n, n), 1 / n), np.full(n, 1 / n), lift)
    solver = agree(model)
    assert solver.report.iterations < 40


@pytest.mark.parametrize("kind", ["symmetric", "directed"])
def test_one_graph_is_the_h2_norm(kind):
    """E is the squared H2 norm of the network, by python-control."""
    model = held(system(np.random.default_rng(8), 7, np.array([[-1.0, 1], [1, -1]]), kind), 0)
    root = np.linalg.cholesky(model.noise[0])
    plant = control.ss(-model.matrices[0], root, np.eye(6), np.zeros((6, 6)))
    assert np.trace(MomentSolver(model).steady()[0]) == pytest.approx(control.system_norm(plant, 2) ** 2, rel=1e-8)


def test_union_that_does_not_connect_is_refused():
    pieces = np.kron(np.eye(2), [[1.0, -1.0], [-1.0, 1.0]])
    lift = scipy.linalg.helmert(4).T
    z = lift.T @ np.stack([pieces, 2 * pieces]) @ lift
    gamma = np.array([[-1.0, 1.0], [1.0, -1.0]])
    model = JumpSystem("continuous", z, np.stack([np.eye(3)] * 2), gamma, np.array([0.5, 0.5]), lift)
    for kind in (MomentSolver, IterativeSolver, DenseSolver):
        with pytest.raises(InputError, match="union of the graphs connects all agents"):
            kind(model).steady()


@pytest.mark.parametrize("size", [8, 90])
def test_unstable_steps_are_refused(size):
    random = np.random.default_rng(11)
    gamma = generator(random, 2, reversible=True)
    stable = system(np.random.default_rng(1), size, gamma, dt=0.01)
    largest = np.linalg.eigvalsh(np.eye(size - 1) - stable.matrices).max() / 0.01
    MomentSolver(system(np.random.default_rng(1), size, gamma, dt=1.9 / largest)).steady()
    with pytest.raises(InputError, match="grow without bound"):
        MomentSolver(system(np.random.default_rng(1), size, gamma, dt=3.0 / largest)).steady()


def test_drift_that_pushes_away_is_refused():
    z = np.array([np.diag([1.0, -0.5]), np.diag([1.0, 0.7])])
    gamma = np.array([[-0.1, 0.1], [0.1, -0.1]])
    model = JumpSystem("continuous", z, np.stack([np.eye(2)] * 2), gamma, np.array([0.5, 0.5]), np.eye(2))
    with pytest.raises(InputError, match="grow without bound"):
        MomentSolver(model).steady()


def test_no_convergence_is_an_error_or_a_dense_solve():
    random = np.random.default_rng(12)
    model = system(random, 12, generator(random, 4), "directed")
    unknowns = 4 * 11 * 12 // 2
    solver = MomentSolver(model, most_dense=unknowns, most_iterations=2)
    solver.steady()
    assert solver.report.method == "dense"
    with pytest.raises(InputError, match="iterations do not converge"):
        MomentSolver(model, most_dense=unknowns - 1, most_iterations=2).steady()


def test_many_forms_are_solved_in_batches():
    random = np.random.default_rng(13)
    model = system(random, 9, generator(random, 3))
    forms = np.stack([a + a.T for a in random.standard_normal((7, 8, 8))])
    together = IterativeSolver(model).dual(forms)
    np.testing.assert_allclose(IterativeSolver(model, chunk=400).dual(forms), together, rtol=1e-10, atol=1e-12)
