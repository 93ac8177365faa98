"""The comparison with the twin where values are published with noise, and messages lost."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate


@pytest.fixture(scope="module")
def twin() -> Run:
    return simulate(
        Experiment.parse(
            {
                "name": "checked",
                "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
                "switching": {"generator": [[-1, 1], [1, -1]]},
                "noise": {"broadcast": 0.2, "loss": 0.3},
                "run": {"dt": 0.05, "duration": 20, "replicas": 2, "seed": 5},
            }
        )
    )


def stored(trajectory: Run, directory: Path) -> Run:
    write_trajectory(trajectory, directory / "bag")
    return read_bag(directory / "bag")


def test_equal(twin: Run, tmp_path: Path) -> None:
    outcome = check(stored(twin, tmp_path))
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, 2 * 3 * 401)


def test_published(twin: Run, tmp_path: Path) -> None:
    assert twin.published is not None
    published = twin.published.copy()
    published[30, 1, 1] = np.nextafter(published[30, 1, 1], 9.0)
    published[31, 0] += 1.0
    assert check(stored(dataclasses.replace(twin, published=published), tmp_path)).difference == (
        f"agent 2 at step 30, replica 2: published {float(published[30, 1, 1])!r}, "
        f"the law gives {float(twin.published[30, 1, 1])!r}"
    )


@pytest.mark.parametrize(("changed_state", "first"), [(50, "agent 1 at step 50"), (51, "the message")])
def test_losses(twin: Run, tmp_path: Path, changed_state: int, first: str) -> None:
    """Step 50 leads to x(51). Agent 2 hears agents 1 and 3 in both graphs."""
    assert twin.lost is not None
    lost, states = twin.lost.copy(), twin.states.copy()
    lost[50, 1, 1] ^= True
    states[changed_state, 0, 0] += 1.0
    difference = check(stored(dataclasses.replace(twin, lost=lost, states=states), tmp_path)).difference
    assert difference is not None
    assert difference.startswith(first)
    words = ("heard", "lost") if twin.lost[50, 1, 1] else ("lost", "heard")
    if changed_state == 51:
        assert difference == (
            f"the message of agent 3 to agent 2 in step 50: logged as {words[0]}, the seed gives {words[1]}"
        )


def test_missing_truth_or_publication_is_counted(twin: Run, tmp_path: Path) -> None:
    assert twin.published is not None
    published, states = twin.published.copy(), twin.states.copy()
    published[300:, 1] = np.nan
    states[350:, 2] = np.nan
    outcome = check(stored(dataclasses.replace(twin, published=published, states=states), tmp_path))
    assert (outcome.difference, outcome.missing) == (None, 101 + 51)
