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

"""The plan of a network: which nodes run in which processes. The runner and the launch files both use it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from msg_agents.processes.environment import DISCOVERY_TIMEOUT, USER_TIMEOUT
from msg_analysis.bags.format.storage_options import DEFAULT_STORAGE, MEGABYTE, Storage
from msg_analysis.common.cores import count_cores
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.types import BoolArray
from msg_analysis.wire.topics import agent_name

RECORDER, SWITCHER, CHANNEL = "recorder", "switcher", "channel"
SMALL = 8
"""Of ``processes: auto``: up to so many agents, each has a process of its own; beyond, there is one process per so many
agents, but not more than the machine has cores."""
MOST_PROCESSES = 200
"""Agent processes that ``Introducer`` introduces to each other, which with switcher, recorder and the user's own tools
fill the ports of two ROS domains."""
MOST_UNAIDED = 90
"""Agent processes that look for each other: Fast DDS finds ``MOST_PARTICIPANTS``, of which some are for others."""


@dataclass(frozen=True, slots=True)
class ProcessPlan:
    """One process of a network."""

    name: str
    arguments: tuple[str, ...]  # of the command ``msg-agents``
    agents: tuple[int, ...] = ()  # indices from 0
    resumes: bool = False  # whether the same command takes over after the process was killed

    @property
    def nodes(self) -> list[str]:
        """Names of its nodes."""
        return [agent_name(agent) for agent in self.agents] or [self.name]

    @property
    def first_node(self) -> str:
        """Name of its first node."""
        return self.nodes[0]


@dataclass(frozen=True, slots=True)
class Share:
    """What one host runs of a network that is spread over several hosts."""

    agents: tuple[int, ...]  # indices from 0, ascending
    home: bool  # whether recorder and switcher run here
    discovery_timeout: float  # s for which nodes look for those of other hosts, which the user starts
    patience: float  # s that companions may be gone before a node ends itself


def wanted_processes(experiment: ValidExperiment, agents: int) -> int:
    """Most processes that an experiment may have for so many agents, on a machine of any number of cores."""
    wanted = experiment.run.processes
    return min(agents, wanted) if isinstance(wanted, int) else agents


def count_processes(experiment: ValidExperiment, agents: int | None = None, *, most: int = MOST_UNAIDED) -> int:
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
    experiment: ValidExperiment, agents: Sequence[int] | None = None, *, most: int = MOST_UNAIDED
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


def discovery_timeout(agents: int, processes: int) -> float:
    """Seconds after which a node of a network of so many agents and processes gives up on the missing ones.

    The first process waits for the last one: two or more start per second, and many endpoints take longer to discover.
    """
    return max(DISCOVERY_TIMEOUT, 2.0 * processes + 0.1 * agents)


def plan_network(
    experiment: ValidExperiment,
    run_file: Path,  # run record, read by every node
    bag: Path | None,  # directory to record to; None: no recorder
    checkpoints: Path | None = None,  # directory of the states for a takeover; None: killed processes cannot resume
    *,
    use_sim_time: bool = False,
    parameter_services: bool = False,
    storage: Storage = DEFAULT_STORAGE,
    share: Share | None = None,
    readers: Sequence[str] = (),  # nodes that the user starts, and that must read the topics before the run starts
    most: int = MOST_UNAIDED,
    hosts: Sequence[Sequence[int]] = (),  # agents of each host of a channel: a process is on one; empty: no channel
) -> list[ProcessPlan]:
    """The processes of a run, in the order in which to start them; with ``share``, those of this host only.

    InputError: more than ``most`` processes with agents.
    """
    here = tuple(range(experiment.agents)) if share is None else share.agents
    groups = [group for part in hosts or [here] for group in split_agents(experiment, part, most=most)]
    count = len(groups)
    if count > most:
        raise InputError(f"run.processes: {count} processes on all hosts: expected at most {most}: give fewer")
    common: tuple[str, ...] = ("--use-sim-time",) if use_sim_time else ()
    if parameter_services:
        common += ("--parameter-services",)
    timeout = discovery_timeout(experiment.agents, count) if share is None else share.discovery_timeout
    if readers or hosts:  # what a channel loses is sent again
        timeout = max(timeout, USER_TIMEOUT)
    if timeout != DISCOVERY_TIMEOUT:
        common += ("--discovery-timeout", f"{timeout:g}")
    awaited = ([RECORDER] if bag is not None or share is not None else []) + list(readers)
    options = common + tuple(part for name in awaited for part in ("--await", name))
    if checkpoints is not None:
        options += ("--checkpoint", str(checkpoints))
    if share is not None:
        options += ("--patience", f"{share.patience:g}")
    resumes = checkpoints is not None
    home = share is None or share.home
    plans = []
    if bag is not None and home:
        files: tuple[str, ...] = ("--compression", storage.compression)
        if storage.split_size is not None:
            files += ("--split-size", repr(storage.split_size / MEGABYTE))
        plans.append(ProcessPlan(RECORDER, ("recorder", str(run_file), "--out", str(bag), *files, *common)))
    for agents in groups:
        numbers = [part for agent in agents for part in ("--agent", str(agent + 1))]
        arguments = ("agent", str(run_file), *numbers, *options)
        plans.append(ProcessPlan(process_name(agents), arguments, agents, resumes))
    if home:
        plans.append(ProcessPlan(SWITCHER, ("switcher", str(run_file), *options), resumes=resumes))
    return plans


def partners(plans: Sequence[ProcessPlan], listens: BoolArray) -> dict[str, set[str]]:
    """The processes that each process exchanges messages with; processes go by their first nodes.

    ``listens``: (m, m), whether agent i ever listens to agent j. Recorder and switcher have to do with all.
    """
    exchanges = listens | listens.T
    names = {plan.first_node for plan in plans}
    of_agent = {agent: plan.first_node for plan in plans for agent in plan.agents}
    central = {plan.first_node for plan in plans if not plan.agents}
    found = {}
    for plan in plans:
        peers = {of_agent[int(j)] for i in plan.agents for j in exchanges[i].nonzero()[0]}
        found[plan.first_node] = (peers | central if plan.agents else names) - {plan.first_node}
    return found
