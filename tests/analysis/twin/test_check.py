"""The comparison with the twin finds what was changed, and says where."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.bags.writing import write_trajectory
from msg_analysis.common import arrays
from msg_analysis.common.arrays import FloatArray, IntArray, in_file
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate


@pytest.fixture(scope="module")
def twin() -> Run:
    experiment = Experiment.parse(
        {
            "name": "checked",
            "problem": "consensus",
            "time": "continuous",
            "graphs": {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 0.05, "duration": 20, "replicas": 2, "seed": 5},
        }
    )
    return simulate(experiment)


@pytest.fixture
def stored(twin: Run, tmp_path: Path) -> Callable[..., Run]:
    """The twin with other states or modes, written to a bag and read again."""

    def store(states: FloatArray | None = None, modes: IntArray | None = None) -> Run:
        changed = dataclasses.replace(
            twin,
            states=twin.states if states is None else states,
            modes=twin.modes if modes is None else modes,
        )
        write_trajectory(changed, tmp_path / "bag")
        return read_bag(tmp_path / "bag")

    return store


def flip(states: FloatArray, *where: int) -> FloatArray:
    """The last bit of one number turned over."""
    changed = states.copy()
    bits = changed.view(np.uint64)
    bits[where] ^= np.uint64(1)
    return changed


def test_a_long_run(stored: Callable[..., Run], twin: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Logged and computed states are in files and compared in pieces, here of ten steps."""
    monkeypatch.setattr(arrays, "LARGE", 1)
    monkeypatch.setattr(arrays, "BLOCK_NUMBERS", 60)
    again = simulate(twin.record.experiment, record=twin.record)
    assert in_file(again.states)
    assert np.array_equal(again.states, twin.states)
    changed = flip(flip(twin.states, 237, 1, 0), 310, 0, 1)
    changed[100, 2] = np.nan
    logged = stored(changed)
    assert in_file(logged.states)
    outcome = check(logged)
    assert outcome.difference is not None
    assert outcome.difference.startswith("agent 2 at step 237, replica 1: ")
    assert outcome.missing == 1


def test_equal(twin: Run, stored: Callable[..., Run]) -> None:
    outcome = check(stored())
    assert outcome.difference is None
    assert outcome.compared == twin.states.shape[0] * 3
    assert outcome.missing == 0


@pytest.mark.parametrize("where", [(0, 0, 0), (17, 2, 1), (400, 1, 0)])
def test_one_bit(twin: Run, stored: Callable[..., Run], where: tuple[int, int, int]) -> None:
    step, agent, replica = where
    changed = flip(twin.states, *where)
    difference = check(stored(changed)).difference
    assert difference == (
        f"agent {agent + 1} at step {step}, replica {replica + 1}: logged {float(changed[where])!r}, "
        f"the law gives {float(twin.states[where])!r}"
    )


def test_the_first_of_several_is_named(twin: Run, stored: Callable[..., Run]) -> None:
    changed = flip(flip(flip(twin.states, 30, 0, 1), 29, 2, 0), 29, 1, 1)
    assert str(check(stored(changed)).difference).startswith("agent 2 at step 29, replica 2:")


def test_wrong_graph(twin: Run, stored: Callable[..., Run]) -> None:
    modes = twin.modes.copy()
    modes[40:50] = 1 - modes[40:50]
    names = ["line", "ring"]
    expected = f"graph of step 40: logged {names[modes[40]]}, the seed gives {names[twin.modes[40]]}"
    assert check(stored(modes=modes)).difference == expected


@pytest.mark.parametrize(("state_step", "first"), [(40, "agent 1"), (41, "graph")])
def test_state_or_graph_whichever_came_first(
    twin: Run, stored: Callable[..., Run], state_step: int, first: str
) -> None:
    """x(40) is older than the choice of g(40), x(41) comes out of it."""
    modes = twin.modes.copy()
    modes[40] = 1 - modes[40]
    outcome = check(stored(flip(twin.states, state_step, 0, 0), modes))
    assert str(outcome.difference).startswith(first)


def test_missing_states_are_counted_and_do_not_differ(twin: Run, stored: Callable[..., Run]) -> None:
    states = twin.states.copy()
    states[100:, 1] = np.nan
    outcome = check(stored(states))
    assert outcome.difference is None
    assert outcome.missing == len(states) - 100
    assert outcome.compared == states.shape[0] * 3 - outcome.missing


def test_another_seed_differs_at_once(twin: Run, stored: Callable[..., Run]) -> None:
    other = simulate(twin.record.experiment.with_run(seed=6))
    assert str(check(stored(other.states)).difference).startswith("agent 1 at step 0")
