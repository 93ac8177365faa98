"""Runs whose noise depends on the graph: the verdict is calibrated, and finds noise in the wrong graph."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats
from tests.support.p_values import kolmogorov_smirnov

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.verdict import compare
from msg_analysis.twin.simulate import simulate

SEEDS = range(40)
SHARED = [[1.0, 0.5, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.0]]
"""Agents 1 and 2 share a source; agent 3 has no noise in this graph."""


def experiment(line, ring, **run):
    return Experiment.parse(
        {
            "name": "loud",
            "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
            "switching": {"generator": [[-1.0, 1.0], [2.0, -2.0]]},
            "noise": {"process": {"line": line, "ring": ring}},
            "run": {"dt": 0.1, "duration": 60, "replicas": 2} | run,
        }
    )


@pytest.mark.parametrize(("line", "ring"), [(0.3, [1.0, 2.0, 0.5]), (SHARED, 1.0), (0.0, 1.0)])
@pytest.mark.usefixtures("predicted_once")
def test_calibration(line, ring):
    """p-values of 40 true runs are uniform, intervals cover, verdicts agree.

    Kolmogorov-Smirnov at 2e-4 for each of at most 17 tests, coverage and verdicts at 1e-4 by the binomial law: a right
    program fails a case with probability below 0.5 %.
    """
    results = [compare(simulate(experiment(line, ring, seed=seed))) for seed in SEEDS]
    for name in [test.name for test in results[0].tests]:
        p = [test.p for result in results for test in result.tests if test.name == name]
        assert kolmogorov_smirnov(name, p) > 2e-4, name
    covered = sum(r.system_error.interval[0] <= r.system_error.predicted <= r.system_error.interval[1] for r in results)
    assert covered >= stats.binom.ppf(1e-4, len(results), 0.95)
    assert sum(r.verdict == "disagrees" for r in results) <= stats.binom.isf(1e-4, len(results), 0.01)


def test_noise_in_the_wrong_graph_is_found():
    """A run in which the two graphs had each other's noise, compared with what its record says."""
    swapped = simulate(experiment(1.0, 0.3, duration=200))
    told = simulate(experiment(0.3, 1.0, duration=200)).record
    comparison = compare(dataclasses.replace(swapped, record=dataclasses.replace(told, start=swapped.states[0])))
    assert comparison.verdict == "disagrees"
    assert comparison.innovations.p_covariance < 1e-6


def test_noise_where_there_should_be_none_is_found():
    """Agent 3 has no noise while the graph is the line; here it has a little."""
    noisy = np.array(SHARED)
    noisy[2, 2] = 1e-3
    run = simulate(experiment(noisy.tolist(), 1.0))
    told = experiment(SHARED, 1.0)
    comparison = compare(dataclasses.replace(run, record=dataclasses.replace(run.record, experiment=told)))
    assert comparison.innovations.p_covariance == 0.0
    assert comparison.verdict == "disagrees"
