"""Several runs, one verdict: against sums and quotients of what the single runs say."""

import json

import numpy as np
import pytest
from p_values import assert_few_alarms, kolmogorov_smirnov
from scipy import stats

from experiments import claimed, compare, cut, observed, pieces, simulate
from msg_analysis.errors import InputError
from msg_analysis.inference.counts import Transitions
from msg_analysis.inference.pool import compare_pooled
from msg_analysis.inference.residuals import residuals
from msg_analysis.inference.statistics import quadratic_form
from msg_analysis.inference.verdict import Evidence


def law(process=(1.0, 0.5, 2.0), **air):
    return pieces(noise={"process": list(process), **air}, run={"duration": 30})


AIR = law([1.0] * 3, broadcast=0.3, link=0.2, loss=0.2)


def several(what, durations, first_seed=1):
    """Runs of one experiment, by name."""
    laws = [what.with_run(seed=seed, duration=duration) for seed, duration in enumerate(durations, first_seed)]
    return [(f"bag_{one.run.seed}", simulate(one)) for one in laws]


@pytest.fixture(scope="module")
def three():
    return several(law(), (30.0, 60.0, 20.0))


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
    observations = [observed(run) for _, run in three]
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


@pytest.mark.parametrize("what", [law(), AIR], ids=["quiet", "air"])
@pytest.mark.usefixtures("predicted_once")
def test_calibration(what):
    """p-values of 20 pools of two runs: Kolmogorov-Smirnov at 2e-4 for each of at most 21 tests."""
    results = [compare_pooled(several(what, (30.0, 40.0), first_seed=10 * i)) for i in range(20)]
    for place, test in enumerate(results[0].tests):
        assert kolmogorov_smirnov(test.name, [result.tests[place].p for result in results]) > 2e-4, test.name
    assert_few_alarms(results)


def test_a_fault_that_one_run_does_not_show():
    """10 % more noise variance: seen in twelve runs together."""
    loud = several(law(np.sqrt(1.05) * np.array([1.0, 0.5, 2.0])), (60.0,) * 12)
    found = [(name, claimed(run, law().with_run(seed=run.experiment.run.seed, duration=60.0))) for name, run in loud]
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
    assert (pooled.verdict, pooled.exit_code, pooled.steps, pooled.causes) == ("incomplete", 3, 549, [])
    assert [(m.name, m.steps, m.completeness.complete) for m in pooled.pool.members] == [
        ("bag_1", 300, True),
        ("torn", 249, False),
        ("stump", 0, False),
    ]
    stumps = compare_pooled([(f"stump {i}", cut(run, 20)) for i, (_, run) in enumerate(three)])
    assert (stumps.verdict, stumps.system_error.measured) == ("incomplete", None)
    json.dumps(stumps.to_json(), allow_nan=False)


def test_what_is_not_one_experiment_is_refused(three):
    first, run = three[0]
    others = [
        (run, "other: the same run as in bag_1"),
        (simulate(run.experiment), r"other: run\.seed: 1 as in bag_1"),
        (simulate(law([1.0, 0.6, 2.0]).with_run(seed=9)), r"other: noise\.process: \[1\.0, 0\.6, 2\.0\], but \[1"),
        (simulate(run.experiment.with_run(seed=2, replicas=1)), r"run\.replicas: 1, but 2"),
    ]
    for other, words in others:
        with pytest.raises(InputError, match=words):
            compare_pooled([(first, run), ("other", other)])
    with pytest.raises(InputError, match="no bag"):
        compare_pooled([])
