"""Transients and settling times: against the paper's full Kronecker equations, plain recursions and last crossings."""

import dataclasses
from decimal import Decimal, localcontext

import numpy as np
import pytest
import scipy.linalg
from digits import DIGITS, exactly, expm
from hypothesis import given, settings
from hypothesis import strategies as st
from switching_systems import LINE_RING, network, steady_of

from experiments import Experiment, line_ring, predict
from msg_analysis.errors import InputError
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory import transient
from msg_analysis.theory.rational_krylov import RationalFlow
from msg_analysis.theory.settling import asymptotic_rates, settling_time
from msg_analysis.theory.transient import point_start, start_of, unreduced_consensus

PROBLEMS = "consensus", "tracking"
MODELS = settings(max_examples=20, deadline=None, derandomize=True)


def pulls(experiment):
    return [graph.laplacian + np.diag(experiment.leader_gains) for graph in experiment.graph_list]


def unreduced(experiment):
    """Two matrices, of which the sum moves (c, pi): of the drift and the noise, and of the chain, by the paper."""
    m, n = experiment.agents, len(experiment.graph_list)
    gamma, eye, size = experiment.chain.matrix, np.eye(m), n * m * m
    drift, flow = np.zeros((2, size + n, size + n))
    drift[:size, :size] = -scipy.linalg.block_diag(*(np.kron(a, eye) + np.kron(eye, a) for a in pulls(experiment)))
    drift[:size, size:] = scipy.linalg.block_diag(*((f @ f.T).reshape(-1, 1) for f in experiment.noise_gain))
    flow[:size, :size], flow[size:, size:] = np.kron(gamma.T, np.eye(m * m)), gamma.T
    return drift, flow


def beginning(start, law):
    """(c, pi) for x(0) = start, g(0) ~ law."""
    return np.concatenate([np.kron(law, np.outer(start, start).ravel()), law])


def kronecker(experiment, start, law, time):
    """pi, nu (n, m), c (n, m, m) at one time."""
    m, n = experiment.agents, len(experiment.graph_list)
    first = scipy.linalg.block_diag(*pulls(experiment)) - np.kron(experiment.chain.matrix.T, np.eye(m))
    now = scipy.linalg.expm(sum(unreduced(experiment)) * time) @ beginning(start, law)
    nu = scipy.linalg.expm(-first * time) @ np.kron(law, start)
    return now[-n:], nu.reshape(n, m), now[:-n].reshape(n, m, m)


@MODELS
@given(st.integers(0, 1000), st.integers(2, 4), st.integers(1, 3), st.booleans(), st.floats(0.01, 20.0))
def test_continuous_time_is_the_papers(seed, m, n, tracking, time):
    experiment = network(seed, m, n, problem=PROBLEMS[tracking])
    random = np.random.default_rng(seed)
    place, law = random.standard_normal(m), random.dirichlet(np.ones(n))
    pi, nu, c = kronecker(experiment, place, law, time)
    system = systems.continuous(experiment)
    times = np.array([0.0, time / 3, time])
    found = transient.transient(system, point_start(system, place, law), times, steady_of(system))
    projector = np.eye(m) if tracking else np.eye(m) - 1 / m
    np.testing.assert_allclose(found.laws[-1], pi, rtol=1e-10)
    np.testing.assert_allclose(found.mode_means[-1], nu @ projector, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(found.mode_second_moments[-1], projector @ c @ projector, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.mean[-1], projector @ nu.sum(axis=0), rtol=1e-8, atol=1e-11)
    assert found.system_error[-1] == pytest.approx(np.trace(projector @ c.sum(axis=0) @ projector), rel=1e-9)
    if not tracking:
        whole = unreduced_consensus(experiment)
        grown = transient.transient(whole, point_start(whole, place, law), times)
        np.testing.assert_allclose(grown.laws[-1], pi, rtol=1e-10)
        np.testing.assert_allclose(grown.means[-1], nu, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(grown.moments[-1], c, rtol=1e-9, atol=1e-10)


@MODELS
@given(st.integers(0, 1000), st.integers(2, 4), st.integers(1, 3), st.sampled_from(["discrete", "loss", "tracking"]))
def test_steps_are_the_plain_recursion(seed, m, n, kind):
    """In full coordinates, one term after the other; small systems by powers and large ones by steps."""
    time, problem = "discrete" if kind == "discrete" else "continuous", PROBLEMS[kind == "tracking"]
    experiment = network(seed, m, n, time=time, problem=problem)
    experiment = experiment.with_noise(loss=0.2) if kind == "loss" else experiment
    prediction = predict(experiment)
    step = prediction.step
    random = np.random.default_rng(seed)
    place, law = random.standard_normal(m), random.dirichlet(np.ones(n))
    pi = law.copy()
    nu = np.multiply.outer(law, place)
    c = np.multiply.outer(law, np.outer(place, place))
    for _ in range(17):
        after_nu, after_c = np.zeros_like(nu), np.zeros_like(c)
        for i in range(n):
            for j in range(n):
                moved = step.weights[j] @ c[j] @ step.weights[j].T + pi[j] * step.noise[j]
                for a in range(m):
                    for b in range(m):
                        u = np.eye(m)[a] - np.eye(m)[b]
                        moved[a, a] += step.loss_variance[j, a, b] * (u @ c[j] @ u)
                after_c[i] += step.transition[j, i] * moved
                after_nu[i] += step.transition[j, i] * step.weights[j] @ nu[j]
        pi, nu, c = pi @ step.transition, after_nu, after_c
    projector = np.eye(m) if kind == "tracking" else np.eye(m) - 1 / m
    times = np.array([0.0, 2.0, 3.0, 17.0])
    start = point_start(prediction.system, place, law)
    for most in (transient.MAX_UNKNOWNS, 1):
        found = transient.transient(prediction.system, start, times, prediction.steady, most_unknowns=most)
        whole = systems.emulated(step, "tracking")
        grown = transient.transient(whole, point_start(whole, place, law), times, most_unknowns=most)
        np.testing.assert_allclose(found.laws[-1], pi, rtol=1e-11)
        np.testing.assert_allclose(found.mode_means[-1], nu @ projector, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.mode_second_moments[-1], projector @ c @ projector, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(grown.moments[-1], c, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(grown.means[-1], nu, rtol=1e-10, atol=1e-12)


def test_stationary_start_stays_and_long_times_are_the_steady_state():
    experiment = Experiment.parse(LINE_RING)
    system = systems.continuous(experiment)
    steady = steady_of(system)
    start = start_of(experiment, system, system.lifted(steady))
    found = transient.transient(system, start, np.array([0.0, 1.0, 1e9]), steady)
    np.testing.assert_allclose(found.moments, np.stack([steady] * 3), rtol=1e-12, atol=1e-15)
    zero = transient.transient(system, point_start(system, np.zeros(5)), np.array([1e3, 1e9]), steady)
    np.testing.assert_allclose(zero.moments[1], steady, rtol=1e-15)
    np.testing.assert_allclose(zero.moments[0], steady, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("rate", [1e-8, 1e6])
@pytest.mark.parametrize("gain", [1e-3, 1e6])
def test_stiff_systems(rate, gain):
    """Against the Taylor series of the full matrices, scaled and squared with 80 digits."""
    experiment = line_ring(
        problem="tracking",
        graphs={"line": {"path": [1, 2, 3]}, "other": {"edges": [[1, 2, 0.3], [2, 3, 2.0]]}},
        leaders={"agents": [2], "gain": gain},
        switching={"generator": [[-rate, rate], [2 * rate, -2 * rate]]},
        noise={"process": [1.0, 0.5, 2.0]},
        run={"dt": 1e-7, "duration": 1e-5},
    )
    system = systems.continuous(experiment)
    place, law = np.array([0.0, 1.0, -1.0]), np.array([1.0, 0.0])
    drift, flow = unreduced(experiment)
    start, steady = point_start(system, place, law), steady_of(system)
    for time in (1e-6, 1e-2, 1.0, 100.0):
        with localcontext(prec=DIGITS):
            joint = exactly(flow) + exactly(drift)  # in double, drift would be rounded
            expected = (expm(joint * Decimal(time)) @ exactly(beginning(place, law))).astype(float)
        found = transient.transient(system, start, np.array([time]), steady)
        moments = expected[:-2].reshape(2, 3, 3)
        np.testing.assert_allclose(found.moments[0], moments, rtol=1e-9, atol=1e-11 * np.abs(moments).max())
        np.testing.assert_allclose(found.laws[0], expected[-2:], rtol=1e-11, atol=1e-15)
        assert found.system_error[0] == pytest.approx(sum(np.trace(c) for c in moments), rel=1e-10)


@pytest.mark.parametrize("rate", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("kind", ["consensus", "tracking", "directed", "unreduced"])
def test_large_systems_are_reduced_without_loss(rate, kind):
    """The rational Krylov space against powers of the whole, over times from the fastest to beyond the slowest."""
    experiment = network(9, 9, 3, problem=PROBLEMS[kind == "tracking"], directed=kind == "directed")
    system = unreduced_consensus(experiment) if kind == "unreduced" else systems.continuous(experiment)
    system = dataclasses.replace(system, chain=rate * system.chain)
    steady = None if kind == "unreduced" else steady_of(system)
    start = point_start(system, np.linspace(-1.0, 2.0, 9), np.array([0.5, 0.5, 0.0]))
    times = np.array([0.0, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3])
    whole = transient.transient(system, start, times, steady)
    reduced = transient.transient(system, start, times, steady, most_unknowns=1)
    np.testing.assert_allclose(reduced.system_error, whole.system_error, rtol=1e-8)
    np.testing.assert_allclose(reduced.laws, whole.laws, atol=1e-9)
    for one, other in zip(reduced.moments, whole.moments, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8 * np.abs(other).max())


def test_sixty_agents_in_continuous_time():
    """A path that gains an edge at times, against one graph's closed form when the chain is left out."""
    m = 60
    experiment = line_ring(m, 0.5)
    system = systems.held(systems.continuous(experiment), 0)
    values = np.linalg.eigvalsh(experiment.graph_list[0].laplacian)[1:]
    times = np.array([0.0, 0.01, 1.0, 30.0, 1e4])
    found = transient.transient(system, point_start(system, np.zeros(m)), times, steady_of(system))
    expected = [np.sum(-np.expm1(-2 * values * t) / (2 * values)) for t in times]
    np.testing.assert_allclose(found.system_error, expected, rtol=1e-9)
    rates = asymptotic_rates(system)
    assert rates.second_moment == pytest.approx(2 * values[0], rel=1e-6)
    assert rates.graph is None
    both = systems.continuous(experiment)
    settled = settling_time(both, steady_of(both), point_start(both, np.zeros(m)))
    at = transient.transient(both, point_start(both, np.zeros(m)), np.array([settled]), steady_of(both))
    assert at.system_error[0] / np.trace(steady_of(both).sum(axis=0)) == pytest.approx(0.95, rel=1e-8)


def test_delay_and_loss():
    """The mean after one step is that of W from the start (nobody has older values); the end is the prediction."""
    document = LINE_RING | {"noise": {"process": 1.0, "loss": 0.1, "delay": 2}}
    experiment = Experiment.parse(document)
    prediction = predict(experiment)
    place = np.array([1.0, -2.0, 0.0, 4.0, 0.5])
    start = point_start(prediction.system, place, np.array([1.0, 0.0]))
    found = transient.transient(prediction.system, start, np.array([0.0, 1.0, 2000.0]), prediction.steady)
    np.testing.assert_allclose(found.mean[0], place - place.mean(), atol=1e-13)
    moved = place - 0.05 * 0.9 * experiment.graph_list[0].laplacian @ place
    np.testing.assert_allclose(found.mean[1], moved - moved.mean(), atol=1e-13)
    assert found.system_error[0] == pytest.approx(np.sum((place - place.mean()) ** 2))
    np.testing.assert_allclose(found.node_errors[2], prediction.emulated.node_errors, rtol=1e-10)


def test_what_is_refused():
    prediction = predict(Experiment.parse(LINE_RING))
    system, start = prediction.system, point_start(prediction.system, np.zeros(5))
    for times in ([], [-1.0], [1.0, 0.5], [np.nan]):
        with pytest.raises(InputError, match="ascending"):
            transient.transient(system, start, np.array(times))
    with pytest.raises(InputError, match=r"2 graphs of 5 agents need 0.0 GB in continuous time"):
        RationalFlow(system, transient.joint_stack(start[0]), 1.0, decays=False, most_bytes=1.0)
    with pytest.raises(InputError, match="whole numbers of steps"):
        transient.transient(system, start, np.array([0.5]), prediction.steady)
    with pytest.raises(InputError, match="settling fraction"):
        settling_time(system, prediction.steady, start, 1.5)
    with pytest.raises(InputError, match="steady error is 0"):
        settling_time(system, 0.0 * prediction.steady, start)
    with pytest.raises(InputError, match="fewer times"):
        transient.transient(system, start, np.arange(10_000_000.0), prediction.steady)


@pytest.mark.parametrize("law", ["continuous", "steps"])
@pytest.mark.parametrize("place", [np.zeros(5), np.array([3.0, 0.0, 0.0, 0.0, -3.0]), np.array([0.5, 0, 0, 0, -0.5])])
def test_settling_time_is_the_last_crossing(law, place):
    experiment = Experiment.parse(LINE_RING)
    system = systems.continuous(experiment) if law == "continuous" else predict(experiment).system
    steady = steady_of(system)
    start = point_start(system, place, np.array([1.0, 0.0]))
    found = settling_time(system, steady, start)
    error = np.trace(system.lifted(steady.sum(axis=0)))
    times = np.linspace(0.0, 30.0, 3001) if law == "continuous" else np.arange(601.0)
    deviation = np.abs(transient.transient(system, start, times, steady).system_error / error - 1)
    outside = times[deviation > 0.05]
    last = outside[-1] if len(outside) else -times[1]
    assert last <= found <= last + times[1]
    at = transient.transient(system, start, np.array([found]), steady).system_error[0]
    assert abs(at / error - 1) <= 0.05 * (1 + 1e-6)
    assert found in (0.0, last + 1) or abs(at / error - 1) == pytest.approx(0.05, rel=1e-6)
    # Without the matrix of the whole, as large systems do it.
    assert settling_time(system, steady, start, most_unknowns=1) == pytest.approx(found, rel=1e-9)


def test_settling_of_one_pair_in_closed_form():
    """Two agents, one edge: the disagreement has variance (1 - exp(-4 t)) / 4, settled at log(20) / 4."""
    document = LINE_RING | {"graphs": {"pair": {"path": [1, 2]}}, "switching": {}}
    system = systems.continuous(Experiment.parse(document))
    steady = steady_of(system)
    assert settling_time(system, steady, point_start(system, np.zeros(2))) == pytest.approx(np.log(20) / 4, rel=1e-9)
    rates = asymptotic_rates(system)
    assert (rates.mean, rates.second_moment) == (pytest.approx(2.0), pytest.approx(4.0))
    assert rates.graph is None


def test_settled_from_the_start_and_slow_graphs():
    experiment = Experiment.parse(LINE_RING)
    system = systems.continuous(experiment)
    steady = steady_of(system)
    assert settling_time(system, steady, start_of(experiment, system, system.lifted(steady))) == 0.0
    slow = dataclasses.replace(system, chain=1e-8 * system.chain)
    steady = steady_of(slow)
    # From the line for certain, the error is 2 and comes down to 1.5 as the law of the graph mixes.
    start = point_start(slow, np.zeros(5), np.array([1.0, 0.0]))
    expected = np.log((2.0 - 1.5) / (0.05 * 1.5)) / 1e-8
    assert settling_time(slow, steady, start) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("tracking", [False, True])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_asymptotic_rates_are_those_of_the_full_matrices(tracking, time):
    experiment = network(3, 4, 3, time=time, problem=PROBLEMS[tracking], directed=False)
    system = systems.continuous(experiment) if time == "continuous" else predict(experiment).system
    d, eye = system.dimension, np.eye(system.dimension)
    blocks = scipy.linalg.block_diag
    if time == "continuous":
        first = blocks(*system.matrices) - np.kron(system.chain.T, eye)
        second = blocks(*(np.kron(z, eye) + np.kron(eye, z) for z in system.matrices))
        second -= np.kron(system.chain.T, np.eye(d * d))
        expected = [np.linalg.eigvals(matrix).real.min() for matrix in (first, second)]
        graph = sorted(np.linalg.eigvals(-system.chain).real)[1]
    else:
        first = np.kron(system.chain.T, eye) @ blocks(*system.matrices)
        second = np.kron(system.chain.T, np.eye(d * d)) @ blocks(*(np.kron(w, w) for w in system.matrices))
        expected = [-np.log(np.abs(np.linalg.eigvals(matrix)).max()) for matrix in (first, second)]
        graph = -np.log(sorted(np.abs(np.linalg.eigvals(system.chain)))[-2])
    rates = asymptotic_rates(system)
    assert rates.mean == pytest.approx(expected[0], rel=1e-9)
    assert rates.second_moment == pytest.approx(expected[1], rel=1e-9)
    assert rates.graph == pytest.approx(graph, rel=1e-9)
    assert asymptotic_rates(system, most_unknowns=1).second_moment == pytest.approx(expected[1], rel=1e-6)
