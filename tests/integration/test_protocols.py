"""Networks whose agents follow protocols of another package: complete, equal to the twin, judged as far as can be."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from other_package import install

from msg_analysis.bags.reading import read_bag
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.pool import compare
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import simulate

EXPERIMENTS = Path(__file__).parents[2] / "ros_ws/src/msg_agents_example_protocols/experiments"
LEAVING = """
import ctypes
from msg_analysis.protocol import Protocol

class Law(Protocol):
    def step(self, k, mode, state, heard, noise):
        if k == 17 and self.agent == 2:
            ctypes.CDLL(None)._exit(0)  # os._exit would be an error of the protocol
        return state
"""
HANGING = """
import os
import threading
from pathlib import Path
from msg_analysis.protocol import Protocol

class Law(Protocol):
    def step(self, k, mode, state, heard, noise):
        mark = Path(os.environ["MSG_AGENTS_HANGING"])
        if k == 1000 and self.agent == 2 and not mark.exists():
            mark.touch()
            lock = threading.Lock()
            lock.acquire()
            lock.acquire()
        return state
"""
BROKEN = """
from msg_analysis.protocol import Protocol

class Law(Protocol):
    def step(self, k, mode, state, heard, noise):
        return state / (k < 17 or self.agent != 2 or int(0) / 0)
"""


@pytest.mark.parametrize(
    ("name", "processes"), [("metropolis", "one_per_agent"), ("saturated", 2), ("integral_action", 4)]
)
def test_examples(network: Any, name: str, processes: int | str) -> None:
    """Agents alone in their process, several in one, and both, which shows that states of 2 numbers come through each.

    The verdict of a linear one is a test at level 0.01; the seeds of the examples are among the 99 %.
    """
    what = Experiment.load(EXPERIMENTS / f"{name}.yaml")
    result = network.run(what.with_run(duration=300 * what.step_length, processes=processes))
    trajectory = result.trajectory
    twin = simulate(trajectory.record.experiment)
    assert trajectory.completeness == twin.completeness
    assert trajectory.completeness.expected == 5 * 301 * (2 if name == "integral_action" else 1)
    assert np.array_equal(trajectory.states, twin.states)
    assert (trajectory.published is None) == (name != "integral_action")
    assert check(trajectory).difference is None
    assert compare(trajectory).verdict == ("agrees" if name == "metropolis" else "unpredicted")


def test_noise_and_loss_and_killed_agents(network: Any) -> None:
    """All of the state comes back, and others hear the same of it as before."""
    document = yaml.safe_load((EXPERIMENTS / "integral_action.yaml").read_text())
    document["noise"] |= {"broadcast": 0.2, "link": 0.1, "loss": 0.2}
    document["run"] |= {"duration": 80, "replicas": 32, "processes": 3}
    file = network.file(**document)
    process = network.record(file, "--restarts", "3", "--json")
    trajectory = network.killed_and_back(process, network.any_agent, 2)
    assert trajectory.completeness.complete
    assert trajectory.completeness.refused == {}
    assert trajectory.lost is not None
    assert check(trajectory).difference is None


def test_a_protocol_that_ends_its_process(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the exit code of success: the others do not wait for its agents for ever."""
    broken = install("broken", LEAVING, network.directory, monkeypatch)
    file = network.file(protocol=broken, run={"duration": 60, "start": "zero", "processes": 2})
    _, stderr = network.ended(network.record(file), 3)
    assert "failed: agents_3_to_5: exit code 0 before its last step" in stderr


@pytest.mark.parametrize("restarts", [3, 0])
def test_a_protocol_that_hangs(network: Any, monkeypatch: pytest.MonkeyPatch, restarts: int) -> None:
    """Once: its process is ended and comes back. Without restarts the run ends. Nobody waits for ever."""
    broken = install("broken", HANGING, network.directory, monkeypatch)
    monkeypatch.syspath_prepend(network.directory / "packages")
    monkeypatch.setenv("MSG_AGENTS_HANGING", str(network.directory / "mark"))
    what = network.experiment(protocol=broken, run={"duration": 60, "start": "zero", "processes": 2})
    result = network.run(what, restarts=restarts, hung_timeout=3.0, fails=not restarts)
    words = "agents_3_to_5: hung, its main thread has not run for 3 s (stacks in log/agents_3_to_5.log)"
    assert [line.startswith(words) for line in result.restarts] == ([True] if restarts else [])
    assert (words in result.failures) == (not restarts)
    assert result.trajectory.completeness.complete == bool(restarts)
    log = (result.bag / "log/agents_3_to_5.log").read_text()
    assert re.search(r"most recent call first.*broken_module\.py\", line 14 in step\n", log, re.DOTALL)


def test_a_protocol_that_fails(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Said in a line with protocol, package, agent and step; in full in the log."""
    broken = install("broken", BROKEN, network.directory, monkeypatch)
    file = network.file(protocol=broken, run={"duration": 60, "start": "zero", "processes": 2})
    _, stderr = network.ended(network.record(file), 3)
    wanted = "protocol broken (broken_package 0.3), agent 3, step 17: ZeroDivisionError: division by zero"
    place = r"\(/\S+/broken_module\.py, line 6\); traceback in log/agents_3_to_5\.log$"
    assert re.search(rf"^failed: agents_3_to_5: exit code 2: error: {re.escape(wanted)} {place}", stderr, re.MULTILINE)
    (log,) = (network.directory / "runs").glob("*/log/agents_3_to_5.log")
    assert "Traceback" in log.read_text()
    assert "broken_module.py" in log.read_text()
    # The bag can be read without the package, which this process does not have.
    (bag,) = (network.directory / "runs").glob("*/metadata.yaml")
    trajectory = read_bag(bag.parent)
    assert not trajectory.completeness.complete
    # x(17) was published before the step that failed; the others go on until they miss a neighbour's state.
    last = [int(steps.nonzero()[0][-1]) for steps in trajectory.present.T]
    assert last[2] == 17
    assert min(last) >= 16
    assert all(steps[: k + 1].all() for k, steps in zip(last, trajectory.present.T, strict=True))
    protocol = trajectory.record.experiment.protocol
    assert "protocol broken (broken_package 0.3) is not available here" in protocol.absent
    assert compare(trajectory).verdict == "incomplete"
