# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Which processes a run has, on which hosts and cores.

On several hosts, each runs its part of the same layout, from the same run record. The processes find each other at the
addresses in the hosts file, without multicast, which routers, access points and bridges often do not pass on.
"""

from __future__ import annotations

import math
import os
import re
import socket
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from msg_agents.discovery.rtps import MOST_PARTICIPANTS, PEERS_VARIABLE, profile_for_hosts
from msg_agents.environment import DISCOVERY_TIMEOUT, LAST_DOMAIN, USER_TIMEOUT, node_environment
from msg_analysis.bags.stored_file import DEFAULT_STORAGE, MEGABYTE, Storage
from msg_analysis.common.arrays import BoolArray
from msg_analysis.common.resources import count_cores
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.loading import read_yaml
from msg_analysis.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.experiment.values import expected
from msg_analysis.messages.topics import agent_node_name

RECORDER, SWITCHER, CHANNEL = "recorder", "switcher", "channel"
SMALL = 8  # agents that each have a process by ``processes: auto``; of more, so many share one, or more on few cores
MOST_PROCESSES = 200  # of agents, which the relay connects: with all others they fill the ports of two ROS domains
MOST_UNAIDED = 90  # of agents, which look for each other: some of the ``MOST_PARTICIPANTS`` of Fast DDS are others
GRACE = 15.0  # s that agents wait for external ones longer than the switcher does
SPARE_PARTICIPANTS = 8  # participants on a host besides those of the run, such as tools that watch it
Spec = TypeVar("Spec", bound=BaseModel)
_RANGE = re.compile(r"([0-9]+)-([0-9]+)")


class Process(Protocol):
    """A started process: what ``subprocess.Popen`` and ``ForkedProcess`` have in common."""

    @property
    def pid(self) -> int:
        """Its number."""

    def poll(self) -> int | None:
        """Its exit code, or minus the signal that killed it; None while it runs."""

    def wait(self) -> int:
        """The same, once it has ended."""

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended."""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process of a network."""

    name: str
    arguments: tuple[str, ...]  # of the command ``msg-agents``
    agents: tuple[int, ...] = ()  # indices from 0
    resumes: bool = False  # whether the same command takes over after the process was killed
    external: bool = False  # whether it stands in for a robot of the user

    @property
    def nodes(self) -> list[str]:
        """Names of its nodes."""
        return [agent_node_name(agent) for agent in self.agents] or [self.name]


@dataclass(frozen=True, slots=True)
class HostAssignment:
    """What one host runs of a network that is spread over several hosts."""

    agents: tuple[int, ...]  # indices from 0, ascending
    has_recorder: bool  # and the switcher
    discovery_timeout: float  # s for which nodes look for those of other hosts, which the user starts
    peer_timeout: float  # s that other nodes may be gone before a node ends itself


def wanted_processes(experiment: Experiment, agents: int) -> int:
    """Most processes that an experiment may have for so many agents, on a machine of any number of cores."""
    wanted = experiment.run.processes
    return min(agents, wanted) if isinstance(wanted, int) else agents


def count_processes(experiment: Experiment, agents: int | None = None, *, most: int = MOST_UNAIDED) -> int:
    """Number of processes for ``agents`` agents (None: all) on this machine; InputError: more than ``most``."""
    agents = experiment.agents if agents is None else agents
    wanted, count = experiment.run.processes, wanted_processes(experiment, agents)
    if wanted == "auto" and agents > SMALL:
        # A message to another process costs more than the step it is for: no more processes than can run at once.
        return min(math.ceil(agents / SMALL), most, count_cores())
    if count > most:
        raise InputError(
            f"run.processes: {wanted} ({count} processes): expected at most {most}, because discovery on one machine "
            "finds no more participants: give a smaller number, several agents share a process"
        )
    return count


def split_agents(
    experiment: Experiment, agents: Sequence[int] | None = None, *, most: int = MOST_UNAIDED
) -> list[tuple[int, ...]]:
    """The agents (indices, ascending; None: all) of each process; InputError: more than ``most`` processes."""
    agents = range(experiment.agents) if agents is None else agents
    count = count_processes(experiment, len(agents), most=most)
    # Consecutive agents share a process: in most graphs they are neighbours, and their messages stay inside.
    return [tuple(agents[i * len(agents) // count : (i + 1) * len(agents) // count]) for i in range(count)]


def process_name(agents: Sequence[int]) -> str:
    """The name of a process with these agents (indices, ascending)."""
    first, last = agents[0] + 1, agents[-1] + 1
    rest = f"to_{last}" if last - first == len(agents) - 1 else f"and_{len(agents) - 1}_more"
    return f"agent_{first}" if first == last else f"agents_{first}_{rest}"


def lay_out_network(
    experiment: Experiment,
    run_file: Path,  # run record, read by every node
    bag: Path | None,  # directory to record to; None: no recorder
    checkpoints: Path | None = None,  # directory of the states for a takeover; None: killed processes cannot resume
    *,
    use_sim_time: bool = False,
    parameter_services: bool = False,
    storage: Storage = DEFAULT_STORAGE,
    assignment: HostAssignment | None = None,
    readers: Sequence[str] = (),  # nodes that the user starts, and that must read the topics before the run starts
    most: int = MOST_UNAIDED,
    hosts: Sequence[Sequence[int]] = (),  # agents of each host of a channel: a process is on one; empty: no channel
    robots: Path | None = None,  # map of the external agents, for which processes stand in; None: the user starts them
    external_timeout: float = USER_TIMEOUT,  # s that external agents have to come
) -> list[ProcessSpec]:
    """The processes of a run, or of this host, in the order of their starts; InputError: too many with agents."""
    external = experiment.external
    there = range(experiment.agents) if assignment is None else assignment.agents
    here = [agent for agent in there if agent not in external]
    groups = [group for part in hosts or [here] for group in split_agents(experiment, part, most=most)]
    count = len(groups)
    if count > most:
        raise InputError(f"run.processes: {count} processes on all hosts: expected at most {most}: give fewer")
    common: tuple[str, ...] = ("--use-sim-time",) if use_sim_time else ()
    if parameter_services:
        common += ("--parameter-services",)
    # The first process waits for the last one: two or more start per second, and many endpoints take longer to find.
    needed = max(DISCOVERY_TIMEOUT, 2.0 * count + 0.1 * experiment.agents)
    timeout = needed if assignment is None else assignment.discovery_timeout
    if readers or hosts:  # what a channel loses is sent again
        timeout = max(timeout, USER_TIMEOUT)
    if external and assignment is None:
        timeout = max(timeout, external_timeout + GRACE)  # the switcher knows all that are missing, and says it first
    if timeout != DISCOVERY_TIMEOUT:
        common += ("--discovery-timeout", f"{timeout:g}")
    awaited = ([RECORDER] if bag is not None or assignment is not None else []) + list(readers)
    options = common + tuple(part for name in awaited for part in ("--await", name))
    if checkpoints is not None:
        options += ("--checkpoint", str(checkpoints))
    if assignment is not None:
        options += ("--timeout", f"{assignment.peer_timeout:g}")
    resumes = checkpoints is not None
    central = assignment is None or assignment.has_recorder
    processes = []
    if bag is not None and central:
        files: tuple[str, ...] = ("--compression", storage.compression)
        if storage.split_size is not None:
            files += ("--split-size", repr(storage.split_size / MEGABYTE))
        processes.append(ProcessSpec(RECORDER, ("recorder", str(run_file), "--out", str(bag), *files, *common)))
    for agents in groups:
        numbers = [part for agent in agents for part in ("--agent", str(agent + 1))]
        arguments = ("agent", str(run_file), *numbers, *options)
        processes.append(ProcessSpec(process_name(agents), arguments, agents, resumes))
    for agent in sorted(external) if robots else ():
        arguments = ("external", str(run_file), "--agent", str(agent + 1), "--map", str(robots), *options)
        processes.append(ProcessSpec(process_name([agent]), arguments, (agent,), external=True))
    if central:
        if external and assignment is None:
            options += ("--discovery-timeout", f"{external_timeout:g}")
        processes.append(ProcessSpec(SWITCHER, ("switcher", str(run_file), *options), resumes=resumes))
    return processes


def partners(processes: Sequence[ProcessSpec], listens: BoolArray) -> dict[str, set[str]]:
    """First nodes of the processes that each exchanges messages with; ``listens``: (m, m), whether i ever hears j."""
    exchanges = listens | listens.T
    names = {process.nodes[0] for process in processes}
    of_agent = {agent: process.nodes[0] for process in processes for agent in process.agents}
    central = {process.nodes[0] for process in processes if not process.agents}  # exchange messages with all
    found = {}
    for process in processes:
        heard = {int(j) for i in process.agents for j in exchanges[i].nonzero()[0]}
        peers = {of_agent[j] for j in heard if j in of_agent}  # the user may have started the others
        found[process.nodes[0]] = (peers | central if process.agents else names) - {process.nodes[0]}
    return found


def assign_cores(processes: Sequence[ProcessSpec], cores: Sequence[int], first: int = 0) -> dict[str, int]:
    """A core for each agent process by name, where they and the recorder outnumber two or more cores; else empty."""
    # In lockstep every message wakes the process that receives it. To wake it on another core costs an interrupt there,
    # and without pinning the scheduler spreads communicating processes over the cores: with two cores, the demo network
    # makes a third to a half fewer steps per second (docs/performance.md). Networks with successive values of ``first``
    # begin at different cores, and so share them evenly. The recorder gets no core: agents wait for each other, so a
    # core that it slows down holds up the others, which then are idle; the scheduler moves it there. The switcher needs
    # hardly any time.
    loads = {process.name: len(process.agents) for process in processes if process.agents}
    recorded = any(process.name == RECORDER for process in processes)
    if len(cores) < 2 or len(loads) + recorded <= len(cores):
        return {}
    total = sum(loads.values())
    ends = accumulate(loads.values())
    middles = {name: end - load / 2 for (name, load), end in zip(loads.items(), ends, strict=True)}
    return {name: cores[(first + int(middle / total * len(cores))) % len(cores)] for name, middle in middles.items()}


def pin_to_core(process: int, core: int) -> None:
    """Pin a process that has just been started, and its children, to a core; errors are ignored."""
    try:
        os.sched_setaffinity(process, {core})
    except OSError:  # it has ended already, or the core has been taken from us
        return


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
        if last - first >= 1_000_000:  # a slip, which would take all memory
            raise wanted
        numbers.extend(range(first, last + 1))
    return numbers


class HostSpec(BaseModel):
    """One host in the hosts file."""

    model_config = ConfigDict(extra="forbid")
    address: str = Field(
        min_length=1, description="the address at which the other hosts reach this one", examples=["192.0.2.1"]
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


def validated(kind: type[Spec], document: Any, source: str, keys: str) -> Spec:
    """A document as such a model; the ExperimentError lists the mistakes, or says which ``keys`` are expected."""
    if not isinstance(document, dict):
        raise ExperimentError(source, [keys])
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        raise ExperimentError(source, [translate(each, root=kind) for each in error.errors()]) from error


@dataclass(frozen=True, slots=True)
class Hosts:
    """A hosts file that fits an experiment."""

    domain: int  # ROS_DOMAIN_ID
    recorder: str  # name of the host with recorder and switcher
    addresses: dict[str, str]  # IPv4 addresses by host
    agents: dict[str, tuple[int, ...]]  # indices from 0, ascending, by host

    @classmethod
    def load(cls, path: Path, experiment: Experiment) -> Hosts:
        """Read a hosts file (YAML); InputError if it cannot be read or does not fit the experiment."""
        return cls.parse(read_yaml(path), experiment, source=str(path))

    @classmethod
    def parse(cls, document: Any, experiment: Experiment, source: str = "hosts") -> Hosts:
        """Check a document from a YAML reader; the ExperimentError lists the mistakes, with ``source`` as place."""
        keys = "expected the keys domain, recorder and hosts: see `msg-agents host --help`"
        spec = validated(HostsSpec, document, source, keys)
        listed = {name: host.agents for name, host in spec.hosts.items()}
        problems = assignment_problems(listed, experiment.agents, experiment.external)
        if spec.recorder not in spec.hosts:
            wanted = f"expected one of the hosts, {', '.join(spec.hosts)}"
            problems.insert(0, problem("recorder", spec.recorder, wanted, "name one of them"))
        addresses: dict[str, str] = {}
        for name, host in spec.hosts.items():
            try:
                addresses[name] = socket.gethostbyname(host.address)
            except (OSError, UnicodeError) as error:
                reason = getattr(error, "strerror", None) or "no such address"
                wanted = f"expected an IPv4 address or a name that has one ({reason})"
                problems.append(problem(f"hosts.{name}.address", host.address, wanted, "give it as numbers"))
        problems += [
            problem(f"hosts.{name}.address", address, "duplicate address", "give each host its own")
            for place, (name, address) in enumerate(addresses.items())
            if address in list(addresses.values())[:place]
        ]
        if problems:
            raise ExperimentError(source, problems)
        agents = {name: tuple(sorted(number - 1 for number in host.agents)) for name, host in spec.hosts.items()}
        return cls(spec.domain, spec.recorder, addresses, agents)

    def assignment(self, name: str, discovery_timeout: float, peer_timeout: float) -> HostAssignment:
        """What runs on the host ``name``; times in s. InputError: no such host, or nothing to do on it."""
        if name not in self.agents:
            known = ", ".join(self.agents)
            raise InputError(f"--name: {name}: no such host in the hosts file: expected one of {known}")
        if not self.agents[name] and name != self.recorder:
            raise InputError(f"--name: {name}: has no agents and is not the recorder: there is nothing to run on it")
        return HostAssignment(self.agents[name], name == self.recorder, discovery_timeout, peer_timeout)

    def participants(self, experiment: Experiment) -> int:
        """How many participants to look for on each host: more than run on any."""
        most = max(wanted_processes(experiment, len(agents)) for agents in self.agents.values())
        return min(most + 2 + SPARE_PARTICIPANTS, MOST_PARTICIPANTS)

    def profile(self, experiment: Experiment) -> str:
        """The Fast DDS profile with which the processes of all hosts find each other."""
        addresses = list(dict.fromkeys(("127.0.0.1", *self.addresses.values())))
        return profile_for_hosts(addresses, self.participants(experiment))

    def environment(self, experiment: Experiment, folder: Path) -> dict[str, str]:
        """Environment of the processes, with the profile written to ``folder``; the user's own profile is kept."""
        profile = folder / "hosts.xml"
        profile.write_text(self.profile(experiment), encoding="utf-8")
        others = [address for address in self.addresses.values() if address != "127.0.0.1"]
        return node_environment(self.domain, profile) | {PEERS_VARIABLE: " ".join(others)}


def assignment_problems(hosts: Mapping[str, Sequence[int]], agents: int, external: Collection[int] = ()) -> list[str]:
    """Mistakes in the numbers of the agents on each host, of so many agents; ``external`` (from 0) are on none."""
    problems = []
    where: dict[int, list[str]] = {}
    for name, numbers in hosts.items():
        for number in numbers:
            where.setdefault(number, []).append(name)
    unknown = sorted(number for number in where if number > agents)
    if unknown:
        problems.append(problem("agents", show(unknown), f"expected numbers from 1 to {agents}", "remove the others"))
    twice = {number: names for number, names in where.items() if len(names) > 1}
    if twice:
        both = f"{min(twice)} is on {' and '.join(twice[min(twice)])}"
        problems.append(problem("agents", show(sorted(twice)), "expected each agent once", both))
    if ours := sorted(number for number in where if number - 1 in external):
        problems.append(problem("agents", show(ours), "expected no external agents", "remove them: you start these"))
    missing = [number for number in range(1, agents + 1) if number not in where and number - 1 not in external]
    if missing:
        problems.append(problem("agents", show(missing), "on no host", "name each agent on one"))
    return problems
