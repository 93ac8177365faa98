"""What is kept of a protocol with a run, and what a bag is worth without it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from euler import Euler, EulerSteps, experiment
from pydantic import Field

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.errors import InputError
from msg_analysis.inference.verdict import compare
from msg_analysis.model.run_record import RunRecord
from msg_analysis.protocol import Parameters
from msg_analysis.report.documents import describe_bag
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import new_record, simulate


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
    assert again.protocol is not None
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
    assert read.lost is not None
    assert trajectory.lost is not None
    assert np.array_equal(read.lost, trajectory.lost)
    word = f"protocol {name} (msg_agents_example_protocols 0.1.0) is not available here"
    assert word in describe_bag(bag)["protocol"]["absent"]
    comparison = compare(read)
    assert comparison.verdict == "unpredicted"
    assert comparison.unpredicted is not None
    assert word in comparison.unpredicted
    with pytest.raises(InputError, match=r"is not available here .*: install msg_agents_example_protocols 0"):
        check(read)


def test_a_bag_of_another_version(offer: Callable[..., None], tmp_path: Path) -> None:
    """As good as the same where the states are of the same kind, else as good as none."""
    offer(("mine", EulerSteps))
    write_trajectory(simulate(experiment({"name": "mine"})), tmp_path / "bag")
    offer(("mine", EulerSteps), version="1.3")
    read = read_bag(tmp_path / "bag")
    assert read.record.experiment.protocol is not None
    assert str(read.record.experiment.protocol.info) == "protocol mine (pack 1.2)"
    assert check(read).difference is None
    offer(("mine", type("More", (EulerSteps,), {"states": 2})), version="2.0")
    read = read_bag(tmp_path / "bag")
    assert read.completeness.complete
    with pytest.raises(InputError, match=r"mine \(pack 1.2\) is not available here: the states of version 2.0"):
        check(read)
