# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A network spread over several hosts: which agents are where, and how the processes find each other.

Every host runs its share of the same plan, from the same run record. The processes find each other at the addresses
in the hosts file, without multicast, which routers, access points and bridges often do not pass on.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from msg_agents.discovery.profiles import MOST_PARTICIPANTS, profile_for_hosts
from msg_agents.discovery.rtps import PEERS_VARIABLE
from msg_agents.processes.environment import LAST_DOMAIN, node_environment
from msg_agents.processes.process_plan import Share, wanted_processes
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.model.experiment.yaml_document import read_yaml
from msg_analysis.model.spec.values import expected

VISITORS = 8  # participants on a host besides those of the run, such as tools that watch it
_RANGE = re.compile(r"([0-9]+)-([0-9]+)")


def agent_numbers(value: object) -> list[int]:
    """Agent numbers from a list of numbers and of ranges."""
    wanted = expected("a list of numbers of agents, from 1, and of ranges such as 3-5")
    if not isinstance(value, list):
        raise wanted
    numbers: list[int] = []
    for entry in value:
        found = _RANGE.fullmatch(entry) if isinstance(entry, str) else None
        first, last = (int(found[1]), int(found[2])) if found else (entry, entry)
        if not isinstance(first, int) or isinstance(first, bool) or not 1 <= first <= last < 2**32:
            raise wanted
        if last - first >= 1_000_000:
            raise wanted
        numbers.extend(range(first, last + 1))
    return numbers


class HostSpec(BaseModel):
    """One host in the hosts file."""

    model_config = ConfigDict(extra="forbid")
    address: str = Field(
        min_length=1,
        description="the address at which the other hosts reach this one",
        examples=["192.0.2.1"],
    )
    agents: Annotated[list[int], BeforeValidator(agent_numbers)] = Field(
        default=[], description="the agents that run there", examples=[[1, "3-5"]]
    )


class HostsSpec(BaseModel):
    """The hosts file as data."""

    model_config = ConfigDict(extra="forbid")
    domain: int = Field(0, strict=True, ge=0, le=LAST_DOMAIN, description="ROS_DOMAIN_ID of the run", examples=[42])
    recorder: str = Field(description="the host that records, and that has the switcher", examples=["lab1"])
    hosts: dict[str, HostSpec] = Field(
        min_length=1, description="the hosts, by name", examples=[{"lab1": {"address": "192.0.2.1", "agents": ["1-5"]}}]
    )


@dataclass(frozen=True, slots=True)
class Hosts:
    """A hosts file that fits an experiment."""

    domain: int  # ROS_DOMAIN_ID
    recorder: str  # name of the host with recorder and switcher
    addresses: dict[str, str]  # IPv4 addresses by host
    agents: dict[str, tuple[int, ...]]  # indices from 0, ascending, by host

    @classmethod
    def load(cls, path: Path, experiment: ValidExperiment) -> Hosts:
        """Read a hosts file (YAML); InputError if it cannot be read or does not fit the experiment."""
        return cls.parse(read_yaml(path), experiment, source=str(path))

    @classmethod
    def parse(cls, document: Any, experiment: ValidExperiment, source: str = "hosts") -> Hosts:
        """Check a document from a YAML reader; the ExperimentError lists the mistakes, with ``source`` as place."""
        if not isinstance(document, dict):
            raise ExperimentError(
                source, ["expected the keys domain, recorder and hosts: see `msg-agents host --help`"]
            )
        try:
            spec = HostsSpec.model_validate(document)
        except ValidationError as error:
            problems = [translate(each, root=HostsSpec) for each in error.errors()]
            raise ExperimentError(source, problems) from error
        problems = _mistakes(spec, experiment.agents)
        addresses: dict[str, str] = {}
        for name, host in spec.hosts.items():
            try:
                addresses[name] = socket.gethostbyname(host.address)
            except (OSError, UnicodeError) as error:
                reason = getattr(error, "strerror", None) or "no such address"
                problems.append(
                    problem(
                        f"hosts.{name}.address",
                        host.address,
                        f"expected an IPv4 address or a name that has one ({reason})",
                        "give it as numbers",
                    )
                )
        problems += [
            problem(f"hosts.{name}.address", address, "duplicate address", "give each host its own")
            for place, (name, address) in enumerate(addresses.items())
            if address in list(addresses.values())[:place]
        ]
        if problems:
            raise ExperimentError(source, problems)
        agents = {name: tuple(sorted(number - 1 for number in host.agents)) for name, host in spec.hosts.items()}
        return cls(spec.domain, spec.recorder, addresses, agents)

    def share(self, name: str, *, discovery_timeout: float, patience: float) -> Share:
        """What runs on the host ``name``; times in s. InputError: no such host, or nothing to do on it."""
        if name not in self.agents:
            known = ", ".join(self.agents)
            raise InputError(f"--name: {name}: no such host in the hosts file: expected one of {known}")
        if not self.agents[name] and name != self.recorder:
            raise InputError(f"--name: {name}: has no agents and is not the recorder: there is nothing to run on it")
        return Share(self.agents[name], name == self.recorder, discovery_timeout, patience)

    def participants(self, experiment: ValidExperiment) -> int:
        """How many participants to look for on each host: more than run on any."""
        most = max(wanted_processes(experiment, len(agents)) for agents in self.agents.values())
        return min(most + 2 + VISITORS, MOST_PARTICIPANTS)

    def profile(self, experiment: ValidExperiment) -> str:
        """The Fast DDS profile with which the processes of all hosts find each other."""
        addresses = list(dict.fromkeys(("127.0.0.1", *self.addresses.values())))
        return profile_for_hosts(addresses, self.participants(experiment))

    def environment(self, experiment: ValidExperiment, folder: Path) -> dict[str, str]:
        """Environment of the processes, with the profile written to ``folder``; the user's own profile is kept."""
        profile = folder / "hosts.xml"
        profile.write_text(self.profile(experiment), encoding="utf-8")
        others = [address for address in self.addresses.values() if address != "127.0.0.1"]
        return node_environment(self.domain, profile) | {PEERS_VARIABLE: " ".join(others)}


def _mistakes(spec: HostsSpec, agents: int) -> list[str]:
    """Mistakes in the assignment of agents and recorder to hosts."""
    problems = []
    if spec.recorder not in spec.hosts:
        names = ", ".join(spec.hosts)
        problems.append(problem("recorder", spec.recorder, f"expected one of the hosts, {names}", "name one of them"))
    return problems + assignment_problems({name: host.agents for name, host in spec.hosts.items()}, agents)


def assignment_problems(hosts: Mapping[str, Sequence[int]], agents: int) -> list[str]:
    """Mistakes in the numbers of the agents on each host, of an experiment with so many agents."""
    problems = []
    where: dict[int, list[str]] = {}
    for name, numbers in hosts.items():
        for number in numbers:
            where.setdefault(number, []).append(name)
    unknown = sorted(number for number in where if number > agents)
    if unknown:
        problems.append(
            problem("agents", _listed(unknown), f"expected numbers from 1 to {agents}", "remove the others")
        )
    twice = {number: names for number, names in where.items() if len(names) > 1}
    if twice:
        number = min(twice)
        problems.append(
            problem(
                "agents",
                _listed(sorted(twice)),
                "expected each agent once",
                f"{number} is on {' and '.join(twice[number])}",
            )
        )
    missing = [number for number in range(1, agents + 1) if number not in where]
    if missing:
        problems.append(problem("agents", _listed(missing), "on no host", "name each agent on one"))
    return problems


def _listed(numbers: Sequence[int]) -> str:
    return show(list(numbers))


def this_host() -> str:
    """Host name of this machine."""
    return socket.gethostname()
