"""Autocovariance and density: one graph in closed form, brute force, and integrals."""

import itertools

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from experiments import TRACKING, line_ring, predict
from msg_analysis import Experiment, InputError
from msg_analysis.theory.spectrum import spectrum


def test_one_graph_is_a_vector_autoregression() -> None:
    """R(l) = W^l C, and the density (1 - W z)^-1 N (1 - W z)^-* at z = exp(-i w)."""
    ring = {"ring": {"cycle": [1, 2, 3, 4]}}
    prediction = predict(line_ring(graphs=ring, switching={}, run={"dt": 0.1}, **TRACKING))
    weights, noise = prediction.step.weights[0], prediction.step.noise[0]
    steady = scipy.linalg.solve_discrete_lyapunov(weights, noise)
    frequencies = np.array([0.0, 0.3, 1.0, 4.9, 5.0])
    found = spectrum(prediction, np.array([0, 1, 7, 40]), frequencies)
    for lag, covariance in zip(found.lags.tolist(), found.covariances, strict=True):
        expected = np.linalg.matrix_power(weights, lag) @ steady
        assert covariance == pytest.approx(expected, rel=1e-9, abs=1e-12)
    for frequency, densities in zip(frequencies.tolist(), found.node_densities, strict=True):
        transfer = np.linalg.inv(np.eye(4) - weights * np.exp(-2j * np.pi * 0.1 * frequency))
        expected = 2.0 * 0.1 * np.diag(transfer @ noise @ transfer.conj().T).real
        assert densities == pytest.approx(expected, rel=1e-9)
    assert found.times == pytest.approx([0.0, 0.1, 0.7, 4.0])


NAMES = "line_ring", "tracking", "discrete", "lossy_links", "line_ring_realtime"
LAWS = {name: Experiment.load(name) for name in NAMES} | {
    "delay": line_ring(5, 0.5, noise={"delay": 3}),
    "hold": line_ring(5, 0.5, noise={"loss": 0.4, "on_loss": "hold", "broadcast": 0.2}),
}


@pytest.mark.parametrize("law", LAWS)
def test_lag_0_and_the_integral_are_the_predicted_covariance(law: str) -> None:
    prediction = predict(LAWS[law])
    frequencies = np.linspace(0.0, 0.5 / prediction.step.dt, 4001)
    found = spectrum(prediction, np.array([0]), frequencies)
    assert found.covariances[0] == pytest.approx(prediction.emulated.covariance, rel=1e-12, abs=1e-14)
    assert found.system_autocovariance[0] == pytest.approx(prediction.emulated.system_error, rel=1e-12)
    integral = scipy.integrate.trapezoid(found.node_densities, frequencies, axis=0)
    assert integral == pytest.approx(prediction.emulated.node_errors, rel=1e-9)
    assert found.system_density == pytest.approx(found.node_densities.sum(axis=1))


@pytest.mark.parametrize("law", LAWS)
def test_the_sum_over_all_paths(law: str) -> None:
    """E[e(k + l) e(k)^T]: every path of so many graphs, with its probability."""
    prediction = predict(LAWS[law])
    system, lag = prediction.system, 4
    expected = np.zeros((system.dimension,) * 2)
    for path in itertools.product(range(system.modes), repeat=lag):
        moments = prediction.steady[path[0]]
        for mode, following in itertools.zip_longest(path, path[1:]):
            moments = system.matrices[mode] @ moments
            if following is not None:
                moments = system.chain[mode, following] * moments
        expected += moments
    assert spectrum(prediction, np.array([lag])).covariances[0] == pytest.approx(system.lifted(expected), rel=1e-10)


@pytest.mark.parametrize("law", LAWS)
def test_the_density_is_the_sum_over_lags(law: str) -> None:
    prediction = predict(LAWS[law])
    lags = np.arange(4000)
    frequency = 0.37
    found = spectrum(prediction, lags, np.array([frequency]))
    terms = found.system_autocovariance * np.cos(2.0 * np.pi * frequency * found.times)
    assert found.system_density[0] == pytest.approx(2.0 * prediction.step.dt * (2.0 * terms.sum() - terms[0]), rel=1e-9)


def test_default_lags_end_where_little_is_left() -> None:
    found = spectrum(predict(LAWS["line_ring"]))
    assert found.lags[0] == 0
    assert len(found.lags) <= 200
    assert abs(found.system_autocovariance[-1]) == pytest.approx(0.01 * found.system_autocovariance[0], rel=0.05)
    assert found.frequencies[-1] == 10.0


def test_in_python_and_without_noise() -> None:
    found = LAWS["line_ring"].spectrum([0, 1], [0.0, 1.0])
    assert found.to_json()["lags"] == [0.0, 0.05]
    assert "Spectrum of 'line_ring'" in repr(found)
    assert [len(axes.get_lines()) for axes in found.plot().axes] == [7, 6]
    found = spectrum(predict(line_ring(noise={"process": 0.0})))
    assert not found.system_autocovariance.any()
    assert not found.system_density.any()


def test_refused() -> None:
    prediction = predict(LAWS["line_ring"])
    for lags in ([], [-1, 2], [3, 3]):
        with pytest.raises(InputError, match="lags: expected ascending whole numbers"):
            spectrum(prediction, np.array(lags, dtype=np.int64))
    for frequencies in ([-1.0], [11.0], [1.0, 0.5], [np.nan]):
        with pytest.raises(InputError, match=r"frequencies: expected ascending numbers from 0 to 1 / \(2 dt\) = 10"):
            spectrum(prediction, None, np.array(frequencies))
    with pytest.raises(InputError, match="make 8 unknowns; at most 7 are computed"):
        spectrum(prediction, most_unknowns=7)
