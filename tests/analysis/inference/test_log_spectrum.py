"""Autocovariances of logs against those of a run, and against scipy's equations of Lyapunov."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from experiments import line_ring, simulate
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.autocovariance import logged_autocovariance
from msg_analysis.inference.log_spectrum import log_spectrum
from msg_analysis.inference.observation import Observation
from msg_analysis.model.log import Log
from msg_analysis.theory.prediction import predict
from msg_analysis.theory.spectrum import sampled_spectrum

SCRIPT = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks/foreign_logs.py"))
Kind, draw = SCRIPT["Kind"], SCRIPT["simulate"]


def logged(samples: int, seed: int, graph: Any = None, **faults: Any) -> Log:
    kind = Kind(**faults)
    times, states, starts, names = draw(kind, samples, np.random.default_rng(seed))
    return Log.from_arrays(times, states, law=kind.law(), graph=graph or (starts, names), measurement_noise=kind.r)


def test_of_exact_steps_the_numbers_are_those_of_the_run() -> None:
    run = simulate(line_ring(5, 0.5, run={"dt": 0.05, "duration": 100, "seed": 3}))
    law = run.experiment
    wanted = logged_autocovariance(Observation.of(run, predict(law, run.record.step_model)))
    names = [law.graph_list[mode].name for mode in run.modes]
    log = Log.from_arrays(run.times, run.values, law=law, graph=(run.times[:-1], names), sampled_law="steps")
    predicted, found, _, _ = log_spectrum(log)
    assert wanted is not None
    assert found is not None
    assert found.p == pytest.approx(wanted.p, abs=1e-9)
    for name in ("times", "predicted", "measured", "expected", "covariance"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-9, atol=1e-12, err_msg=name)
    others = law.spectrum(lags=predicted.lags, frequencies=predicted.frequencies)
    np.testing.assert_allclose(predicted.node_autocovariances, others.node_autocovariances, atol=1e-10)
    np.testing.assert_allclose(predicted.node_densities, others.node_densities, rtol=1e-8)


def test_samples_of_the_continuous_law() -> None:
    """Of one graph in closed form: exp(-Z l T) C, Z C + C Z^T = Q; the density by the sum over lags."""
    law = Experiment.parse(
        {
            "name": "one",
            "problem": "tracking",
            "leaders": {"agents": [1], "gain": 1.0},
            "graphs": {"path": {"path": [1, 2, 3]}},
            "noise": {"process": [1.0, 0.5, 2.0]},
        }
    )
    z = np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    c = scipy.linalg.solve_continuous_lyapunov(z, np.diag([1.0, 0.25, 4.0]))
    found = sampled_spectrum(law.predict(), "continuous", 0.4)
    wanted = np.array([scipy.linalg.expm(-z * 0.4 * lag) @ c for lag in found.lags])
    np.testing.assert_allclose(found.covariances, wanted, atol=1e-9)
    far = np.array([np.diag(scipy.linalg.expm(-z * 0.4 * lag) @ c) for lag in range(1, 400)])
    angle = 2 * np.pi * 0.4 * found.frequencies[100]
    density = 2 * 0.4 * (np.diag(c) + 2 * np.cos(angle * np.arange(1, 400)) @ far)
    np.testing.assert_allclose(found.node_densities[100], density, rtol=1e-6)


@pytest.mark.parametrize("r", [0.0, 0.1])
def test_right_logs_agree(r: float) -> None:
    """Of 4 right logs at the level 1 % none is rejected."""
    for seed in range(100, 104):
        found = log_spectrum(logged(1500, seed, r=r))[1]
        assert found is not None
        assert found.p is not None
        assert found.p > 0.01


def test_wrong_gains_and_gaps() -> None:
    wrong = log_spectrum(logged(4000, 9, gain=0.6))[1]
    assert wrong is not None
    assert wrong.p is not None
    assert wrong.p < 1e-4
    log = logged(1500, 5)
    kept = np.r_[0:700, 720:1500]
    log.states[50, 2] = np.nan
    starts, names = log.starts, [("line", "ring")[g] for g in log.graphs]
    gap = Log.from_arrays(log.times[kept], log.states[kept], law=log.law, graph=(starts, names), measurement_noise=0.1)
    _, found, density, _ = log_spectrum(gap)
    assert found is not None
    assert found.steps == 1499
    assert found.p is not None
    assert found.p > 0.01
    assert density is None


def test_what_is_not_tested_is_said() -> None:
    _, found, density, note = log_spectrum(logged(1500, 1, graph="hidden"))
    assert (found, note) == (None, "the log is not tested: its graphs are hidden")
    assert density is not None
    with pytest.raises(InputError, match="expected samples at equal intervals"):
        log_spectrum(logged(200, 1, irregular=True))
