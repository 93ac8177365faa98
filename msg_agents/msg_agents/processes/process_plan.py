"""The plan of a network: which nodes run in which processes. One source for the runner and for launch files."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from msg_agents.processes.environment import DISCOVERY_TIMEOUT
from msg_analysis.bags.format.storage_options import DEFAULT, MEGABYTE, Storage
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import Experiment

RECORDER, SWITCHER = "recorder", "switcher"
SMALL = 8
"""Agents up to which each one gets a process of its own, and which a process has at least in larger networks."""
MOST_PROCESSES = 90
"""Agent processes. Participants of one domain find each other on one machine up to the ``maxInitialPeersRange`` of
loopback.xml, of which switcher, recorder and what the user watches the run with need some."""


def agent_name(agent: int) -> str:
    """Name of the node, and namespace of the topics, of an agent.

    Parameters
    ----------
    agent
        index from 0
    """
    return f"agent_{agent + 1}"


@dataclass(frozen=True, slots=True)
class ProcessPlan:
    """One process of a network.

    Attributes
    ----------
    name
        what people call it
    arguments
        of the command ``msg-agents`` that runs it
    agents
        indices from 0 of the agents in it
    resumes
        whether the same command takes over when the process has been killed
    """

    name: str
    arguments: tuple[str, ...]
    agents: tuple[int, ...] = ()
    resumes: bool = False


@dataclass(frozen=True, slots=True)
class Share:
    """What one host runs of a network that is spread over several.

    Attributes
    ----------
    agents
        indices from 0, ascending
    home
        whether recorder and switcher are here
    discovery_timeout
        s for which nodes look for those of other hosts, which people start
    patience
        s after which nodes end that have been left alone
    """

    agents: tuple[int, ...]
    home: bool
    discovery_timeout: float
    patience: float


def count_processes(experiment: Experiment, agents: int | None = None) -> int:
    """Agent processes that an experiment asks for.

    Parameters
    ----------
    experiment
        what is run
    agents
        how many of them are on this machine; None: all

    Raises
    ------
    InputError
        more than discovery can handle
    """
    agents, wanted = experiment.agents if agents is None else agents, experiment.run.processes
    if wanted == "auto":
        # A message to another process costs more than the step that it is for: no more processes than can run at once.
        return agents if agents <= SMALL else min(math.ceil(agents / SMALL), MOST_PROCESSES, os.cpu_count() or 1)
    count = agents if wanted == "one_per_agent" else min(int(wanted), agents)
    if count > MOST_PROCESSES:
        raise InputError(
            f"run.processes: {wanted} ({count} processes): expected at most {MOST_PROCESSES}, because discovery on one "
            "machine finds about 100 participants: give a smaller number, several agents share a process"
        )
    return count


def most_processes(experiment: Experiment, agents: int) -> int:
    """Agent processes that an experiment may have for so many agents, on a machine of any number of cores.

    Parameters
    ----------
    experiment
        that is run
    agents
        that are to be spread over them
    """
    wanted = experiment.run.processes
    return min(agents, MOST_PROCESSES, int(wanted) if isinstance(wanted, int) else agents)


def discovery_timeout(agents: int, processes: int) -> float:
    """Seconds after which a node of a network says whom it has not found.

    Who is started first waits for who is started last; processes start at two or more a second, and in large ones it
    takes a while until every endpoint is known everywhere.

    Parameters
    ----------
    agents
        m
    processes
        of the whole network
    """
    return max(DISCOVERY_TIMEOUT, 2.0 * processes + 0.1 * agents)


def plan_network(
    experiment: Experiment,
    run_file: Path,
    bag: Path | None,
    checkpoints: Path | None = None,
    *,
    use_sim_time: bool = False,
    storage: Storage = DEFAULT,
    share: Share | None = None,
) -> list[ProcessPlan]:
    """The processes of a run, in the order in which they should be started.

    Parameters
    ----------
    experiment
        what is run
    run_file
        the run record that every node is given
    bag
        directory to record to; None: no recorder
    checkpoints
        directory for what agents and switcher need to go on after being killed; None: they cannot
    use_sim_time
        whether the nodes take the time from ``/clock``
    storage
        how the recorder stores the bag
    share
        what of it runs on this host, of several, one of which records; None: all

    Raises
    ------
    InputError
        more processes than discovery can handle
    """
    here = tuple(range(experiment.agents)) if share is None else share.agents
    count = count_processes(experiment, len(here))
    common: tuple[str, ...] = ("--use-sim-time",) if use_sim_time else ()
    timeout = discovery_timeout(experiment.agents, count) if share is None else share.discovery_timeout
    if timeout != DISCOVERY_TIMEOUT:
        common += ("--discovery-timeout", f"{timeout:g}")
    options = common + (("--await", RECORDER) if bag is not None or share is not None else ())
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
    for index in range(count):
        # Neighbouring numbers share a process: in most graphs they are neighbours, and their messages stay inside.
        agents = here[index * len(here) // count : (index + 1) * len(here) // count]
        numbers = [part for agent in agents for part in ("--agent", str(agent + 1))]
        first, last = agents[0] + 1, agents[-1] + 1
        rest = f"to_{last}" if last - first == len(agents) - 1 else f"and_{len(agents) - 1}_more"
        name = f"agent_{first}" if first == last else f"agents_{first}_{rest}"
        plans.append(ProcessPlan(name, ("agent", str(run_file), *numbers, *options), agents, resumes))
    if home:
        plans.append(ProcessPlan(SWITCHER, ("switcher", str(run_file), *options), resumes=resumes))
    return plans
