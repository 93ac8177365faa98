# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The agents of a run that are its user's: how they are started, and the one error if one does not come, or goes."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from msg_agents.environment import USER_TIMEOUT
from msg_analysis.bags.log_map import LogMap, Source, load_map
from msg_analysis.common.text import agent_name, listed
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.topics import agent_node_name

STATUS_PERIOD = 1.0  # s between two readings of the status files
NOTHING_ON = "nothing on"  # how the words of a process begin whose robot publishes nothing
BEHIND = 2  # steps by which an agent in real time may be behind without being slower than the others


def robot_source(experiment: Experiment, mapped: LogMap, agent: int) -> Source:
    """Where the state of a robot (number from 1) is; InputError: it cannot take part, or the map does not say it."""
    run, names = experiment.run, experiment.names
    if run.pace != "realtime" or run.replicas != 1:
        raise InputError(
            f"run: pace {run.pace}, replicas {run.replicas}: expected realtime and 1: robots wait for nobody"
        )
    source = mapped.source(agent, agent_name(agent, names))
    if source is None:
        raise InputError(f"agents: {agent_name(agent, names)}: not in the map: expected an entry of it, or of '*'")
    if source.topic is None or source.field is None:
        raise InputError(f"agents.{agent}: expected `topic` and `field`: correct the map")
    return source


def robot_topics(experiment: Experiment, map_file: Path) -> dict[int, str]:
    """The topic of each external agent (from 0), by the map; InputError: see ``robot_source``, or none is external."""
    if not experiment.external:
        raise InputError(f"--map: {map_file}: expected external agents, with --external or run.external")
    mapped = load_map(map_file)
    try:
        return {i: str(robot_source(experiment, mapped, i + 1).topic) for i in sorted(experiment.external)}
    except InputError as error:
        raise InputError(f"{map_file}: {error}") from error


class ExternalAgents:
    """The external agents of a run: ``topics`` of those (from 0) for which a process of the run stands in.

    ``timeout`` [s] is for each to come, and to make a step.
    """

    def __init__(
        self,
        experiment: Experiment,
        topics: Mapping[int, str],
        timeout: float = USER_TIMEOUT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._topics, self.timeout, self._clock = topics, timeout, clock
        self._names, self._agents = experiment.names, sorted(experiment.external)
        self._lockstep, self._last = experiment.run.pace == "lockstep", experiment.steps
        self._moved = dict.fromkeys(self._agents, (-1, clock()))  # newest step, and when it was made [s]
        self._looked = clock()
        self._quiet: set[str] = set()  # nodes of robots that publish nothing

    def how_to_start(self, run_file: Path, domain: int) -> str:
        """What their user has to do, in words; empty without any."""
        if not self._agents:
            return ""
        where = f"in ROS_DOMAIN_ID {domain}, within {self.timeout:g} s"
        if self._topics:
            return f"{self._are(self._agents)}: waiting for {listed(list(self._topics.values()))} {where}"
        return (
            f"{self._are(self._agents)}: start a program with msg_agents.ExternalAgent for each, with the run record "
            f"{run_file}, {where}; robots in real time need none: give --map"
        )

    def _are(self, agents: Sequence[int]) -> str:
        names = listed([agent_name(agent + 1, self._names) for agent in agents])
        return f"agents {names} are external" if len(agents) > 1 else f"agent {names} is external"

    def notes(self, waiting: Callable[[], Mapping[str, str]]) -> list[str]:
        """Robots that have published nothing for a while, each once; ``waiting``: what nodes wait for, by name."""
        if not self._topics or self._clock() < self._looked + STATUS_PERIOD:
            return []
        self._looked = self._clock()
        nodes = {agent_node_name(agent): agent for agent in self._agents}
        quiet = {name: words for name, words in waiting().items() if name in nodes and words.startswith(NOTHING_ON)}
        new, self._quiet = quiet.keys() - self._quiet, set(quiet)
        return [f"{self._are([nodes[name]])}: {quiet[name]}" for name in sorted(new)]

    def failure(self, steps: Sequence[int], last: int) -> str | None:
        """Why the run cannot go on, given the newest step of every agent and the last of the run; None: it can."""
        now = self._clock()
        for agent, (step, _) in self._moved.items():
            if steps and steps[agent] > step:
                self._moved[agent] = steps[agent], now
        late = [agent for agent in self._agents if self._is_waited_for(agent, steps, last)]
        late = [agent for agent in late if now > self._moved[agent][1] + self.timeout]
        if not late:
            return None
        if steps[late[0]] < 0:
            return self.never_came(late)
        return f"{self._are(late)}, and made no step for {self.timeout:g} s after step {steps[late[0]]}: is it running?"

    def never_came(self, agents: Sequence[int]) -> str:
        """That these did not come."""
        missing = [self._topics[agent] for agent in agents if agent in self._topics]
        what = (
            f"nobody publishes {listed(missing)}"
            if missing
            else f"nobody has started {'them' if len(agents) > 1 else 'it'}"
        )
        return f"{self._are(agents)}, and did not come within {self.timeout:g} s: {what}"

    def _is_waited_for(self, agent: int, steps: Sequence[int], last: int) -> bool:
        """Whether the others are ahead of it, or, in lockstep, wait for it: each has published what it needs."""
        if not steps or steps[agent] >= last:
            return False
        others = [step for i, step in enumerate(steps) if i not in self._moved]
        if steps[agent] < 0:
            return min(others, default=0) >= 0
        if self._lockstep:
            return steps[agent] == min(steps)
        return max(steps) > steps[agent] + BEHIND

    def holds_up(self, steps: Sequence[int], last: int) -> bool:
        """Whether the run waits for one of them."""
        return any(self._is_waited_for(agent, steps, last) for agent in self._agents)

    def not_discovered(self, lines: Iterable[str]) -> str | None:
        """The failure if, by the last lines of processes that failed, external agents were not there; else None."""
        nodes = {agent_node_name(agent): agent for agent in self._agents}
        words = {word for line in lines for word in re.findall(r"\w+", line.partition("did not discover: ")[2])}
        missing = sorted(agent for name, agent in nodes.items() if name in words)
        return self.never_came(missing) if missing else None
