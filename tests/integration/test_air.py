"""Networks of processes with noise and loss on the air: equal to the twin, and as predicted."""

from __future__ import annotations

import json
import random
import signal
from typing import Any

import numpy as np
import pytest

from msg_analysis.bags.reading import read_bag
from msg_analysis.inference.pool import compare
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate

ALL = {"broadcast": 0.5, "link": 0.4, "loss": 0.25}
PAIRS = [ALL | {absent: 0.0} for absent in ALL]
"""With the networks without any of it, each of any two is there and not there with the other."""
LEADERS = {"problem": "tracking", "leaders": {"agents": [1, 4], "gain": 0.7, "reference": 2.0}}


@pytest.mark.parametrize("noise", [*PAIRS, ALL], ids=json.dumps)
def test_equals_the_twin_and_the_prediction(network: Any, noise: dict[str, float]) -> None:
    """400 steps: the bits of the twin, and |z| < 4 for the system and 5 agents: 4e-4 false alarms a case."""
    what = network.experiment(noise=noise, run={"duration": 20, "replicas": 16, "processes": 2})
    result = network.run(what)
    assert result.failures == []
    trajectory, twin = result.trajectory, simulate(what)
    assert trajectory is not None
    assert trajectory.completeness == twin.completeness
    assert trajectory.completeness.expected == 5 * 401 * (2 if noise["broadcast"] else 1)
    outcome = check(trajectory)
    assert (outcome.difference, outcome.missing) == (None, 0)
    assert np.array_equal(trajectory.states, twin.states)
    for mine, other in ((trajectory.published, twin.published), (trajectory.lost, twin.lost)):
        assert (mine is None) == (other is None)
        assert mine is None or np.array_equal(mine, other)
    comparison = compare(trajectory)
    assert all(abs(estimate.z) < 4 for estimate in [comparison.system_error, *comparison.node_errors])


@pytest.mark.parametrize(
    "changes",
    [
        {**LEADERS, "run": {"processes": "one_per_agent"}},
        {
            "time": "discrete",
            "switching": {"transition": [[0.9, 0.1], [0.4, 0.6]]},
            "run": {"dt": 1, "duration": 300, "processes": 1},
        },
    ],
    ids=["tracking", "discrete"],
)
def test_other_laws_equal_the_twin(network: Any, changes: dict[str, Any]) -> None:
    what = network.experiment(noise=ALL, **changes)
    result = network.run(what)
    assert result.failures == []
    assert result.trajectory.completeness.complete
    assert check(result.trajectory).difference is None


def test_killed_agents_come_back_with_their_noise(network: Any) -> None:
    """What a new process publishes again is computed from the truth that the old one kept."""
    run = {"duration": 120, "replicas": 64, "processes": 3}
    file = network.file(noise=ALL, run=run)
    process = network.record(file, "--restarts", "3", "--json")
    network.wait_for_steps()
    for _ in range(2):
        victims = network.wait_for(lambda: network.processes("agent"), 30, "a living agent")
        random.Random(1).choice(victims).kill(signal.SIGKILL)
    stdout, stderr = process.communicate(timeout=120)
    assert process.returncode == 0, stderr
    result = json.loads(stdout)
    assert len(result["restarts"]) >= 1
    trajectory = read_bag(result["bag"])
    assert trajectory.completeness.complete
    assert trajectory.completeness.duplicates == 0
    assert trajectory.completeness.refused == {}
    assert check(trajectory).difference is None
