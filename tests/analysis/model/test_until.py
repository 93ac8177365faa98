"""When a run may end early, and the record of one that has."""

from __future__ import annotations

import json

import numpy as np
import pytest

from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run_record import RunRecord, Until
from msg_analysis.twin.simulate import new_record, simulate


def experiment() -> Experiment:
    return Experiment.parse(
        {
            "name": "net",
            "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 0.05, "duration": 40, "replicas": 2, "seed": 3},
        }
    )


@pytest.mark.parametrize(
    ("text", "precision", "decided"),
    [("1%", 0.01, False), ("0.5 %", 0.005, False), (".25%", 0.0025, False), ("decided", 0.05, True)],
)
def test_is_read_and_written(text: str, precision: float, decided: bool) -> None:
    until = Until.parse(text)
    assert (until.precision, until.decided) == (pytest.approx(precision), decided)
    assert Until.parse(str(until)) == until


@pytest.mark.parametrize("text", ["", "1", "0%", "100%", "-1%", "1e-3%", "nan%", "Decided", "1%%", "1% decided"])
def test_mistakes(text: str) -> None:
    with pytest.raises(InputError, match=r"--until: .*expected a precision in percent.* such as 1%, or decided"):
        Until.parse(text)


def test_the_record_of_a_run_that_has_ended() -> None:
    """The random numbers of a shorter run are the first ones of the longer run, so it is a twin of its own."""
    record = RunRecord.from_json(
        json.dumps(json.loads(new_record(experiment()).to_json()) | {"until": "1%"}), "somewhere"
    )
    assert record.until == Until(0.01)
    assert (record.planned, record.planned_steps) == (None, 800)
    ended = record.ended(333)
    assert (ended.experiment.steps, ended.planned, ended.planned_steps) == (333, 800, 800)
    again = RunRecord.from_json(ended.to_json(), "somewhere")
    assert (again.planned, again.until, again.experiment) == (800, Until(0.01), ended.experiment)
    whole, part = simulate(record.experiment, record=record), simulate(again.experiment, record=again)
    assert np.array_equal(part.states, whole.states[:334])
    assert np.array_equal(part.modes, whole.modes[:333])


def test_damaged_records() -> None:
    document = json.loads(new_record(experiment()).to_json())
    with pytest.raises(InputError, match="planned_steps: 800: expected more than the 800 made"):
        RunRecord.from_json(json.dumps(document | {"planned_steps": 800}), "x")
    with pytest.raises(InputError, match="x: until: 'soon': expected a precision"):
        RunRecord.from_json(json.dumps(document | {"until": "soon"}), "x")
