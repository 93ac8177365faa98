"""Erlang holding times: their path, the exact prediction by phases, and verdicts."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from p_values import assert_covered
from scipy import stats

from experiments import compare, line_ring
from msg_analysis.experiment.experiment import Experiment, ExperimentError
from msg_analysis.experiment.limits import prediction_method
from msg_analysis.theory.sampling import sampled_prediction
from msg_analysis.twin.simulate import simulate

SHAPES = {"line": {"shape": 4}, "ring": {"shape": 2}}


def held(sojourn: Any = SHAPES, **changes: Any) -> Experiment:
    switching = {"rates": {"line": {"ring": 0.5}, "ring": {"line": 1.0}}, "sojourn": sojourn}
    run = {"dt": 0.05, "duration": 60, "replicas": 4} | changes.pop("run", {})
    return line_ring(5, **{"switching": switching} | changes, run=run)


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_holding_times_of_a_run(time: str) -> None:
    """Erlang in continuous time, sums of geometric ones in discrete time: p > 1e-4 with fixed seeds."""
    if time == "continuous":
        law = held(run={"duration": 4000})
        modes = simulate(law.with_run(replicas=1)).modes
        unit, erlang = 0.05, stats.gamma(4, scale=2.0 / 4)
    else:
        switching = {"transition": [[0.95, 0.05], [0.1, 0.9]], "sojourn": SHAPES}
        law = held(time="discrete", switching=switching, run={"dt": 1.0, "duration": 40_000})
        modes = simulate(law.with_run(replicas=1)).modes
        unit, erlang = 1.0, stats.nbinom(4, 0.2, loc=4)
    changes = np.flatnonzero(np.diff(modes)) + 1
    of_line = np.diff(changes)[modes[changes[:-1]] == 0] * unit
    assert of_line.mean() == pytest.approx(erlang.mean(), rel=0.1)
    edges = erlang.ppf([0.2, 0.4, 0.6, 0.8])
    counts = np.bincount(np.searchsorted(edges, of_line, side="left"), minlength=5)
    chances = np.diff([0.0, *erlang.cdf(edges), 1.0])
    assert stats.chisquare(counts, chances * counts.sum()).pvalue > 1e-4


@pytest.mark.parametrize("changes", [{}, {"noise": 2.0}, {"protocol": {"name": "metropolis", "laziness": 0.3}}])
def test_exact_prediction_and_a_sampled_one(changes: dict[str, Any]) -> None:
    """Against phases that are written out as graphs of a chain; |z| < 4 of the sampled one. Shape 1 is the chain."""

    def process(*graphs: str) -> dict[str, Any]:
        """With noise by graph."""
        noise = {"process": {name: changes.get("noise", 1.0) if name[0] == "l" else 1.0 for name in graphs}}
        return changes | {"noise": noise}

    everybody = [1, 2, 3, 4, 5]
    names = ["l1", "l2", "l3", "l4", "r1", "r2"]
    rates = [2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    chain = {a: {b: rate} for a, b, rate in zip(names, names[1:] + names[:1], rates, strict=True)}
    graphs = {name: {"path": everybody} if name[0] == "l" else {"cycle": everybody} for name in names}
    run = {"dt": 0.05, "start": "zero"}
    by_hand = line_ring(5, graphs=graphs, switching={"rates": chain}, run=run, **process(*names))
    law = held(**process("line", "ring"))
    np.testing.assert_allclose(law.predict().emulated.covariance, by_hand.predict().emulated.covariance, rtol=1e-10)
    found, wanted = (each.transient([0.5, 4.0]).system_error for each in (law, by_hand))
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    sampled = sampled_prediction(law, precision=0.02, seed=1)
    half = (sampled.interval[1] - sampled.interval[0]) / 2.0
    assert abs(sampled.system_error - by_hand.predict().emulated.system_error) < 2.0 * half
    assert prediction_method(law) == ("exact", None)
    one = held({"line": {"shape": 1}})
    plain = held(None, switching={"rates": {"line": {"ring": 0.5}, "ring": {"line": 1.0}}})
    assert one.predict().emulated.system_error == pytest.approx(plain.predict().emulated.system_error, rel=1e-10)


def test_correct_runs() -> None:
    found = [compare(simulate(held(run={"seed": seed, "duration": 200, "replicas": 1}))) for seed in range(12)]
    assert_covered(found)
    assert all("sojourns" in [test.name for test in one.tests] for one in found)


def test_another_shape_is_named() -> None:
    run = simulate(held({"line": {"shape": 1}}, run={"duration": 800, "replicas": 1}))
    law = held(run={"duration": 800, "replicas": 1})
    found = compare(dataclasses.replace(run, record=dataclasses.replace(run.record, experiment=law)))
    assert (found.verdict, found.causes[0].kind) == ("disagrees", "sojourn")
    assert "was left" in found.causes[0].words


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sojourn": {"star": {"shape": 2}}}, "switching.sojourn.star: unknown graph"),
        ({"sojourn": {"line": {"shape": 0}}}, "switching.sojourn.line.shape: 0"),
        ({"run": {"start": "stationary"}}, "needs a Markov chain"),
        (
            {"switching": {"transition": [[0.5, 0.5], [0.1, 0.9]], "sojourn": SHAPES}, "time": "discrete"}
            | {"run": {"dt": 1.0}},
            "switching.sojourn.line.shape: 4: expected at most 2",
        ),
    ],
)
def test_mistakes(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ExperimentError) as error:
        held(**changes)
    assert message in str(error.value)
