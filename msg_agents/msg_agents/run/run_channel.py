# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The channel of a run: hosts, environment, process, and what it did."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from msg_agents.channel.channel_file import BASE, Channel
from msg_agents.channel.links import ActiveGraphFile, read_counts
from msg_agents.channel.namespaces import Host, open_hosts
from msg_agents.channel.process import channel_findings, hand_over
from msg_agents.discovery.profiles import LEASE, profile_for_hosts
from msg_agents.discovery.rtps import PEERS_VARIABLE
from msg_agents.environment import channel_environment
from msg_agents.process_layout import SWITCHER, ProcessSpec
from msg_agents.run.supervisor import Supervisor
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graph_sources import heard_links
from msg_analysis.model.step_model import Wiring
from msg_analysis.theory.prediction import predict

STANDS = 1.5  # s without a step in lockstep after which the graph cuts nothing, until one is made
CUT_LEASE = 600.0  # s; that the graph cuts a link is no reason to give a host up


@dataclass(slots=True)
class RunChannel:
    """The channel of one run. The hosts are open."""

    channel: Channel
    hosts: dict[str, Host]
    _active: ActiveGraphFile | None = field(default=None, init=False)  # if packets follow the graph
    _lockstep: bool = field(default=False, init=False)
    _steps: list[int] = field(default_factory=list, init=False)  # of the agents, and since when [s]
    _since: float = field(default=0.0, init=False)

    @property
    def agents(self) -> list[tuple[int, ...]]:
        """The agents (from 0) of each host that has any."""
        return [agents for agents in self.channel.hosts.values() if agents]

    def environment(self, folder: Path) -> dict[str, str]:
        """Changes of the environment of all processes, with a profile in ``folder``."""
        profile = folder / "channel.xml"
        profile.write_text(profile_for_hosts(lease=CUT_LEASE if self.channel.graph else LEASE), encoding="utf-8")
        peers = " ".join(host.address for host in self.hosts.values())
        return channel_environment(profile) | {PEERS_VARIABLE: peers}

    def start(self, supervisor: Supervisor, plans: Sequence[ProcessSpec], wiring: Wiring, *, lockstep: bool) -> None:
        """Start its process, and say on which host each of the others is to be."""
        self._lockstep = lockstep
        control = supervisor.start_channel()
        counts = supervisor.channel_status
        active_graph = counts.with_name("active_graph") if self.channel.graph else None
        if active_graph is not None:
            self._active = ActiveGraphFile.create(active_graph, len(self.hosts))
            supervisor.options = {SWITCHER: ("--active-graph", str(active_graph))}
        supervisor.namespaces = {plan.name: self.hosts[self.channel.host_of(plan.agents)].namespace for plan in plans}
        joined = self.channel.joined(wiring.links) if self.channel.graph else None
        hand_over(control, self.channel, self.hosts, counts, active_graph, joined)

    def look(self, supervisor: Supervisor) -> None:
        """Let processes that were started again find all others, as at the start of the run; in lockstep, let it go on.

        There an agent also waits for those to which the graph cuts its link for longer than the window of the lockstep,
        and the graph changes only when all go on.
        """
        if self._active is None:
            return
        if supervisor.steps != self._steps or not self._lockstep:
            self._steps, self._since = supervisor.steps, time.monotonic()
        stands = time.monotonic() > self._since + STANDS
        starting = {self.channel.host_of(child.plan.agents) for child in supervisor.starting_again}
        for place, host in enumerate(self.hosts):
            self._active.let_through(place, all_packets=stands or host in starting)

    def to_json(self, supervisor: Supervisor, experiment: Experiment) -> dict[str, Any]:
        """Its hosts, and what it did, as in the result of the run."""
        hosts = {
            name: {"address": host.address, "agents": [agent + 1 for agent in self.channel.hosts[name]]}
            for name, host in self.hosts.items()
        }
        counts = read_counts(supervisor.channel_status) or {"pairs": [], "overflowed": 0, "late_ms": None}
        for pair in counts["pairs"]:
            model = self.channel.links[pair["sender"], pair["receiver"]].loss
            pair |= {"loss": model.mean, "inflation": model.inflation}
        predicted = predicted_errors(self.channel, experiment)
        known = {"seed": self.channel.seed, "recorder": BASE, "graph": self.channel.graph, "hosts": hosts}
        document = known | {"predicted": predicted} | counts
        return document | {"findings": channel_findings(document)}


def predicted_errors(channel: Channel, experiment: Experiment) -> dict[str, Any] | None:
    """Errors predicted before the run: in place of what the channel loses, the last value heard; nothing is late.

    None where that is not what happens (lockstep, reliable delivery, losses in the experiment itself, packets that the
    graph cuts, bursts, which are of packets and not of the messages of a link), or where it has no prediction.
    """
    run, noise = experiment.run, experiment.noise
    if run.pace == "lockstep" or run.delivery == "reliable" or noise.loss.any or channel.graph:
        return None
    if any(link.loss.good != link.loss.bad for link in channel.links.values()):
        return None
    document = experiment.to_document()
    heard = heard_links(experiment.graph_list, experiment.time)
    probability = channel.agent_loss(experiment.agents) * heard
    arcs = [[j + 1, i + 1, float(probability[i, j])] for i, j in np.argwhere(probability).tolist()]
    if arcs:
        document["noise"] |= {"loss": {"arcs": arcs}, "on_loss": "hold"}
    try:
        predicted = predict(Experiment.parse(document)).emulated
    except InputError:
        return None
    return {"system_error": predicted.system_error, "node_errors": predicted.node_errors.tolist()}


@contextmanager
def run_channel(channel: Channel | None) -> Iterator[RunChannel | None]:
    """Open the hosts of a channel; None: without one. NotAvailableError: this machine or user cannot have them."""
    if channel is None:
        yield None
        return
    with open_hosts(list(channel.hosts), channel.mtu) as hosts:
        yield RunChannel(channel, hosts)
