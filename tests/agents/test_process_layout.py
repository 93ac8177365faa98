"""Which processes a network has, on which hosts and cores."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path
from typing import Any

import networks
import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from msg_agents.discovery.rtps import PEERS_VARIABLE, PROFILE_VARIABLES
from msg_agents.environment import DISCOVERY_TIMEOUT
from msg_agents.process_layout import (
    MOST_PROCESSES,
    MOST_UNAIDED,
    RECORDER,
    SWITCHER,
    HostAssignment,
    Hosts,
    ProcessSpec,
    assign_cores,
    count_processes,
    lay_out_network,
    partners,
    pin_to_core,
)
from msg_analysis.common.resources import available_cores
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment


def path_and_star(agents: int = 5, processes: Any = "auto") -> Experiment:
    graphs = {"path": {"path": list(range(1, agents + 1))}, "star": {"star": {"center": 1}}}
    run = {"dt": 0.001, "duration": 0.01, "start": "zero", "processes": processes}
    return networks.experiment(agents, agents=agents, graphs=graphs, run=run)


def layout(agents: int, processes: Any, bag: Path | None = Path("/bag")) -> list[ProcessSpec]:
    return lay_out_network(path_and_star(agents, processes), Path("/run.json"), bag)


def numbers(process: ProcessSpec) -> list[int]:
    """Agents as the command line names them."""
    words = process.arguments
    return [int(value) for option, value in pairwise(words) if option == "--agent"]


@given(st.integers(2, 110), st.integers(1, MOST_UNAIDED))
def test_every_agent_exactly_once(agents: int, processes: int) -> None:
    hosts = [process for process in layout(agents, processes) if process.agents]
    assert len(hosts) == min(agents, processes)
    assert [agent for host in hosts for agent in host.agents] == list(range(agents))
    assert [number for host in hosts for number in numbers(host)] == list(range(1, agents + 1))
    nodes = [node for process in layout(agents, processes) for node in process.nodes]
    assert nodes == ["recorder", *(f"agent_{agent + 1}" for agent in range(agents)), "switcher"]
    sizes = [len(host.agents) for host in hosts]
    assert max(sizes) - min(sizes) <= 1
    assert len({host.name for host in hosts}) == len(hosts)


@pytest.mark.parametrize(
    ("cores", "agents", "expected"),
    [(2, 2, 2), (2, 8, 8), (2, 9, 2), (1, 9, 1), (1, 100, 1), (8, 9, 2), (8, 100, 8), (64, 100, 13), (256, 100, 13)],
)
def test_auto(monkeypatch: pytest.MonkeyPatch, cores: int, agents: int, expected: int) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert count_processes(path_and_star(agents, "auto")) == expected
    assert count_processes(path_and_star(200, "auto")) <= MOST_PROCESSES


@pytest.mark.parametrize("most", [MOST_UNAIDED, MOST_PROCESSES])
def test_too_many_processes(most: int) -> None:
    for processes in ("one_per_agent", most + 1):
        with pytest.raises(InputError, match=rf"run\.processes: {processes} .*at most {most}"):
            lay_out_network(path_and_star(most + 1, processes), Path("/run.json"), None, most=most)
    assert len(lay_out_network(path_and_star(most, "one_per_agent"), Path("/run.json"), None, most=most)) == most + 1


def test_large_networks_are_given_time_to_find_each_other() -> None:
    def timeouts(agents: int, processes: Any) -> set[str]:
        return {
            process.arguments[process.arguments.index("--discovery-timeout") + 1]
            for process in layout(agents, processes)
            if "--discovery-timeout" in process.arguments
        }

    assert timeouts(5, "auto") == set()
    (timeout,) = timeouts(40, "one_per_agent")  # the same for all
    assert float(timeout) > DISCOVERY_TIMEOUT


def test_names_and_commands() -> None:
    processes = recorder, first, _, switcher = layout(5, 2)
    assert [each.name for each in processes] == ["recorder", "agents_1_to_2", "agents_3_to_5", "switcher"]
    assert recorder.arguments == ("recorder", "/run.json", "--out", "/bag", "--compression", "zstd")
    assert first.arguments == (*("agent", "/run.json", "--agent", "1", "--agent", "2"), *("--await", "recorder"))
    assert switcher.arguments == ("switcher", "/run.json", "--await", "recorder")
    assert [process.name for process in layout(2, "one_per_agent")][1:3] == ["agent_1", "agent_2"]


def test_without_a_bag_nobody_waits_for_a_recorder() -> None:
    processes = layout(3, "auto", bag=None)
    assert [process.name for process in processes] == ["agent_1", "agent_2", "agent_3", "switcher"]
    assert not any("--await" in process.arguments for process in processes)


@given(st.integers(2, 30), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_partners(agents: int, processes: int, seed: int) -> None:
    """Processes whose agents are neighbours in the union of both directions, and the central ones with all."""
    listens = np.random.default_rng(seed).random((agents, agents)) < 0.1
    np.fill_diagonal(listens, False)
    network = layout(agents, processes)
    found = partners(network, listens)
    of_agent = {agent: process.nodes[0] for process in network for agent in process.agents}
    graph = nx.quotient_graph(
        nx.from_numpy_array(listens | listens.T), lambda a, b: of_agent[a] == of_agent[b], relabel=False
    )
    expected = {
        of_agent[min(group)]: {of_agent[min(other)] for other in graph[group]} | {RECORDER, "switcher"}
        for group in graph.nodes
    }
    all_names = set(expected) | {RECORDER, "switcher"}
    assert found == expected | {name: all_names - {name} for name in (RECORDER, "switcher")}


def specs(agents: int, processes: int, *, recorder: bool) -> list[ProcessSpec]:
    bounds = [index * agents // processes for index in range(processes + 1)]
    parts = [tuple(range(*ends)) for ends in pairwise(bounds)]
    first = [ProcessSpec(RECORDER, ())] if recorder else []
    return [*first, *(ProcessSpec(f"p{part[0]}", (), part) for part in parts), ProcessSpec(SWITCHER, ())]


@given(st.integers(2, 16), st.integers(1, 30), st.integers(0, 70), st.booleans(), st.integers(0, 232))
def test_neighbours_share_a_core_and_cores_share_the_work(
    cores: int, processes: int, more: int, recorder: bool, first: int
) -> None:
    network = specs(processes + more, processes, recorder=recorder)
    cores_of_ours = [3 * core + 1 for core in range(cores)]  # of a machine that has given us some of its cores
    placed = assign_cores(network, cores_of_ours, first)
    assume(processes + recorder > cores)
    pinned = [spec for spec in network if spec.agents]
    assert list(placed) == [spec.name for spec in pinned]
    order = [placed[spec.name] for spec in pinned]
    assert set(order) <= set(cores_of_ours)
    changes = sum(a != b for a, b in pairwise(order))
    assert changes == len(set(order)) - 1  # whoever shares a core is next to each other
    loads = {spec.name: len(spec.agents) for spec in pinned}
    work = [sum(loads[name] for name, core in placed.items() if core == number) for number in cores_of_ours]
    assert max(work) <= sum(work) / cores + max(loads.values())


def test_the_demo_network_on_two_cores() -> None:
    network = specs(5, 5, recorder=True)
    assert assign_cores(network, list(range(6))) == assign_cores(specs(2, 2, recorder=False), [3, 4]) == {}
    assert assign_cores(network, [0, 1]) == {"p0": 0, "p1": 0, "p2": 1, "p3": 1, "p4": 1}
    assert assign_cores(network, [0, 1], first=1) == {"p0": 1, "p1": 1, "p2": 0, "p3": 0, "p4": 0}
    assert assign_cores(network, [0]) == {}
    assert assign_cores(network, []) == {}  # the system does not say


def test_a_process_and_what_it_starts_keep_to_the_core() -> None:
    core = available_cores()[-1]
    code = "import os, sys; sys.stdin.read(); os.execvp('grep', ['grep', 'Cpus_allowed_list', '/proc/self/status'])"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        pin_to_core(child.pid, core)
        output, _ = child.communicate()
    assert output.split() == [b"Cpus_allowed_list:", str(core).encode()]
    pin_to_core(child.pid, core)  # gone: nothing happens
    assert len(available_cores()) == len(os.sched_getaffinity(0))


def document(**changes: Any) -> dict[str, Any]:
    hosts = {
        "base": {"address": "192.0.2.1"},
        "left": {"address": "192.0.2.2", "agents": [4, 1]},
        "right": {"address": "192.0.2.3", "agents": ["2-3", 5]},
    }
    return {"domain": 42, "recorder": "base", "hosts": hosts, **changes}


def assignment(hosts: Hosts, name: str) -> HostAssignment:
    return hosts.assignment(name, discovery_timeout=120, peer_timeout=30)


def test_the_hosts_together_run_the_whole_network() -> None:
    hosts = Hosts.parse(document(), path_and_star())
    assert hosts.agents == {"base": (), "left": (0, 3), "right": (1, 2, 4)}
    found = {
        name: lay_out_network(path_and_star(), Path("/run.json"), Path("/bag"), assignment=assignment(hosts, name))
        for name in hosts.agents
    }
    names = {host: [process.name for process in processes] for host, processes in found.items()}
    agents = {"left": ["agent_1", "agent_4"], "right": ["agent_2", "agent_3", "agent_5"]}
    assert names == {"base": ["recorder", "switcher"], **agents}
    for process in (process for processes in found.values() for process in processes):
        assert numbers(process) == [agent + 1 for agent in process.agents]
        given = set(pairwise(process.arguments))
        assert ("--discovery-timeout", "120") in given
        assert process.name == "recorder" or {("--await", "recorder"), ("--timeout", "30")} <= given


def test_processes_count_for_each_host() -> None:
    many = path_and_star(40, 2)
    hosts = {"a": {"address": "192.0.2.1", "agents": ["1-9", 40]}, "b": {"address": "192.0.2.2", "agents": ["10-39"]}}
    found = Hosts.parse({"recorder": "a", "hosts": hosts}, many)
    assert found.domain == 0
    processes = lay_out_network(many, Path("/run.json"), None, assignment=assignment(found, "a"))
    assert [process.name for process in processes] == ["agents_1_to_5", "agents_6_and_4_more", "switcher"]
    assert found.participants(many) == 2 + 2 + 8


def test_profile() -> None:
    """Peers and lease, the rest as on one machine; and nothing that keeps other hosts out."""
    tree = ET.fromstring(Hosts.parse(document(), path_and_star()).profile(path_and_star()).encode())
    assert [found.text for found in tree.iter() if found.tag.endswith("}address")] == [
        "127.0.0.1", "192.0.2.1", "192.0.2.2", "192.0.2.3",
    ]  # fmt: skip
    texts = {found.tag.rpartition("}")[2]: found.text for found in tree.iter()}
    assert "ignoreParticipantFlags" not in texts
    assert "interfaceWhiteList" not in texts
    assert texts["maxInitialPeersRange"] == str(3 + 2 + 8)
    assert texts["receiveBufferSize"] == "4194304"
    lease = next(found for found in tree.iter() if found.tag.endswith("}leaseDuration"))
    assert [child.text for child in lease] == ["60"]


@pytest.mark.parametrize("own", [None, *PROFILE_VARIABLES])
def test_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str | None) -> None:
    for name in (*PROFILE_VARIABLES, "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.delenv(name, raising=False)
    if own:
        monkeypatch.setenv(own, "/mine.xml")
    environment = Hosts.parse(document(), path_and_star()).environment(path_and_star(), tmp_path)
    assert environment["ROS_DOMAIN_ID"] == "42"
    assert environment[PEERS_VARIABLE].split() == ["192.0.2.1", "192.0.2.2", "192.0.2.3"]
    assert environment[own or PROFILE_VARIABLES[-1]] == ("/mine.xml" if own else str(tmp_path / "hosts.xml"))


HOSTS = document()["hosts"]


def with_host(name: str, **host: Any) -> dict[str, Any]:
    return document(hosts=HOSTS | {name: host})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ([1], "expected the keys domain, recorder and hosts"),
        (document(recorder="bass"), "recorder: bass: expected one of the hosts, base, left, right"),
        ({"hosts": HOSTS}, "recorder: missing: expected the host that records"),
        (document(domain=500), "domain: 500: expected a number <= 231"),
        (document(host={}), "host: unknown key: expected one of domain, recorder, hosts: did you mean 'hosts'?"),
        (with_host("left", agents=[1, 4]), "hosts.left.address: missing"),
        (
            with_host("left", address="192.0.2.2", agents=["4-1"]),
            'hosts.left.agents: ["4-1"]: expected a list of numbers of agents, from 1, and of ranges such as 3-5',
        ),
        (with_host("base", address="192.0.2.1", agents=[6]), "agents: [6]: expected numbers from 1 to 5"),
        (with_host("base", address="192.0.2.1", agents=[2]), "agents: [2]: expected each agent once: 2 is on base and"),
        (document(hosts={name: HOSTS[name] for name in ("base", "left")}), "agents: [2, 3, 5]: on no host"),
        (with_host("base", address="192.0.2.3"), "hosts.right.address: 192.0.2.3: duplicate address"),
        (with_host("base", address="300.0.2.1"), "hosts.base.address: 300.0.2.1: expected an IPv4 address"),
    ],
    ids=range(12),
)  # fmt: skip
def test_mistakes(wrong: Any, said: str) -> None:
    with pytest.raises(InputError) as error:
        Hosts.parse(wrong, path_and_star(), source="hosts.yaml")
    assert str(error.value).startswith("hosts.yaml: ")
    assert said in str(error.value)


def test_a_host_that_there_is_not() -> None:
    hosts = Hosts.parse(document(), path_and_star())
    with pytest.raises(InputError, match="--name: centre: no such host in the hosts file: expected one of base, left"):
        assignment(hosts, "centre")
    idle = Hosts.parse(document(recorder="left"), path_and_star())
    with pytest.raises(InputError, match="--name: base: has no agents and is not the recorder"):
        assignment(idle, "base")
