"""Several runs, one verdict: against sums and quotients of what the single runs say."""

import dataclasses
import json

import numpy as np
import pytest
from scipy import stats
from tests.support.p_values import kolmogorov_smirnov

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.counts import Transitions
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.residuals import residuals
from msg_analysis.inference.statistics import quadratic_form
from msg_analysis.inference.verdict import Evidence, compare, compare_pooled
from msg_analysis.model.run import Completeness
from msg_analysis.theory.prediction import predict
from msg_analysis.twin.simulate import simulate

DOCUMENT = {
    "name": "tiny",
    "problem": "tracking",
    "graphs": {"left": {"edges": [[1, 2]]}, "right": {"edges": [[2, 3, 2.0]]}},
    "agents": 3,
    "switching": {"generator": [[-2.0, 2.0], [1.0, -1.0]]},
    "noise": {"process": [1.0, 0.5, 2.0]},
    "leaders": {"agents": [1, 3], "gain": 1.5, "reference": 2.0},
    "run": {"dt": 0.1, "duration": 30.0, "replicas": 2},
}
AIR = DOCUMENT | {"noise": {"process": 1.0, "broadcast": 0.3, "link": 0.2, "loss": 0.2}}


def runs(document=DOCUMENT, durations=(30.0, 60.0, 20.0), first_seed=1):
    experiment = Experiment.parse(document)
    return [
        (f"bag_{seed}", simulate(experiment.with_run(seed=seed, duration=duration)))
        for seed, duration in enumerate(durations, start=first_seed)
    ]


def cut(trajectory, step):
    states = trajectory.states.copy()
    states[step:] = np.nan
    missing = states[step:, :, 0].size
    count = Completeness(states[:, :, 0].size, states[:, :, 0].size - missing, missing)
    return dataclasses.replace(trajectory, states=states, completeness=count)


@pytest.fixture(scope="module")
def three():
    return runs()


def test_every_step_counts_the_same(three):
    pooled = compare_pooled(three)
    single = [compare(run) for _, run in three]
    steps = np.array([300, 600, 200])
    assert pooled.steps == steps.sum()
    for found, parts in (
        (pooled.system_error, [one.system_error for one in single]),
        (pooled.node_errors[1], [one.node_errors[1] for one in single]),
        (pooled.given.system_error, [one.given.system_error for one in single]),
    ):
        share = steps / steps.sum()
        assert found.measured == pytest.approx(share @ [part.measured for part in parts])
        error = np.sqrt(share**2 @ [part.standard_error**2 for part in parts])
        assert found.standard_error == pytest.approx(error)
        assert found.z == pytest.approx((found.measured - found.predicted) / error)
    np.testing.assert_array_equal(pooled.switching.counts, sum(one.switching.counts for one in single))


def test_innovations_are_added_up(three):
    """Covariance and gains of all innovations put one after the other."""
    pooled = compare_pooled(three)
    observations = [Observation.of(run, predict(run.record.experiment)) for _, run in three]
    e = np.concatenate([residuals(one, 0, one.steps) for one in observations])
    whitened = np.einsum("i,kir->kri", 1 / np.sqrt(np.diag(observations[0].step.noise[0])), e).reshape(-1, 3)
    n, scatter = len(whitened), whitened.T @ whitened / len(whitened)
    statistic = n * (np.trace(scatter) - np.log(np.linalg.det(scatter)) - 3) * (1 - 26 / (24 * n))
    assert pooled.innovations.p_covariance == pytest.approx(stats.chi2.sf(statistic, 6), rel=1e-8)
    sums = [Evidence.of(one, 0.01).residuals for one in observations]
    chi2, dof = quadratic_form(sum(s.score for s in sums), sum(s.covariance for s in sums))
    assert pooled.innovations.p_gain == pytest.approx(stats.chi2.sf(chi2, dof))


def test_runs_alike_is_cochrans_q(three):
    pooled = compare_pooled(three)
    parts = [compare(run).given.system_error for _, run in three]
    deviation = np.array([part.measured - part.predicted for part in parts])
    precision = np.array([part.standard_error**-2 for part in parts])
    mean = (precision @ deviation) / precision.sum()
    assert pooled.pool.chi2 == pytest.approx(precision @ (deviation - mean) ** 2)
    assert pooled.pool.p == pytest.approx(stats.chi2.sf(pooled.pool.chi2, 2))
    assert next(test.p for test in pooled.tests if test.name == "runs alike") == pooled.pool.p


def test_document(three):
    document = json.loads(json.dumps(compare_pooled(iter(three)).to_json(), allow_nan=False))
    assert (document["run"], document["seed"]) == (None, None)
    assert [bag["bag"] for bag in document["bags"]] == ["bag_1", "bag_2", "bag_3"]
    assert [bag["steps"] for bag in document["bags"]] == [300, 600, 200]
    assert document["completeness"]["expected"] == 3 * (301 + 601 + 201)
    assert document["homogeneity"]["dof"] == 2
    assert document["verdict"] == "agrees"


@pytest.mark.parametrize("document", [DOCUMENT, AIR], ids=["quiet", "air"])
@pytest.mark.usefixtures("predicted_once")
def test_calibration(document):
    """p-values of 25 pools of two runs: Kolmogorov-Smirnov at 2e-4 for each of at most 21 tests."""
    results = [compare_pooled(runs(document, (50.0, 70.0), first_seed=10 * i)) for i in range(25)]
    for place, test in enumerate(results[0].tests):
        assert kolmogorov_smirnov(test.name, [result.tests[place].p for result in results]) > 2e-4, test.name
    assert sum(result.verdict == "disagrees" for result in results) <= stats.binom.isf(1e-4, 25, 0.01)


def test_a_fault_that_one_run_does_not_show():
    """10 % more noise variance: seen in twelve runs together."""
    louder = DOCUMENT | {"noise": {"process": [1.05**0.5, 0.5 * 1.05**0.5, 2.0 * 1.05**0.5]}}
    claimed = Experiment.parse(DOCUMENT)
    found = []
    for name, run in runs(louder, (60.0,) * 12):
        experiment = claimed.with_run(seed=run.record.experiment.run.seed, duration=60.0)
        found.append((name, dataclasses.replace(run, record=dataclasses.replace(run.record, experiment=experiment))))
    assert compare(found[0][1]).verdict == "agrees"
    pooled = compare_pooled(found)
    assert pooled.verdict == "disagrees"
    assert (pooled.causes[0].kind, pooled.causes[0].agent) == ("noise", None)
    assert pooled.causes[0].interval[0] < 1.05 < pooled.causes[0].interval[1]


def test_paths_start_anew_in_every_run():
    """No transition from the last graph of a run to the first of the next."""
    one, other = Transitions.of(np.array([0, 0, 1]), 2), Transitions.of(np.array([0, 1, 1]), 2)
    merged = one.merged(other)
    assert merged.counts.tolist() == [[1, 2], [0, 1]]
    assert merged.paths == ((0, 2), (0, 2))


def test_incomplete_runs_are_named(three):
    torn = [three[0], ("torn", cut(three[1][1], 250)), ("stump", cut(three[2][1], 20))]
    pooled = compare_pooled(torn)
    assert pooled.verdict == "incomplete"
    assert pooled.exit_code == 3
    assert [(m.name, m.steps, m.completeness.complete) for m in pooled.pool.members] == [
        ("bag_1", 300, True),
        ("torn", 249, False),
        ("stump", 0, False),
    ]
    assert pooled.steps == 549
    assert pooled.causes == []
    stumps = compare_pooled([(f"stump {i}", cut(run, 20)) for i, (_, run) in enumerate(three)])
    assert (stumps.verdict, stumps.system_error.measured) == ("incomplete", None)
    json.dumps(stumps.to_json(), allow_nan=False)


def test_what_is_not_one_experiment_is_refused(three):
    (first, run), (_, other) = three[:2]
    with pytest.raises(InputError, match="again: the same run as in bag_1"):
        compare_pooled([(first, run), ("again", run)])
    twin = simulate(run.record.experiment)
    with pytest.raises(InputError, match=r"twin: run\.seed: 1 as in bag_1"):
        compare_pooled([(first, run), ("twin", twin)])
    wrong = Experiment.parse(DOCUMENT | {"noise": {"process": [1.0, 0.6, 2.0]}}).with_run(seed=9)
    with pytest.raises(InputError, match=r"wrong: noise\.process: \[1\.0, 0\.6, 2\.0\], but \[1"):
        compare_pooled([(first, run), ("wrong", simulate(wrong))])
    fewer = simulate(other.record.experiment.with_run(replicas=1))
    with pytest.raises(InputError, match=r"run\.replicas: 1, but 2"):
        compare_pooled([(first, run), ("fewer", fewer)])
    with pytest.raises(InputError, match="no bag"):
        compare_pooled([])
