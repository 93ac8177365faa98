"""What differs between two bags, against changes made by hand."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_analysis import Experiment, Run
from msg_analysis.common.text import json_text
from msg_analysis.report import differences
from msg_analysis.report.differences import bag_difference, graph_difference, measured, relative
from msg_analysis.report.differences import state_difference as of_states

DOCUMENT = {
    "name": "four",
    "graphs": {"line": {"path": [1, 2, 3, 4]}, "ring": {"cycle": [1, 2, 3, 4]}},
    "switching": {"generator": [[-1, 1], [1, -1]]},
    "run": {"dt": 0.1, "duration": 20, "replicas": 3, "seed": 7, "start": "zero"},
}


@pytest.fixture(scope="module")
def run() -> Run:
    return Experiment.parse(DOCUMENT).simulate()


def changed(run: Run, **changes: Any) -> Run:
    copies = {"states": run.states.copy(), "modes": run.modes.copy()}
    return dataclasses.replace(run, **(copies | changes))


@pytest.fixture(params=[None, 60, 1])
def blocks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """However few steps are looked at together, the answers are the same."""
    if request.param:
        monkeypatch.setattr(differences, "BLOCK_NUMBERS", request.param)


@pytest.mark.usefixtures("blocks")
def test_states_that_differ(run: Run) -> None:
    other = changed(run)
    other.states[50, 2, 1] = np.nextafter(run.states[50, 2, 1], np.inf)
    other.states[50, 3, 0] += 0.25
    other.states[120, 0, 2] -= 8.0
    other.states[200, 1, 1] += 0.5
    found = of_states(run, other)
    assert found == {
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


@pytest.mark.usefixtures("blocks")
def test_equal_missing_and_shorter(run: Run) -> None:
    same = of_states(run, changed(run))
    assert (same["equal"], same["first"], same["last"]) == (True, None, {"step": 200, "difference": 0.0})
    other = changed(run)
    other.states[3, 1] = np.nan
    other.states[200, 0] = np.nan
    found = of_states(run, other)
    assert (found["equal"], found["first"], found["only_a"], found["only_b"]) == (False, None, 2, 0)
    assert found["last"] == {"step": 199, "difference": 0.0}
    assert of_states(other, run)["only_b"] == 2
    assert of_states(other, changed(other))["equal"]
    short = of_states(run, changed(run, states=run.states[:100]))
    assert (short["equal"], short["first"], short["compared"]) == (False, None, 99)


def test_the_sign_of_zero_is_a_bit(run: Run) -> None:
    other = changed(run)
    other.states[0] = -0.0
    found = of_states(changed(run), other)
    assert found["first"] == {"step": 0, "time": 0.0, "agents": [1, 2, 3, 4], "difference": 0.0}


def test_other_networks_are_not_compared(run: Run) -> None:
    found = of_states(run, changed(run, states=run.states[:, :3]))
    assert (found["compared"], found["equal"]) == (None, None)
    assert found["why"] == "4 agents with 3 numbers each and 3 agents with 3 numbers each"


def test_graphs(run: Run) -> None:
    other = changed(run)
    assert graph_difference(run, other) is None
    other.modes[:10] = -1  # not known
    other.modes[40:42] = 1 - run.modes[40:42]
    names = ["line", "ring"]
    used = run.modes[40]
    assert graph_difference(run, other) == {"step": 40, "a": names[used], "b": names[1 - used], "steps": 2}
    swapped = dict(DOCUMENT, graphs=dict(reversed(DOCUMENT["graphs"].items())))  # the same graphs, other numbers
    record = dataclasses.replace(run.record, experiment=Experiment.parse(swapped))
    assert graph_difference(run, changed(run, record=record, modes=1 - run.modes)) is None


def test_numbers_side_by_side() -> None:
    one, other = {"measured": 1.0, "standard_error": 0.3}, {"measured": 3.0, "standard_error": 0.4}
    found = measured(one, other)
    assert (found["difference"], found["standard_error"], found["z"]) == (2.0, pytest.approx(0.5), pytest.approx(4.0))
    assert measured(one, {"measured": 3.0, "standard_error": None})["z"] is None
    assert measured(None, other)["difference"] is None
    assert relative(4.0, 3.0)["relative"] == -0.25
    assert relative(-4.0, -3.0)["relative"] == 0.25
    assert relative(0.0, 3.0)["relative"] is None
    assert relative(None, 3.0)["relative"] is None


def test_two_bags(run: Run, tmp_path: Path) -> None:
    """Keys, versions, verdicts and errors; the errors are those of the comparisons, saved or not."""
    other = Experiment.parse(DOCUMENT | {"run": DOCUMENT["run"] | {"seed": 8, "duration": 40}}).simulate()
    other.record.versions["numpy"] = "1.0"
    paths = [run.save(tmp_path / "a"), other.save(tmp_path / "b")]
    found = bag_difference(*paths)
    assert found["keys"] == [
        {"key": "run.duration", "a": 20.0, "b": 40.0},
        {"key": "run.seed", "a": 7, "b": 8},
    ]
    assert found["versions"] == [{"key": "numpy", "a": run.record.versions["numpy"], "b": "1.0"}]
    assert found["states"]["compared"] == 200
    assert found["states"]["first"]["step"] == 1  # both start at zero
    comparisons = [each.compare() for each in (run, other)]
    assert [found[side]["verdict"] for side in "ab"] == [each.verdict for each in comparisons]
    assert [found[side]["complete"] for side in "ab"] == [True, True]
    totals = [each.given.to_json()["system_error"] if each.given else {} for each in comparisons]
    totals = [
        each.system_error.to_json() if each.system_error.standard_error else total
        for each, total in zip(comparisons, totals, strict=True)
    ]
    error = found["errors"]["system"]
    assert error["difference"] == pytest.approx(totals[1]["measured"] - totals[0]["measured"])
    deviation = math.sqrt(totals[0]["standard_error"] ** 2 + totals[1]["standard_error"] ** 2)
    assert error["z"] == pytest.approx(error["difference"] / deviation)
    assert len(found["errors"]["agents"]) == 4
    assert found["errors"]["independent"]

    document = comparisons[0].to_json()
    (paths[0] / "result.json").write_text(json_text(document | {"verdict": "disagrees"}))
    again = bag_difference(*paths)
    assert again["a"]["verdict"] == "disagrees"
    assert again["errors"] == found["errors"]
    (paths[0] / "result.json").write_text(json_text(document | {"verdict": "disagrees", "run": "of another"}))
    assert bag_difference(*paths)["a"]["verdict"] == "agrees"
    json.dumps(again, allow_nan=False)
