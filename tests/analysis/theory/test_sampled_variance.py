"""Sampled plans: the variance of time means and the warm-up are those of the exact plan, which shares no code."""

import itertools
import math
from typing import Any

import pytest

from experiments import TRACKING, Experiment, five, line_ring
from msg_analysis.errors import InputError, NotAvailableError
from msg_analysis.theory import sampled_variance
from msg_analysis.theory.sampled_variance import sampled_mean_variance, sampled_warm_up

LINKS = {"up": 1.0, "down": 0.5}
PAIRS = list(itertools.combinations(range(1, 6), 2))
MANY = {"graphs": {"all": {"edges": PAIRS}}, "switching": {"links": LINKS}}
CYCLE = {"transition": [[0.8, 0.2, 0.0], [0.0, 0.8, 0.2], [0.2, 0.0, 0.8]]}
THREE = {"line": {"path": [1, 2, 3]}, "star": {"star": {"center": 1}}, "ring": {"cycle": [1, 2, 3]}}
LAWS: dict[str, Experiment] = {
    "losses": five(noise={"loss": 0.3}, run={"dt": 0.2}),
    "tracking from a place": line_ring(3, **TRACKING, run={"dt": 0.2, "start": [3.0, -1.0, 2.0]}),
    "noise by graph": line_ring(3, noise={"process": {"line": 0.5, "ring": 1.0}}, run={"dt": 0.2}),
    "a chain with a direction": line_ring(3, time="discrete", graphs=THREE, switching=CYCLE),
    "agents that leave out steps": line_ring(
        3, graphs={"ring": THREE["ring"]}, switching={}, noise={"activation": 0.6}, run={"dt": 0.2}
    ),
    "links": line_ring(4, graphs={"ring": {"cycle": [1, 2, 3, 4]}}, switching={"links": LINKS}, run={"dt": 0.2}),
}


def started(law: Experiment) -> Experiment:
    return law.with_run(start="zero") if law.run.start == "stationary" else law


@pytest.mark.parametrize("name", LAWS)
def test_the_variance_of_time_means_is_that_of_the_exact_plan(name: str) -> None:
    """Standard deviations within four of the stated standard errors and 3 % of bias. The seed is fixed."""
    law = started(LAWS[name])
    exact, found = law.plan(0.01).precision.variance, sampled_mean_variance(law)
    for replicas in (1, 8):
        error = found.error(replicas)
        assert 0.0 < error < 0.1
        assert math.sqrt(found.of(replicas) / exact.of(replicas)) == pytest.approx(1.0, abs=4.0 * error + 0.03)


@pytest.mark.parametrize("name", LAWS)
def test_the_warm_up_is_that_of_the_exact_plan(name: str) -> None:
    law = started(LAWS[name])
    assert sampled_warm_up(law, 0.05) == pytest.approx(law.plan(0.05).precision.warm_up, rel=0.1, abs=1)


def test_from_the_steady_state_there_is_no_warm_up() -> None:
    assert sampled_warm_up(five(), 0.05) == 0


def test_a_plan_without_an_exact_prediction() -> None:
    """Ten links of five agents."""
    plan = line_ring(5, **MANY, run={"dt": 0.1}).plan(0.02)
    found, sampled = plan.to_json(), plan.precision
    needed = (1.959963984540054 / 0.02 / sampled.error) ** 2 * sampled.variance.of(1)
    row = found["lengths"][0]
    assert row["steps"] == sampled.warm_up + math.ceil(needed)
    assert (row["any_time_steps"], found["faults"]) == (None, [])
    assert 0.0 < found["sampling_error"] < 0.1
    assert found["notes"][0].startswith("the errors are sampled, since there is no exact prediction: standard errors")


@pytest.mark.parametrize("changes", [{"noise": {"delay": 1}}, {"noise": {"link": 0.5}}, {"run": {"pace": "realtime"}}])
def test_what_a_plan_cannot_say(changes: dict[str, Any]) -> None:
    law = line_ring(5, **MANY | changes, **({} if "run" in changes else {"run": {"dt": 0.1}}))
    with pytest.raises(NotAvailableError, match="plan: without an exact prediction, the variance of time means is"):
        law.plan()


def test_a_memory_that_is_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampled_variance, "LONG", 0.0)
    monkeypatch.setattr(sampled_variance, "CHANGE", 0.0)
    with pytest.raises(InputError, match=r"plan: errors of 6.4 units of time apart are still correlated"):
        sampled_mean_variance(five(run={"dt": 0.1}))


def test_no_noise_no_plan() -> None:
    with pytest.raises(InputError, match="the predicted system error is 0, expected noise"):
        line_ring(5, **MANY, noise={"process": 0.0}, run={"dt": 0.1}).plan()
