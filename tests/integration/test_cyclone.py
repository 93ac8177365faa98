"""Cyclone DDS, another vendor's middleware, beside a run: as a reader, as a foreign node, and as one of its agents."""

import json
import os
import subprocess
import sys
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from networks import assert_equal_to_twin

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.process_layout import lay_out_network
from msg_agents.run.fork_server import ForkServer
from msg_agents.run.supervisor import Supervisor
from msg_analysis.bags.reading import read_bag
from msg_analysis.model.run import Run
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


def states_of(trajectory: Run, agent: int) -> list[list[int]]:
    """Step, mode and checksum of every state, as in the bag."""
    modes = [0, *(int(mode) + 1 for mode in trajectory.modes)]
    values = np.ascontiguousarray(trajectory.values[:, agent])
    return [[k, modes[k], zlib.crc32(value.tobytes())] for k, value in enumerate(values)]


def once(states: list[list[int]]) -> list[list[int]]:
    """Without those that came again: on a busy machine an agent that waits for 5 s asks its peers for their states."""
    return [list(state) for state in dict.fromkeys(map(tuple, states))]


def test_readers_that_were_there_first_get_everything(network: Any) -> None:
    """One that is fast, and a slow one, which holds the run back: nothing is lost."""
    what = network.experiment()
    pauses = {"fast": "0", "slow": "0.001"}
    with free_domain() as domain, ExitStack() as stack:
        readers = {
            name: stack.enter_context(cyclone(domain, "--name", name, "--pause", pause))
            for name, pause in pauses.items()
        }
        result = network.run(what, domain=domain, readers=list(readers))
        came_to = {name: came(reader) for name, reader in readers.items()}
    assert result.rejected_messages == []
    assert_equal_to_twin(result.trajectory)
    asked = any("no step for" in log.read_text() for log in (result.bag / "log").iterdir())
    for found in came_to.values():
        for agent in range(5):
            states = found[f"agent_{agent + 1}/state"]
            assert (once(states) if asked else states) == states_of(result.trajectory, agent)
        (record,) = found["experiment"]
        assert json.loads(record)["run"] == str(result.trajectory.record.run)
        assert [sequence for sequence, _, _ in found["graph"]] == list(range(len(found["graph"])))
        assert found["graph"][-1][2] == what.steps - 1
        assert {agent for agent, _ in found["progress"]} >= {1, 2, 3, 4, 5}
        assert found["end"] == [[0, what.steps]]


def test_a_reader_comes_late_and_another_one_is_killed(network: Any) -> None:
    """The late one gets every holding period from the first on, in the middle of a run that the first one holds back.

    Then that one is killed: the writers keep what it has not read until its lease ends, and the run goes on.
    """
    begun, found = network.directory / "begun", network.directory / "found"
    file = network.file(run={"duration": 300, "processes": 2})
    with free_domain() as domain, cyclone(domain, "--seen", begun, "--until", found, uri=SHORT_LEASE) as first:
        run = network.record(file, "--json", "--await", "cyclone_reader", "--domain", str(domain))
        network.wait_for(begun.exists, 60, "states at the first reader")
        with cyclone(domain, "--latched", "--name", "late", "--seen", found) as late:
            network.wait_for(found.exists, 60, "the run record at the late reader")
            first.kill()
            result = network.completed(run)
            came_late = came(late)
    trajectory = read_bag(result["bag"])
    (record,) = came_late["experiment"]
    assert json.loads(record)["run"] == str(trajectory.record.run)
    graphs, steps = came_late["graph"], trajectory.record.experiment.steps
    assert [first for _, first, _ in graphs] == [0, *(last + 1 for _, _, last in graphs[:-1])]
    assert (graphs[-1][2], came_late["end"]) == (steps - 1, [[0, steps]])


def test_a_foreign_node_is_refused(network: Any) -> None:
    what = network.experiment(run={"duration": 50, "processes": 2})
    with free_domain() as domain, cyclone(domain, "--forge") as reader:
        result = network.run(what, domain=domain, readers=["cyclone_reader"])
        came(reader)
    assert_equal_to_twin(result.trajectory)
    refused = {(entry["topic"].lstrip("/"), entry["reason"]) for entry in result.rejected_messages}
    assert {topic for topic, _ in refused} >= {"graph", "end", "progress", "agent_1/state"}


@pytest.mark.parametrize("noise", [{}, {"link": 0.2, "delay": 1, "loss": 0.4, "on_loss": "hold"}], ids=["plain", "air"])
def test_an_agent(network: Any, noise: dict[str, Any]) -> None:
    """The example of the documentation takes part in a run in lockstep, whose bag is equal to the twin."""
    graphs = {"line": {"path": [1, 2, 3]}, "ring": {"cycle": [1, 2, 3]}}
    record = new_record(network.experiment(graphs=graphs, noise={"process": 1.0} | noise))
    directory: Path = network.directory
    file, bag = directory / "run.json", directory / "bag"
    file.write_text(record.to_json(with_key=True))
    with free_domain() as domain:
        environment = node_environment(domain)
        with (
            ForkServer(environment, directory / "fork_server.log") as server,
            Supervisor(directory, environment, fork_server=server) as nodes,
        ):
            nodes.start([spec for spec in lay_out_network(record.experiment, file, bag) if spec.name != "agent_3"])
            foreign = subprocess.run(
                [sys.executable, str(AGENT), str(file), "3"],
                env=os.environ | {"ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": UNICAST},
                timeout=100,
                check=False,
            )
            network.wait_for(lambda: not nodes.running or nodes.failures, 60, "the end of the run")
            assert (foreign.returncode, nodes.failures) == (0, [])
    assert_equal_to_twin(read_bag(bag))
