"""Cyclone DDS, another vendor's middleware, beside a run: as a reader, as a stranger, and as one of its agents."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from msg_agents.discovery.ros_domain import free_domain
from msg_agents.processes.environment import node_environment
from msg_agents.processes.fork_server import NodeServer
from msg_agents.processes.process_plan import plan_network
from msg_agents.running.supervisor import Supervisor
from msg_analysis.bags.reader import read_bag
from msg_analysis.model.run.trajectory import Trajectory
from msg_analysis.twin.check import check
from msg_analysis.twin.simulate import new_record

READER = Path(__file__).parents[1] / "support" / "cyclone_reader.py"
AGENT = Path(__file__).parents[2] / "docs" / "cyclone_dds" / "cyclone_agent.py"
SHORT_LEASE = "<CycloneDDS><Domain><Discovery><LeaseDuration>2s</LeaseDuration></Discovery></Domain></CycloneDDS>"
# Nodes that are started one by one look for each other, and for others, at the loopback address only.
UNICAST = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>"
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>'
    '<Peers><Peer Address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)


@contextmanager
def cyclone(domain: int, *options: str | Path, uri: str = "") -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {"CYCLONEDDS_URI": uri}
    command = [sys.executable, "-P", str(READER), "--domain", str(domain), *map(str, options)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def came(reader: subprocess.Popen[str]) -> dict[str, list[Any]]:
    text, _ = reader.communicate(timeout=60)
    assert reader.returncode == 0
    found: dict[str, list[Any]] = json.loads(text)
    return found


def equal_to_the_twin(trajectory: Trajectory) -> None:
    assert trajectory.completeness.complete
    outcome = check(trajectory)
    assert (outcome.difference, outcome.missing) == (None, 0)


def states_of(trajectory: Trajectory, agent: int) -> list[list[int]]:
    """Step, mode and checksum of every state, as in the bag."""
    modes = [0, *(int(mode) + 1 for mode in trajectory.modes)]
    values = np.ascontiguousarray(trajectory.values[:, agent])
    return [[k, modes[k], zlib.crc32(value.tobytes())] for k, value in enumerate(values)]


def once(states: list[list[int]]) -> list[list[int]]:
    """Without those that came again: on a busy machine an agent that waits for 5 s asks its peers for their states."""
    return [list(state) for state in dict.fromkeys(map(tuple, states))]


@pytest.mark.parametrize("pause", [0.0, 0.001], ids=["fast", "slow"])
def test_a_reader_that_was_there_first_gets_everything(network: Any, pause: float) -> None:
    """A slow one holds the run back, and nothing is lost."""
    what = network.experiment()
    with free_domain() as domain, cyclone(domain, "--pause", str(pause)) as reader:
        result = network.run(what, domain=domain, readers=["cyclone_reader"])
        found = came(reader)
    assert result.failures == []
    assert result.strangers == []
    equal_to_the_twin(result.trajectory)
    asked = any("no step for" in log.read_text() for log in (result.bag / "log").iterdir())
    for agent in range(5):
        states = found[f"agent_{agent + 1}/state"]
        assert (once(states) if asked else states) == states_of(result.trajectory, agent)
    (record,) = found["experiment"]
    assert json.loads(record)["run"] == str(result.trajectory.record.run)
    assert [sequence for sequence, _, _ in found["graph"]] == list(range(len(found["graph"])))
    assert found["graph"][-1][2] == what.steps - 1
    assert {agent for agent, _ in found["progress"]} >= {1, 2, 3, 4, 5}
    assert found["end"] == [[0, what.steps]]


def test_a_late_reader_gets_what_is_latched(network: Any) -> None:
    """Every sojourn from the first one on, in the middle of a run, which another reader holds back for so long."""
    begun, found = network.directory / "begun", network.directory / "found"
    what = network.experiment(run={"duration": 50})
    with (
        free_domain() as domain,
        cyclone(domain, "--seen", begun, "--until", found),
        ThreadPoolExecutor() as threads,
    ):
        late = threads.submit(partial(_read_late, network, domain, begun, found))
        result = network.run(what, domain=domain, readers=["cyclone_reader"])
        came_late = late.result()
    assert result.failures == []
    equal_to_the_twin(result.trajectory)
    (record,) = came_late["experiment"]
    assert json.loads(record)["run"] == str(result.trajectory.record.run)
    graphs = came_late["graph"]
    assert [first for _, first, _ in graphs] == [0, *(last + 1 for _, _, last in graphs[:-1])]
    assert (graphs[-1][2], came_late["end"]) == (what.steps - 1, [[0, what.steps]])


def _read_late(network: Any, domain: int, begun: Path, found: Path) -> dict[str, list[Any]]:
    network.wait_for(begun.exists, 60, "states at the first reader")
    with cyclone(domain, "--latched", "--name", "late", "--seen", found) as reader:
        return came(reader)


def test_a_reader_is_killed(network: Any) -> None:
    """The writers keep what it has not read until its lease ends; then the run goes on."""
    seen = network.directory / "seen"
    file = network.file(run={"duration": 300, "processes": 2})
    with free_domain() as domain, cyclone(domain, "--seen", seen, uri=SHORT_LEASE) as reader:
        run = network.start(
            *("run", file, "--out", network.directory / "runs", "--no-analyse", "--json"),
            *("--await", "cyclone_reader", "--domain", str(domain)),
        )
        network.wait_for(seen.exists, 60, "states at the reader")
        reader.kill()
        network.completed(run)


def test_a_stranger_is_refused(network: Any) -> None:
    what = network.experiment(run={"duration": 50, "processes": 2})
    with free_domain() as domain, cyclone(domain, "--forge") as reader:
        result = network.run(what, domain=domain, readers=["cyclone_reader"])
        came(reader)
    assert result.failures == []
    equal_to_the_twin(result.trajectory)
    refused = {(stranger["topic"].lstrip("/"), stranger["reason"]) for stranger in result.strangers}
    assert {topic for topic, _ in refused} >= {"graph", "end", "progress", "agent_1/state"}


@pytest.mark.parametrize("noise", [{}, {"link": 0.2, "delay": 1, "loss": 0.4, "on_loss": "hold"}], ids=["plain", "air"])
def test_an_agent(network: Any, noise: dict[str, Any]) -> None:
    """The example of the documentation takes part in a run in lockstep, whose bag is equal to the twin."""
    record = new_record(network.experiment(noise={"process": 1.0} | noise))
    directory: Path = network.directory
    file, bag = directory / "run.json", directory / "bag"
    file.write_text(record.to_json(with_key=True))
    with free_domain() as domain:
        environment = node_environment(domain)
        with (
            NodeServer(environment, directory / "fork_server.log") as server,
            Supervisor(directory, environment, fork_server=server) as nodes,
        ):
            nodes.start([plan for plan in plan_network(record.experiment, file, bag) if plan.name != "agent_5"])
            foreign = subprocess.run(
                [sys.executable, str(AGENT), str(file), "5"],
                env=os.environ | {"ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": UNICAST},
                timeout=100,
                check=False,
            )
            network.wait_for(lambda: not nodes.running or nodes.failures, 60, "the end of the run")
            assert (foreign.returncode, nodes.failures) == (0, [])
    equal_to_the_twin(read_bag(bag))
