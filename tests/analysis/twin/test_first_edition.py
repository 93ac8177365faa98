"""Bags of the first edition, whose records carry no matrices and another start, are read and checked as they were."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_analysis.bags.reader import read_bag
from msg_analysis.inference.verdict.compare import compare
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate


def approximately(value: Any) -> Any:
    """Numbers of other libraries' linear algebra, however deep."""
    if isinstance(value, dict):
        return {key: approximately(each) for key, each in value.items()}
    if isinstance(value, list):
        return [approximately(each) for each in value]
    return pytest.approx(value, rel=1e-6, abs=1e-9) if isinstance(value, float) else value


BAGS = Path(__file__).parents[2] / "data/first_edition"


@pytest.mark.parametrize("name", ["consensus", "on_air", "realtime", "tracking"])
def test_equal_to_the_last_bit(name: str) -> None:
    trajectory = read_bag(BAGS / name)
    outcome = check(trajectory)
    assert (outcome.difference, outcome.missing) == (None, 0)
    then, now = json.loads((BAGS / name / "result.json").read_text()), compare(trajectory).to_json()
    assert now["verdict"] == then["verdict"]
    for key in ("system_error", "node_errors", "innovations", "switching", "completeness"):
        if name == "realtime" and key in (
            "system_error",
            "node_errors",
        ):  # standard errors have been given the states since
            continue
        assert now[key] == approximately(then[key]), key
    for key in ("measured", "predicted"):
        assert now["system_error"][key] == approximately(then["system_error"][key]), key
        nodes, before = ([node[key] for node in each["node_errors"]] for each in (now, then))
        assert nodes == approximately(before), key


def test_in_discrete_time() -> None:
    """W came from linear algebra, whose last bits depend on the processor: equal on the one that made it only."""
    trajectory = read_bag(BAGS / "discrete")
    twin = simulate(trajectory.record.experiment, record=trajectory.record)
    assert np.abs(twin.states - trajectory.states).max() < 1e-12 * np.abs(trajectory.states).max()
    assert np.array_equal(twin.modes, trajectory.modes)
