"""The hosts file, the plan of a host's share, and the profile by which the hosts find each other."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from msg_agents.discovery.rtps import PEERS_VARIABLE, PROFILE_VARIABLES
from msg_agents.process_layout import Hosts, Share, lay_out_network
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment


def experiment(agents: int = 5, processes: Any = "auto") -> Experiment:
    return Experiment.parse(
        {
            "name": "spread",
            "problem": "consensus",
            "time": "continuous",
            "agents": agents,
            "graphs": {"path": {"path": list(range(1, agents + 1))}, "star": {"star": {"center": 1}}},
            "switching": {"generator": [[-1, 1], [1, -1]]},
            "run": {"dt": 0.001, "duration": 0.01, "start": "zero", "processes": processes},
        }
    )


def document(**changes: Any) -> dict[str, Any]:
    hosts = {
        "base": {"address": "192.0.2.1"},
        "left": {"address": "192.0.2.2", "agents": [4, 1]},
        "right": {"address": "192.0.2.3", "agents": ["2-3", 5]},
    }
    return {"domain": 42, "recorder": "base", "hosts": hosts, **changes}


def share(hosts: Hosts, name: str) -> Share:
    return hosts.share(name, discovery_timeout=120, patience=30)


def numbers(arguments: tuple[str, ...]) -> list[int]:
    return [int(value) for option, value in pairwise(arguments) if option == "--agent"]


def test_the_shares_are_the_whole() -> None:
    hosts = Hosts.parse(document(), experiment())
    assert hosts.agents == {"base": (), "left": (0, 3), "right": (1, 2, 4)}
    plans = {
        name: lay_out_network(experiment(), Path("/run.json"), Path("/bag"), share=share(hosts, name))
        for name in hosts.agents
    }
    names = {host: [process.name for process in processes] for host, processes in plans.items()}
    assert names == {
        "base": ["recorder", "switcher"],
        "left": ["agent_1", "agent_4"],
        "right": ["agent_2", "agent_3", "agent_5"],
    }
    for process in (process for processes in plans.values() for process in processes):
        assert numbers(process.arguments) == [agent + 1 for agent in process.agents]
        assert ("--discovery-timeout", "120") in pairwise(process.arguments)
        assert process.name == "recorder" or ("--await", "recorder") in pairwise(process.arguments)
        assert process.name == "recorder" or ("--patience", "30") in pairwise(process.arguments)


def test_processes_count_for_each_host() -> None:
    many = experiment(40, 2)
    hosts = {"a": {"address": "192.0.2.1", "agents": ["1-9", 40]}, "b": {"address": "192.0.2.2", "agents": ["10-39"]}}
    found = Hosts.parse({"recorder": "a", "hosts": hosts}, many)
    assert found.domain == 0
    processes = lay_out_network(many, Path("/run.json"), None, share=share(found, "a"))
    assert [process.name for process in processes] == ["agents_1_to_5", "agents_6_and_4_more", "switcher"]
    assert found.participants(many) == 2 + 2 + 8


def test_profile() -> None:
    """Peers and lease, the rest as on one machine; and nothing that keeps other hosts out."""
    tree = ET.fromstring(Hosts.parse(document(), experiment()).profile(experiment()).encode())
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
    environment = Hosts.parse(document(), experiment()).environment(experiment(), tmp_path)
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
        Hosts.parse(wrong, experiment(), source="hosts.yaml")
    assert str(error.value).startswith("hosts.yaml: ")
    assert said in str(error.value)


def test_a_host_that_there_is_not() -> None:
    hosts = Hosts.parse(document(), experiment())
    with pytest.raises(InputError, match="--name: centre: no such host in the hosts file: expected one of base, left"):
        share(hosts, "centre")
    idle = Hosts.parse(document(recorder="left"), experiment())
    with pytest.raises(InputError, match="--name: base: has no agents and is not the recorder"):
        share(idle, "base")
