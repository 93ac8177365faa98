"""Settling times and asymptotic rates against last crossings, closed forms and the full matrices."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from switching_systems import LINE_RING, network, steady_of

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.theory import jump_system as systems
from msg_analysis.theory import settling, transient
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.settling import asymptotic_rates, settling_time
from msg_analysis.theory.transient import point_start, start_of


@pytest.mark.parametrize("law", ["continuous", "steps"])
@pytest.mark.parametrize("place", [np.zeros(5), np.array([3.0, 0.0, 0.0, 0.0, -3.0]), np.array([0.5, 0, 0, 0, -0.5])])
def test_settling_time_is_the_last_crossing(law, place, monkeypatch):
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
    if law == "continuous":
        assert last <= found <= last + 0.01
        at = transient.transient(system, start, np.array([found]), steady).system_error[0]
        assert abs(at / error - 1) == pytest.approx(0.05, rel=1e-6) or found == 0.0
    else:
        assert found == last + 1
    # Without the matrix of the whole, as large systems do it.
    monkeypatch.setattr(settling, "MAX_UNKNOWNS", 1)
    monkeypatch.setattr(transient, "MAX_UNKNOWNS", 1)
    assert settling_time(system, steady, start) == pytest.approx(found, rel=1e-9)


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
    assert settling_time(system, steady, start_of(experiment, system, steady)) == 0.0
    slow = dataclasses.replace(system, chain=1e-8 * system.chain)
    steady = steady_of(slow)
    # From the line for certain, the error is 2 and comes down to 1.5 as the law of the graph mixes.
    start = point_start(slow, np.zeros(5), np.array([1.0, 0.0]))
    expected = np.log((2.0 - 1.5) / (0.05 * 1.5)) / 1e-8
    assert settling_time(slow, steady, start) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("tracking", [False, True])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_asymptotic_rates_are_those_of_the_full_matrices(tracking, time, monkeypatch):
    experiment = network(3, 4, 3, time=time, problem="tracking" if tracking else "consensus", directed=False)
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
    monkeypatch.setattr(settling, "MAX_UNKNOWNS", 1)
    assert asymptotic_rates(system).second_moment == pytest.approx(expected[1], rel=1e-6)
