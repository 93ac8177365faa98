"""What differs between two experiments, beside what other commands say of each."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from msg_analysis import Experiment
from msg_analysis.report.differences import experiment_difference
from msg_analysis.report.documents import describe_transient


def experiment(rate: float = 1.0, **changes: Any) -> Experiment:
    document = {
        "name": "four",
        "graphs": {"line": {"path": [1, 2, 3, 4]}, "star": {"star": {"center": 2}}},
        "switching": {"generator": [[-rate, rate], [rate, -rate]]},
        "run": {"dt": 0.1, "duration": 20},
    }
    return Experiment.parse(document | changes)


def test_predictions_rates_and_leaders() -> None:
    a, b = experiment(), experiment(5.0)
    found = experiment_difference(a, b)
    assert [entry["key"] for entry in found["keys"]] == ["switching.generator"]
    for law in ("continuous", "emulated", "static"):
        errors = [getattr(each.predict(), law).system_error for each in (a, b)]
        pair = found["predictions"][law]["system_error"]
        assert (pair["a"], pair["b"]) == tuple(errors)
        assert pair["relative"] == pytest.approx(errors[1] / errors[0] - 1)
    assert len(found["predictions"]["emulated"]["node_errors"]) == 4
    rates = [describe_transient(each, np.array([0.0]))["rates"] for each in (a, b)]
    for key, pair in found["rates"].items():
        assert (pair["a"], pair["b"]) == (rates[0][key], rates[1][key])
    assert found["rates"]["graph"]["relative"] == pytest.approx(4.0)
    for side, each in (("a", a), ("b", b)):
        error, agents = each.leaders(1).sets[0]
        best = found["leaders"][side]["best"]
        assert (best["agents"], best["system_error"], best["gain"]) == (list(agents), error, "inf")
        assert found["leaders"][side]["agents"] is None
    json.dumps(found, allow_nan=False)


def test_one_with_leaders_and_one_without() -> None:
    """The best set of the other is as large, and has the same gain."""
    led = experiment(problem="tracking", leaders={"agents": [1, 4], "gain": 2.0})
    found = experiment_difference(experiment(), led)["leaders"]
    assert found["b"]["agents"] == [1, 4]
    assert found["b"]["system_error"] == led.leaders().present[0]  # type: ignore[index]
    assert [len(found[side]["best"]["agents"]) for side in "ab"] == [2, 2]
    assert [found[side]["best"]["gain"] for side in "ab"] == [2.0, 2.0]


def test_other_sizes_and_laws() -> None:
    """What only one has stands alone."""
    small = experiment(
        time="discrete", graphs={"line": {"path": [1, 2, 3]}}, switching={"transition": [[1.0]]}, run={"duration": 20}
    )
    found = experiment_difference(experiment(), small)
    assert set(found["predictions"]) == {"continuous", "emulated", "discrete", "static"}
    assert found["predictions"]["discrete"]["system_error"]["a"] is None
    assert found["predictions"]["static"]["node_errors"] == []
    assert found["rates"]["graph"]["b"] is None


def test_one_without_a_prediction() -> None:
    """It has a reason, and the other its numbers."""
    saturated = experiment(
        protocol={"name": "saturated"}, run={"dt": 0.1, "duration": 20, "start": "zero"}
    )  # not linear
    found = experiment_difference(saturated, experiment())
    assert found["a"]["unpredicted"]
    assert found["leaders"]["a"]["note"] == "no prediction"
    assert found["predictions"]["emulated"]["system_error"]["a"] is None
    assert found["predictions"]["emulated"]["system_error"]["b"] > 0


def test_many_sets_of_leaders_are_not_searched() -> None:
    ring = {"graphs": {"ring": {"cycle": list(range(1, 31))}}, "switching": {}}
    led = experiment(problem="tracking", leaders={"agents": [1, 2, 3], "gain": 2.0}, **ring)
    found = experiment_difference(led, led)
    assert found["keys"] == []
    assert "msg-analysis leaders" in found["leaders"]["a"]["note"]
