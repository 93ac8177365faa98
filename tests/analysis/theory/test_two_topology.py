"""The two-topology closed forms against the coupled solver and many digits; as printed: benchmarks/errata.py."""

import dataclasses
from decimal import localcontext

import numpy as np
import pytest
import scipy.linalg
from digits import DIGITS, exactly, solve
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import network

from experiments import predict
from msg_analysis.errors import InputError
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory.graph_indices import MAX_UNKNOWNS, two_topology
from msg_analysis.theory.moments import MomentSolver

MODELS = settings(max_examples=40, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def with_rate(system, rate):
    """The same stationary law with q12 + q21 = rate."""
    pi = system.stationary
    flow = rate * np.array([[-pi[1], pi[1]], [pi[0], -pi[0]]])
    return dataclasses.replace(system, chain=flow if system.time == "continuous" else np.eye(2) + flow)


@MODELS
@given(
    seeds,
    st.integers(2, 5),
    st.sampled_from(["consensus", "tracking", "grounded"]),
    st.sampled_from(["continuous", "emulated", "discrete"]),
    st.booleans(),
    st.booleans(),
)
def test_closed_form_is_the_solution_of_the_coupled_equations(seed, m, problem, law, directed, uneven):
    """Uneven: noise, and in steps losses, depend on the graph."""
    gain, time = np.inf if problem == "grounded" else 0.7, "discrete" if law == "discrete" else "continuous"
    kind = "consensus" if problem == "consensus" else "tracking"
    experiment = network(seed, m, 2, problem=kind, gain=gain, time=time, directed=directed, dt=0.01)
    system = systems.continuous(experiment) if law == "continuous" else predict(experiment).system
    random, d = np.random.default_rng(seed), system.dimension
    if uneven:
        f = random.standard_normal((2, d, d))
        system = dataclasses.replace(system, noise=f @ f.transpose(0, 2, 1))
    if uneven and law != "continuous":
        most = 0.01 if law == "discrete" else 1e-4  # for steps that are still stable
        system = dataclasses.replace(system, loss_variance=random.uniform(0.0, most, (2, m, m)))
    covariance = system.lifted(MomentSolver(system).steady().sum(axis=0))
    found = two_topology(system)
    np.testing.assert_allclose(found.node_errors, np.diag(covariance), rtol=1e-9, atol=1e-13)
    assert found.system_error == pytest.approx(np.trace(covariance), rel=1e-10)
    held = [MomentSolver(systems.held(system, mode)).steady()[0] for mode in range(2)]
    static = sum(share * np.diag(system.lifted(c)) for share, c in zip(system.stationary, held, strict=True))
    np.testing.assert_allclose(found.static, static, rtol=1e-9, atol=1e-13)


def exact_error(z, pi, q, beta):
    """tr sum C_i of two modes, in 80 digits, by the full Kronecker equations."""
    d = len(q)
    z, pi, q, beta = exactly(z), exactly(pi), exactly(q), exactly(beta).item()
    one, every = exactly(np.eye(d)), exactly(np.eye(d * d))
    with localcontext(prec=DIGITS):
        own = [np.kron(a, one) + np.kron(one, a) + beta * pi[1 - mode] * every for mode, a in enumerate(z)]
        matrix = np.block([[own[0], -beta * pi[0] * every], [-beta * pi[1] * every, own[1]]])
        solution = solve(matrix, np.concatenate([p * q.ravel() for p in pi]))
        return float(np.trace(solution.reshape(2, d, d).sum(axis=0)))


@pytest.mark.parametrize("rate", [1e-8, 1e-3, 1.0, 1e4, 1e8])
@pytest.mark.parametrize("gain", [None, 1e-3, 1e6, np.inf])
def test_any_rate_to_high_precision(rate, gain):
    problem = "consensus" if gain is None else "tracking"
    experiment = network(3, 4, 2, problem=problem, gain=gain or 1.0, directed=False, dt=1e-8)
    system = with_rate(systems.continuous(experiment), rate)
    pi = [system.stationary[0], 1 - system.stationary[0]]
    exact = exact_error(system.matrices, pi, system.noise[0], rate)
    assert two_topology(system).system_error == pytest.approx(exact, rel=1e-9)


@MODELS
@given(seeds, st.integers(2, 5), st.sampled_from(["continuous", "discrete"]), st.booleans())
def test_equal_noise_makes_switching_help_the_more_the_faster(seed, m, time, tracking):
    problem = "tracking" if tracking else "consensus"
    experiment = network(seed, m, 2, time=time, noise=1.0, problem=problem, directed=False, dt=0.01)
    system = systems.continuous(experiment) if time == "continuous" else predict(experiment).system
    fastest = 1.0 / system.stationary.max()  # no probability above 1
    rates = np.geomspace(1e-4, 1e4, 9) if time == "continuous" else np.linspace(0.05, 1.0, 9) * fastest
    gains = [two_topology(with_rate(system, rate)).switching.sum() for rate in rates]
    assert max(gains) <= 1e-12
    assert (np.diff(gains) <= 1e-12).all()


def test_fast_limits():
    experiment = network(8, 5, 2, directed=False)
    system = systems.continuous(experiment)
    averaged = np.tensordot(system.stationary, system.matrices, axes=1)
    slowest = scipy.linalg.solve_continuous_lyapunov(averaged, system.noise[0])
    found = two_topology(system)
    np.testing.assert_allclose(found.static + found.fast, np.diag(system.lifted(slowest)), rtol=1e-10)
    discrete = predict(network(8, 5, 2, time="discrete", directed=False)).system
    found = two_topology(discrete)
    independent = two_topology(with_rate(discrete, 1.0))
    np.testing.assert_allclose(found.fast, independent.switching, rtol=1e-10)


def test_graphs_that_hardly_differ_lose_nothing():
    """Relative accuracy of a switching term of 1e-14 of the error: its leading order is quadratic in the difference."""
    experiment = network(4, 4, 2, directed=False)
    system = systems.continuous(experiment)
    first = system.matrices[0]
    change = system.matrices[1] - first
    terms = []
    for size in (1e-3, 1e-7):
        near = dataclasses.replace(system, matrices=np.stack([first, first + size * change]))
        terms.append(two_topology(near).switching.sum() / size**2)
    assert terms[1] == pytest.approx(terms[0], rel=1e-2)


def test_what_is_refused():
    experiment = network(1, 3, 2)
    pieces = experiment.with_graphs({"g0": {"edges": [[1, 2]]}, "g1": {"edges": [[2, 3]]}})
    with pytest.raises(InputError, match="graph 1 held fixed has no steady error"):
        two_topology(systems.continuous(pieces))
    system = systems.continuous(experiment)
    with pytest.raises(InputError, match="1 graphs, expected 2"):
        two_topology(systems.held(system, 0))
    m = 80
    both = np.broadcast_to(np.eye(m), (2, m, m))
    large = dataclasses.replace(system, matrices=both, noise=both, lift=np.eye(m))
    assert m * (m + 1) // 2 > MAX_UNKNOWNS
    with pytest.raises(InputError, match="80 agents"):
        two_topology(large)
