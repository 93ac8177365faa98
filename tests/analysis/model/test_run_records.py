"""What is kept of a run: of a protocol, of one that may end early, and when it began."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from euler import Euler, EulerSteps, experiment
from pydantic import Field

from experiments import (
    RunRecord,
    check,
    compare,
    line_ring,
    new_record,
    read_bag,
    simulate,
    write_trajectory,
)
from msg_analysis.errors import InputError
from msg_analysis.model.run_record import Until
from msg_analysis.protocol import Parameters
from msg_analysis.report.documents import describe_bag

PLANNED = line_ring(run={"duration": 40, "seed": 3})


@pytest.mark.parametrize(
    ("text", "precision", "decided"),
    [("1%", 0.01, False), ("0.5 %", 0.005, False), (".25%", 0.0025, False), ("decided", 0.05, True)],
)
def test_until_is_read_and_written(text: str, precision: float, decided: bool) -> None:
    until = Until.parse(text)
    assert (until.precision, until.decided) == (pytest.approx(precision), decided)
    assert Until.parse(str(until)) == until


@pytest.mark.parametrize("text", ["", "1", "0%", "100%", "-1%", "1e-3%", "nan%", "Decided", "1%%", "1% decided"])
def test_mistakes_of_until(text: str) -> None:
    with pytest.raises(InputError, match=r"--until: .*expected a precision in percent.* such as 1%, or decided"):
        Until.parse(text)


def test_the_record_of_a_run_that_has_ended() -> None:
    """The random numbers of a shorter run are the first ones of the longer run, so it is a twin of its own."""
    record = RunRecord.from_json(json.dumps(json.loads(new_record(PLANNED).to_json()) | {"until": "1%"}), "somewhere")
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
    document = json.loads(new_record(PLANNED).to_json())
    with pytest.raises(InputError, match="planned_steps: 800: expected more than the 800 made"):
        RunRecord.from_json(json.dumps(document | {"planned_steps": 800}), "x")
    with pytest.raises(InputError, match="x: until: 'soon': expected a precision"):
        RunRecord.from_json(json.dumps(document | {"until": "soon"}), "x")


class OptionalParameters(Parameters):
    limit: float | None = Field(2.0)


class Optional(EulerSteps):
    Parameters: ClassVar[type[Parameters]] = OptionalParameters


@pytest.mark.parametrize("limit", [None, 3.0, ...])
def test_parameters_survive(limit: Any, offer: Callable[..., None]) -> None:
    """Also one that is None, and is not so by default."""
    offer(("optional", Optional))
    what = experiment({"name": "optional"} | ({} if limit is ... else {"limit": limit}))
    again = RunRecord.from_json(new_record(what).to_json(), "here").experiment
    assert again == what
    assert again.protocol.parameters == OptionalParameters(**({} if limit is ... else {"limit": limit}))
    assert again.to_document()["protocol"] == {"name": "optional", "limit": 2.0 if limit is ... else limit}


@pytest.mark.parametrize("name", ["metropolis", "integral_action"])
def test_a_bag_of_what_is_not_installed(name: str, offer: Callable[..., None], tmp_path: Path) -> None:
    """It can be read, counted and measured. What needs the protocol says so."""
    bag = tmp_path / "bag"
    trajectory = simulate(experiment({"name": name}, noise={"loss": 0.2}, run={"start": "zero"}))
    write_trajectory(trajectory, bag)
    assert json.loads(trajectory.record.to_json())["protocol"] == {
        "name": name,
        "package": "msg_agents_example_protocols",
        "version": "0.1.0",
        "linear": name == "metropolis",
        "states": 1 if name == "metropolis" else 2,
        "hidden": name != "metropolis",
    }
    offer(("another", Euler))
    read = read_bag(bag)
    assert read.completeness == trajectory.completeness
    assert np.array_equal(read.states, trajectory.states)
    assert np.array_equal(read.lost, trajectory.lost)
    word = f"protocol {name} (msg_agents_example_protocols 0.1.0) is not available here"
    assert word in describe_bag(bag)["protocol"]["absent"]
    comparison = compare(read)
    assert comparison.verdict == "unpredicted"
    assert word in comparison.unpredicted
    with pytest.raises(InputError, match=r"is not available here .*: install msg_agents_example_protocols 0"):
        check(read)


def test_a_bag_of_another_version(offer: Callable[..., None], tmp_path: Path) -> None:
    """As good as the same where the states are of the same kind, else as good as none."""
    offer(("mine", EulerSteps))
    write_trajectory(simulate(experiment({"name": "mine"})), tmp_path / "bag")
    offer(("mine", EulerSteps), version="1.3")
    read = read_bag(tmp_path / "bag")
    assert str(read.record.experiment.protocol.info) == "protocol mine (pack 1.2)"
    assert check(read).difference is None
    offer(("mine", type("More", (EulerSteps,), {"states": 2})), version="2.0")
    read = read_bag(tmp_path / "bag")
    assert read.completeness.complete
    with pytest.raises(InputError, match=r"mine \(pack 1.2\) is not available here: the states of version 2.0"):
        check(read)
