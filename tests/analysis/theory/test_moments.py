"""Second moments against the paper's full Kronecker formulas, scipy and plain recursion."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import generator, steady_of
from switching_systems import system as switching

from msg_analysis.errors import InputError
from msg_analysis.theory.first_steps import MomentsAt
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver, mode_potential, transient_mean

MODELS = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def covariance(random, m):
    f = random.standard_normal((m, m))
    return f @ f.T


@MODELS
@given(seeds, st.integers(2, 5), st.integers(1, 4), st.sampled_from(["continuous", "discrete"]), st.booleans())
def test_dual_gives_the_same_error_as_primal(seed, m, n, time, loss):
    random = np.random.default_rng(seed)
    dt = None if time == "continuous" else 0.05
    system = switching(random, m, generator(random, n), "directed", dt, loss)
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
    system = switching(random, m, generator(random, n), dt=0.05)
    solver = MomentSolver(system)
    form = covariance(random, m - 1)
    dual = solver.dual(form[None])
    means, kappa = mode_potential(system, dual)
    assert means[0] == pytest.approx(np.trace(form @ solver.steady().sum(axis=0)), rel=1e-10)
    assert kappa[0] @ system.stationary == pytest.approx(0.0, abs=1e-9 * means[0])
    y = random.standard_normal(m - 1)
    for g in range(n):
        w, noise = system.matrices[g], system.noise[g]
        after = sum(
            system.chain[g, j] * (y @ w.T @ dual[0, j] @ w @ y + np.trace(dual[0, j] @ noise) + kappa[0, j])
            for j in range(n)
        )
        now = y @ dual[0, g] @ y + kappa[0, g]
        assert now - after == pytest.approx(y @ form @ y - means[0], rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("size", [1.0, 1e-20])
@pytest.mark.parametrize("steps", [1, 2, 8, 9, 60, 10**9])
def test_the_mean_over_the_steps_from_a_known_start(steps, size):
    """Step after step from the definition; of a billion, few differ from the steady state."""
    random = np.random.default_rng(3)
    system = switching(random, 4, generator(random, 3, 40.0), dt=0.05)
    system = dataclasses.replace(system, noise=size * system.noise)
    y, first = 9.0 * np.sqrt(size) * random.standard_normal(3), np.array([0.2, 0.8, 0.0])
    moments, law, total, steady = first[:, None, None] * np.outer(y, y), first, 0.0, steady_of(system)
    for _ in range(min(steps, 3000)):
        total = total + moments.sum(axis=0)
        after = system.matrices @ moments @ system.matrices.transpose(0, 2, 1) + law[:, None, None] * system.noise
        moments, law = np.tensordot(system.chain, after, axes=(0, 0)), law @ system.chain
    total += max(steps - 3000, 0) * steady.sum(axis=0)
    start = [MomentsAt(first, np.outer(first, y), first[:, None, None] * np.outer(y, y))]
    found = transient_mean(system, steady, start, steps)
    np.testing.assert_allclose(found, total / steps, rtol=1e-11, atol=1e-13 * size)


def test_a_start_with_steady_moments_under_another_graph_leaves_them():
    random = np.random.default_rng(3)
    system = switching(random, 4, generator(random, 2, 1.0), dt=0.05)
    steady, first = steady_of(system), np.array([1.0, 0.0])
    found = transient_mean(system, steady, [MomentsAt(first, np.zeros((2, 3)), steady)], 2)
    after, _ = system.advance(steady, first)
    np.testing.assert_allclose(found, (steady + after).sum(axis=0) / 2, rtol=1e-12)


@pytest.mark.parametrize("noise", [1.0, 1e-9, 0.0])
def test_the_claimed_error_is_what_rounding_of_the_matrices_may_leave(noise):
    """Coordinates that do not act on each other, one of them slow: every moment from two equations."""
    drift, q = np.array([[1.0, 1e-4], [3.0, 2e-4]]), noise * np.array([[1.0, 2.0], [0.5, 4.0]])
    gamma, law = np.array([[-1.0, 1.0], [3.0, -3.0]]), np.array([0.75, 0.25])
    diagonals = [np.linalg.solve(2.0 * np.diag(z) - gamma.T, law * own) for z, own in zip(drift.T, q.T, strict=True)]
    moments = np.stack([np.diag(c) for c in np.transpose(diagonals)])
    stacks = [np.stack([np.diag(row) for row in rows]) for rows in (drift, q)]
    solver = MomentSolver(JumpSystem("continuous", *stacks, gamma, law, np.eye(2)))
    assert solver.report is None
    np.testing.assert_allclose(solver.steady(), moments, rtol=1e-9, atol=1e-15 * noise)
    sizes = np.abs(moments).max(axis=(1, 2))
    rounded = 8.0 * 2.0**-52 * 2.0 * np.array([1.0, 3.0]) * sizes / law
    left = np.array([np.linalg.solve(2.0 * np.diag(z) - gamma.T, law * rounded) for z in drift.T])
    expected = (left.max(axis=0) / sizes).max() if noise else 0.0
    assert solver.report.error == pytest.approx(expected, rel=1e-6, abs=0.0)


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e3])
def test_no_positive_solution_is_refused_and_nothing_that_is_zero(size):
    """A moment may be negative by 1e-6 of the largest one, as rounding leaves it, and no more."""
    z = np.stack([np.diag([1.0, 1.0, 2.0])])

    def steady(least):
        noise = size * np.stack([np.diag([0.0, 2.0, 4.0 * least])])
        return MomentSolver(JumpSystem("continuous", z, noise, np.zeros((1, 1)), np.ones(1), np.eye(3))).steady()

    np.testing.assert_allclose(steady(-0.9e-6)[0], size * np.diag([0.0, 1.0, -0.9e-6]), rtol=1e-12)
    with pytest.raises(InputError, match="no positive solution, so the errors grow without bound"):
        steady(-1.1e-6)


@pytest.mark.parametrize("dt", [None, 0.05])
def test_a_guess_saves_iterations_and_changes_nothing(dt):
    random = np.random.default_rng(9)
    gamma = generator(random, 3)
    first = switching(np.random.default_rng(1), 15, gamma, dt=dt)
    second = switching(np.random.default_rng(1), 15, gamma * (1 + 1e-4), dt=dt)
    start = MomentSolver(first).steady()
    cold, warm = MomentSolver(second), MomentSolver(second, guess=start)
    np.testing.assert_allclose(warm.steady(), cold.steady(), rtol=1e-10, atol=1e-12)
    assert warm.report.iterations < cold.report.iterations
    with pytest.raises(InputError, match=r"guess: shape \(3, 3, 3\).*\(3, 14, 14\)"):
        MomentSolver(second, guess=np.zeros((3, 3, 3)))


def test_systems_without_coordinates():
    empty = np.zeros((1, 0, 0))
    solver = MomentSolver(JumpSystem("continuous", empty, empty, np.zeros((1, 1)), np.ones(1), np.zeros((2, 0))))
    assert solver.steady().shape == (1, 0, 0)
    assert solver.report.method == "dense"


def test_adjoint_solutions_are_kept_while_they_are_small():
    system = switching(np.random.default_rng(8), 4, generator(np.random.default_rng(9), 2))
    solver = MomentSolver(system, most_kept=2 * 2 * 3 * 3)
    one, other = np.eye(3)[None], np.diag([1.0, 2.0, 3.0])[None]
    first, second = solver.dual(one), solver.dual(other)
    assert solver.dual(one.copy()) is first
    assert not first.flags.writeable
    third = solver.dual(one + other)
    assert solver.dual(other) is second
    assert solver.dual(one + other) is not third
    np.testing.assert_allclose(third, first + second, rtol=1e-12)
