"""What differs between two bags, against changes made by hand; and between two experiments."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import line_ring
from msg_analysis import Experiment, Run
from msg_analysis.common.text import json_text
from msg_analysis.report.differences import bag_difference, experiment_difference, graph_difference, measured, relative
from msg_analysis.report.differences import state_difference as of_states
from msg_analysis.report.documents import describe_transient

TWIN = line_ring(4, run={"dt": 0.1, "replicas": 3, "seed": 7, "start": "zero"}).simulate()


def changed(**changes: Any) -> Run:
    copies = {"states": TWIN.states.copy(), "modes": TWIN.modes.copy()}
    return dataclasses.replace(TWIN, **(copies | changes))


BLOCKS = pytest.mark.parametrize("block", [10**6, 60, 1])
"""However few steps are looked at together, the answers are the same."""


@BLOCKS
def test_states_that_differ(block: int) -> None:
    other = changed()
    other.states[50, 2, 1] = np.nextafter(other.states[50, 2, 1], np.inf)
    other.states[50, 3, 0] += 0.25
    other.states[120, 0, 2] -= 8.0
    other.states[200, 1, 1] += 0.5
    assert of_states(TWIN, other, block_numbers=block) == {
        "compared": 200,
        "why": None,
        "equal": False,
        "first": {"step": 50, "time": pytest.approx(5.0), "agents": [3, 4], "difference": pytest.approx(0.25)},
        "largest": {"step": 120, "agent": 1, "number": 3, "difference": pytest.approx(8.0)},
        "last": {"step": 200, "difference": pytest.approx(0.5)},
        "steps": 3,
        "states": 4,
        "only_a": 0,
        "only_b": 0,
    }


@BLOCKS
def test_equal_missing_and_shorter(block: int) -> None:
    other, short = changed(), changed(states=TWIN.states[:100])
    other.states[[3, 200], [1, 0]] = np.nan
    some, last = {"equal": False, "first": None}, {"step": 199, "difference": 0.0}
    for one, two, found in (
        (TWIN, changed(), {"equal": True, "first": None, "last": {"step": 200, "difference": 0.0}}),
        (TWIN, other, some | {"only_a": 2, "only_b": 0, "last": last}),
        (other, TWIN, some | {"only_a": 0, "only_b": 2, "last": last}),
        (other, changed(states=other.states.copy()), {"equal": True}),
        (TWIN, short, some | {"compared": 99}),
    ):
        difference = of_states(one, two, block_numbers=block)
        assert difference | found == difference


def test_the_sign_of_zero_is_a_bit_and_other_networks_are_not_compared() -> None:
    other = changed()
    other.states[0] = -0.0
    found = of_states(TWIN, other)
    assert found["first"] == {"step": 0, "time": 0.0, "agents": [1, 2, 3, 4], "difference": 0.0}
    found = of_states(TWIN, changed(states=TWIN.states[:, :3]))
    why = "4 agents with 3 numbers each and 3 agents with 3 numbers each"
    assert (found["compared"], found["equal"], found["why"]) == (None, None, why)


def test_graphs() -> None:
    other, names, used = changed(), ["line", "ring"], TWIN.modes[40]
    assert graph_difference(TWIN, other) is None
    other.modes[:10] = -1  # not known
    other.modes[40:42] = 1 - TWIN.modes[40:42]
    assert graph_difference(TWIN, other) == {"step": 40, "a": names[used], "b": names[1 - used], "steps": 2}
    document = TWIN.experiment.to_document()
    swapped = document | {"graphs": dict(reversed(document["graphs"].items()))}  # the same graphs, other numbers
    record = dataclasses.replace(TWIN.record, experiment=Experiment.parse(swapped))
    assert graph_difference(TWIN, changed(record=record, modes=1 - TWIN.modes)) is None


def test_numbers_side_by_side() -> None:
    one, other = {"measured": 1.0, "standard_error": 0.3}, {"measured": 3.0, "standard_error": 0.4}
    found = measured(one, other)
    assert (found["difference"], found["standard_error"], found["z"]) == (2.0, pytest.approx(0.5), pytest.approx(4.0))
    assert measured(one, {"measured": 3.0, "standard_error": None})["z"] is None
    assert measured(None, other)["difference"] is None
    pairs = ((4.0, 3.0), (-4.0, -3.0), (0.0, 3.0), (None, 3.0))
    assert [relative(*pair)["relative"] for pair in pairs] == [-0.25, 0.25, None, None]


def test_two_bags(tmp_path: Path) -> None:
    """Keys, versions, verdicts and errors; the errors are those of the comparisons, saved or not."""
    other = TWIN.experiment.with_run(seed=8, duration=40).simulate()
    other.record.versions["numpy"] = "1.0"
    paths = [TWIN.save(tmp_path / "a"), other.save(tmp_path / "b")]
    found = bag_difference(*paths)
    assert found["keys"] == [{"key": "run.duration", "a": 20.0, "b": 40.0}, {"key": "run.seed", "a": 7, "b": 8}]
    assert found["versions"] == [{"key": "numpy", "a": TWIN.record.versions["numpy"], "b": "1.0"}]
    assert (found["states"]["compared"], found["states"]["first"]["step"]) == (200, 1)  # both start at zero
    comparisons = [each.compare() for each in (TWIN, other)]
    assert [found[side]["verdict"] for side in "ab"] == [each.verdict for each in comparisons]
    assert [found[side]["complete"] for side in "ab"] == [True, True]
    totals = [one.system_error if one.system_error.standard_error else one.given.system_error for one in comparisons]
    error = found["errors"]["system"]
    assert error["difference"] == pytest.approx(totals[1].measured - totals[0].measured)
    deviation = math.hypot(*(total.standard_error for total in totals))
    assert error["z"] == pytest.approx(error["difference"] / deviation)
    assert (len(found["errors"]["agents"]), found["errors"]["independent"]) == (4, True)

    document = comparisons[0].to_json()
    (paths[0] / "result.json").write_text(json_text(document | {"verdict": "disagrees"}))
    again = bag_difference(*paths)
    assert again["a"]["verdict"] == "disagrees"
    assert again["errors"] == found["errors"]
    (paths[0] / "result.json").write_text(json_text(document | {"verdict": "disagrees", "run": "of another"}))
    assert bag_difference(*paths)["a"]["verdict"] == "agrees"
    json.dumps(again, allow_nan=False)


def four(rate: float = 1.0, **changes: Any) -> Experiment:
    graphs = {"line": {"path": [1, 2, 3, 4]}, "star": {"star": {"center": 2}}}
    return line_ring(4, rate, **{"graphs": graphs, "run": {"dt": 0.1}} | changes)


def test_predictions_rates_and_leaders() -> None:
    a, b = four(), four(5.0)
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
    led = four(problem="tracking", leaders={"agents": [1, 4], "gain": 2.0})
    found = experiment_difference(four(), led)["leaders"]
    assert (found["b"]["agents"], found["b"]["system_error"]) == ([1, 4], led.leaders().present[0])
    bests = [found[side]["best"] for side in "ab"]
    assert [(len(best["agents"]), best["gain"]) for best in bests] == [(2, 2.0), (2, 2.0)]


def test_other_sizes_and_laws() -> None:
    """What only one has stands alone."""
    small = four(
        time="discrete", graphs={"line": {"path": [1, 2, 3]}}, switching={"transition": [[1.0]]}, run={"duration": 20}
    )
    found = experiment_difference(four(), small)
    assert set(found["predictions"]) == {"continuous", "emulated", "discrete", "static"}
    assert found["predictions"]["discrete"]["system_error"]["a"] is None
    assert found["predictions"]["static"]["node_errors"] == []
    assert found["rates"]["graph"]["b"] is None


def test_one_without_a_prediction() -> None:
    """It has a reason, and the other its numbers."""
    saturated = four(protocol={"name": "saturated"}, run={"dt": 0.1, "duration": 20, "start": "zero"})  # not linear
    found = experiment_difference(saturated, four())
    assert found["a"]["unpredicted"]
    assert found["leaders"]["a"]["note"] == "no prediction"
    assert found["predictions"]["emulated"]["system_error"]["a"] is None
    assert found["predictions"]["emulated"]["system_error"]["b"] > 0


def test_many_sets_of_leaders_are_not_searched() -> None:
    ring = {"graphs": {"ring": {"cycle": list(range(1, 31))}}, "switching": {}}
    led = four(problem="tracking", leaders={"agents": [1, 2, 3], "gain": 2.0}, **ring)
    found = experiment_difference(led, led)
    assert found["keys"] == []
    assert "msg-analysis leaders" in found["leaders"]["a"]["note"]
