"""Second moments against the paper's full Kronecker formulas, scipy and plain recursion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import generator
from switching_systems import system as switching

from msg_analysis.errors import InputError
from msg_analysis.theory.moments import MomentSolver, mode_potential
from msg_analysis.theory.solvers import DenseSolver

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
    y = random.standard_normal(m - 1)
    for g in range(n):
        w, noise = system.matrices[g], system.noise[g]
        after = sum(
            system.chain[g, j] * (y @ w.T @ dual[0, j] @ w @ y + np.trace(dual[0, j] @ noise) + kappa[0, j])
            for j in range(n)
        )
        now = y @ dual[0, g] @ y + kappa[0, g]
        assert now - after == pytest.approx(y @ form @ y - means[0], rel=1e-8, abs=1e-8)


def test_too_large_says_the_size():
    system = switching(np.random.default_rng(8), 4, generator(np.random.default_rng(9), 2))
    with pytest.raises(InputError, match=r"2 graphs of 4 agents give 12 coupled unknowns.* at most 11 are"):
        DenseSolver(system, most_unknowns=11)
    DenseSolver(system, most_unknowns=12)


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
