"""A network of processes does, to the last bit, what the law and the seed say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from processors import another_processor

from msg_analysis.bags.reader import read_bag
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate

LEADERS = {"agents": [1, 4], "reference": 2.0}
CASES: dict[str, dict[str, Any]] = {
    "consensus": {},
    "tracking": {
        "problem": "tracking",
        "leaders": {**LEADERS, "gain": 0.7},
        "noise": {"process": [1, 2, 1, 0.5, 1]},
    },
    "noise by graph": {
        "noise": {
            "process": {"line": [1, 2, 0, 0.5, 1], "ring": [[0.1 * (1 + i + j) for j in range(5)] for i in range(5)]}
        },
    },
    "grounded": {"problem": "tracking", "leaders": {**LEADERS, "gain": "inf"}},
    "discrete": {
        "time": "discrete",
        "switching": {"transition": [[0.9, 0.1], [0.4, 0.6]]},
        "noise": {"process": [[1.0 if i == j else 0.3 / (1 + i + 2 * j) for j in range(5)] for i in range(5)]},
        "run": {"dt": 1, "duration": 300},
    },
    "disconnected": {
        "graphs": {"apart": {"edges": [[1, 2], [4, 5]]}, "between": {"edges": [[2, 3], [3, 4, 0.5]]}},
        "run": {"start": [1, 2, 3, 4, 5]},
    },
}


@pytest.mark.parametrize("processes", [1, 2, "one_per_agent"])
@pytest.mark.parametrize("case", CASES)
def test_equals_the_twin(network: Any, case: str, processes: Any) -> None:
    """300 steps: more than the window of the lockstep and more than one block of noise."""
    changes = CASES[case]
    what = network.experiment(**{**changes, "run": {**changes.get("run", {}), "processes": processes}})
    result = network.run(what)
    assert result.failures == []
    assert result.trajectory is not None
    assert result.trajectory.completeness.complete
    assert result.trajectory.completeness.duplicates == 0
    assert result.trajectory.completeness.out_of_order == 0
    outcome = check(result.trajectory)
    assert (outcome.difference, outcome.missing, outcome.compared) == (None, 0, 5 * 301)

    again = simulate(what)  # from the experiment alone: nothing of the bag is used
    assert np.array_equal(again.states, result.trajectory.states)
    assert np.array_equal(again.modes, result.trajectory.modes)
    assert result.trajectory.agent_modes is not None
    assert np.array_equal(result.trajectory.agent_modes[1:], np.repeat(again.modes[:, None], 5, axis=1))


def test_a_network_on_another_processor(network: Any) -> None:
    """What it records is what the twin of this processor gives, from the experiment alone."""
    file = network.file(**CASES["discrete"])
    result = network.completed(network.start("run", file, "--out", network.directory, "--json", **another_processor()))
    states = read_bag(result["bag"]).states
    assert np.array_equal(simulate(network.experiment(**CASES["discrete"])).states, states)


def test_progress_and_rate(network: Any) -> None:
    seen: list[int] = []
    result = network.run(network.experiment(run={"processes": 1}), on_progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 300
    assert result.rate > 0
    assert result.wall_time > 0


@pytest.mark.parametrize("executor", ["single"])
def test_the_other_executor(network: Any, executor: str) -> None:
    """The one that a ROS 2 without the events executor falls back to."""
    result = network.run(network.experiment(run={"processes": 2}), environment={"MSG_AGENTS_EXECUTOR": executor})
    assert result.failures == []
    assert result.trajectory is not None
    assert check(result.trajectory).difference is None
    assert result.trajectory.completeness.complete


def test_two_runs_at_the_same_time(network: Any) -> None:
    """Of one experiment, into one directory, in the same second: they neither hear nor overwrite each other."""
    file, out = network.file(run={"processes": 1}), network.directory / "runs"
    runs = [network.start("run", file, "--out", out, "--seed", seed) for seed in ("1", "2")]
    for run in runs:
        stdout, stderr = run.communicate(timeout=100)
        assert run.returncode == 0, stdout + stderr
    bags = sorted(directory for directory in out.iterdir() if directory.is_dir())
    assert len(bags) == 2
    trajectories = [read_bag(bag) for bag in bags]
    assert {trajectory.record.experiment.run.seed for trajectory in trajectories} == {1, 2}
    for trajectory in trajectories:
        assert trajectory.completeness.complete
        assert trajectory.completeness.refused == {}
        assert check(trajectory).difference is None
