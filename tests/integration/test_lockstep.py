"""A network of processes does, to the last bit, what the law and the seed say."""

import json
from typing import Any

import numpy as np
import pytest
from networks import assert_equal_to_twin
from processors import another_processor

from msg_analysis.bags.reading import read_bag
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.pool import compare
from msg_analysis.model.run import Run
from msg_analysis.twin.simulate import simulate

LEADERS = {"agents": [1, 4], "reference": 2.0}
RECEPTION = {"broadcast": 0.5, "link": 0.4, "loss": 0.25}
PAIRS = [RECEPTION | {absent: 0.0} for absent in RECEPTION]
"""With the networks without any of it, each of any two is there and not there with the other."""
CASES: dict[str, dict[str, Any]] = {
    "tracking": {
        "problem": "tracking",
        "leaders": {**LEADERS, "gain": 0.7},
        "noise": {"process": [1, 2, 1, 0.5, 1], **RECEPTION},
    },
    "noise by graph": {
        "noise": {
            "process": {"line": [1, 2, 0, 0.5, 1], "ring": [[0.1 * (1 + i + j) for j in range(5)] for i in range(5)]}
        }
    },
    "discrete": {
        "time": "discrete",
        "switching": {"transition": [[0.9, 0.1], [0.4, 0.6]]},
        "noise": {"process": [[1.0 if i == j else 0.3 / (1 + i + 2 * j) for j in range(5)] for i in range(5)]}
        | RECEPTION,
        "run": {"dt": 1, "duration": 300},
    },
    "disconnected": {
        "graphs": {"apart": {"edges": [[1, 2], [4, 5]]}, "between": {"edges": [[2, 3], [3, 4, 0.5]]}},
        "run": {"start": [1, 2, 3, 4, 5]},
    },
}


@pytest.mark.parametrize(
    ("case", "processes"),
    [("tracking", 2), ("noise by graph", "one_per_agent"), ("disconnected", "one_per_agent")],
)
def test_equals_the_twin(network: Any, case: str, processes: Any) -> None:
    """Every law, and every number of processes: what one agent computes does not depend on the other."""
    # Discrete time: on another processor, below. Consensus with equal noise: below, with one and two processes, and in
    # test_discovery with one per agent. Leaders held at the reference: below, with one and two processes, and in
    # test_links.
    changes = CASES[case]
    what = network.experiment(**{**changes, "run": {**changes.get("run", {}), "processes": processes}})
    result = network.run(what)
    equals_the_twin(what, result.trajectory)


def equals_the_twin(what: Experiment, trajectory: Run | None) -> None:
    """300 steps: more than the window of the lockstep and more than one block of noise."""
    assert_equal_to_twin(trajectory)
    assert trajectory.completeness.expected == 5 * 301 * (2 if what.noise.broadcast else 1)
    assert trajectory.completeness.out_of_order == 0
    assert trajectory.completeness.refused == {}
    again = simulate(what)  # from the experiment alone: nothing of the bag is used
    assert np.array_equal(again.states, trajectory.states)
    assert np.array_equal(again.modes, trajectory.modes)
    assert np.array_equal(trajectory.agent_modes[1:], np.repeat(again.modes[:, None], 5, axis=1))


@pytest.mark.parametrize("processes", [1, 2])
def test_a_chain_that_jumps_in_nearly_every_step(network: Any, processes: int) -> None:
    """Agents that use up a thousand holding periods before their next report is due say so, and get more."""
    # The leader is held at the reference: it waits for nobody. Agents of one process wait for no message.
    result = network.run(
        network.experiment(
            problem="tracking",
            time="discrete",
            graphs={"one": {"arcs": [[1, 2]]}, "other": {"arcs": [[1, 2], [2, 1]]}},
            switching={"transition": [[0.05, 0.95], [0.95, 0.05]]},
            leaders={"agents": [1], "gain": "inf"},
            run={"dt": 1, "duration": 2500, "start": "zero", "processes": processes},
        )
    )
    assert_equal_to_twin(result.trajectory)


def test_a_network_on_another_processor(network: Any) -> None:
    """What it records is what the twin of this processor gives, from the experiment alone."""
    file = network.file(**CASES["discrete"])
    result = network.completed(network.execute(*network.recording(file), "--json", **another_processor()))
    equals_the_twin(network.experiment(**CASES["discrete"]), read_bag(result["bag"]))


@pytest.mark.parametrize("fork", [True, False])
def test_progress_the_other_executor_and_what_is_imported(network: Any, fork: bool) -> None:
    """The executor that a ROS 2 without the events executor falls back to; every process names what it imports."""
    seen: list[int] = []
    environment = {"MSG_AGENTS_EXECUTOR": "single", "PYTHONPROFILEIMPORTTIME": "1"}
    what = network.experiment(run={"processes": 2 if fork else 1})
    result = network.run(what, environment=environment, on_progress=seen.append, fork=fork)
    equals_the_twin(what, result.trajectory)

    assert seen == sorted(seen)
    assert seen[-1] == 300
    assert result.wall_time > 0
    assert result.rate == 300 / result.wall_time

    modules = {log.stem: _imported(log.read_text()) for log in (result.bag / "log").glob("*.log")}
    # With any of these a network would take twice as long to start.
    assert not {"scipy", "networkx", "matplotlib", "rich", "rosbags"} & {
        name.partition(".")[0] for name in set().union(*modules.values())
    }
    nodes = {"recorder", "switcher"} | ({"agents_1_to_2", "agents_3_to_5"} if fork else {"agents_1_to_5"})
    importing = {"fork_server"} if fork else nodes
    assert modules.keys() == nodes | importing
    for name, imported in modules.items():
        assert ({"rclpy", "numpy", "msg_agents", "msg_analysis"} <= imported) == (name in importing), name
        assert name in importing or ("rclpy" not in imported and len(imported) < 10), imported


def _imported(log: str) -> set[str]:
    """Names of the modules in a log of Python's import times."""
    return {line.rpartition("|")[2].strip() for line in log.splitlines() if "import time:" in line}


@pytest.mark.parametrize("noise", PAIRS, ids=json.dumps)
def test_equals_the_twin_and_the_prediction(network: Any, noise: dict[str, float]) -> None:
    """400 steps: the bits of the twin, and |z| < 4 for the system and 5 agents: 4e-4 false alarms a case."""
    what = network.experiment(noise=noise, run={"duration": 20, "replicas": 16, "processes": 2})
    result = network.run(what)
    trajectory, twin = result.trajectory, simulate(what)
    assert trajectory.completeness == twin.completeness
    assert trajectory.completeness.expected == 5 * 401 * (2 if noise["broadcast"] else 1)
    assert_equal_to_twin(trajectory)
    assert np.array_equal(trajectory.states, twin.states)
    for mine, other in ((trajectory.published, twin.published), (trajectory.lost, twin.lost)):
        assert (mine is None) == (other is None)
        assert mine is None or np.array_equal(mine, other)
    comparison = compare(trajectory)
    assert all(abs(estimate.z) < 4 for estimate in [comparison.system_error, *comparison.node_errors])
