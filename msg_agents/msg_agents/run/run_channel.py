# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The channel of a run: hosts, environment, process, and what it did, in numbers and in sentences."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_agents.channel.channel_file import BASE, Channel
from msg_agents.channel.process import ActiveGraphFile, Host, hand_over
from msg_agents.discovery.rtps import LEASE, PEERS_VARIABLE, profile_for_hosts
from msg_agents.environment import channel_environment
from msg_agents.process_layout import SWITCHER, ProcessSpec
from msg_agents.run.result import read_report
from msg_agents.run.supervisor import Supervisor
from msg_analysis.common.text import counted, percent
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.validation import heard_links
from msg_analysis.model.step_model import Wiring

if TYPE_CHECKING:
    from msg_analysis.inference.timing import LostMessages

STANDS = 1.5  # s without a step in lockstep after which the graph cuts nothing, until one is made
CUT_LEASE = 600.0  # s; that the graph cuts a link is no reason to give a host up
MOST_Z = 5.0  # of the packets that a pair lost; by chance, any of 1000 pairs is beyond it in 0.06 % of all runs
SHOWN_PAIRS = 3


class RunChannel:
    """The channel of one run. The hosts are open."""

    def __init__(self, channel: Channel, hosts: dict[str, Host]) -> None:
        self.channel, self.hosts = channel, hosts
        self.agents = [agents for agents in channel.hosts.values() if agents]  # (from 0) of each host that has any
        self._active: ActiveGraphFile | None = None  # if packets follow the graph
        self._lockstep = False
        self._steps: list[int] = []  # of the agents, and since when [s]
        self._since = 0.0

    def environment(self, folder: Path) -> dict[str, str]:
        """Changes of the environment of all processes, with a profile in ``folder``."""
        profile = folder / "channel.xml"
        profile.write_text(profile_for_hosts(lease=CUT_LEASE if self.channel.graph else LEASE), encoding="utf-8")
        peers = " ".join(host.address for host in self.hosts.values())
        return channel_environment(profile) | {PEERS_VARIABLE: peers}

    def start(
        self, supervisor: Supervisor, processes: Sequence[ProcessSpec], wiring: Wiring, *, lockstep: bool
    ) -> None:
        """Start its process, and say on which host each of the others is to be."""
        self._lockstep = lockstep
        control = supervisor.start_channel()
        counts = supervisor.channel_status
        active_graph = counts.with_name("active_graph") if self.channel.graph else None
        if active_graph is not None:
            self._active = ActiveGraphFile.create(active_graph, len(self.hosts))
            supervisor.options = {SWITCHER: ("--active-graph", str(active_graph))}
        supervisor.namespaces = {
            spec.name: self.hosts[self.channel.host_of(spec.agents)].namespace for spec in processes
        }
        joined = self.channel.joined(wiring.links) if self.channel.graph else None
        hand_over(control, self.channel, self.hosts, counts, active_graph, joined)

    def look(self, supervisor: Supervisor) -> None:
        """Let processes that were started again find all others, as at the start, and a run in lockstep go on."""
        # There an agent also waits for those to which the graph cuts its link for longer than the window of the
        # lockstep, and the graph changes only when all go on.
        if self._active is None:
            return
        if supervisor.steps != self._steps or not self._lockstep:
            self._steps, self._since = supervisor.steps, time.monotonic()
        stands = time.monotonic() > self._since + STANDS
        starting = {self.channel.host_of(child.spec.agents) for child in supervisor.starting_again}
        for place, host in enumerate(self.hosts):
            self._active.let_through(place, all_packets=stands or host in starting)

    def to_json(self, supervisor: Supervisor, experiment: Experiment) -> dict[str, Any]:
        """Its hosts, and what it did, as in the result of the run."""
        hosts = {
            name: {"address": host.address, "agents": [agent + 1 for agent in self.channel.hosts[name]]}
            for name, host in self.hosts.items()
        }
        counts = read_report(supervisor.channel_status) or {"pairs": [], "overflowed": 0, "late_ms": None}
        for pair in counts["pairs"]:
            model = self.channel.links[pair["sender"], pair["receiver"]].loss
            pair |= {"loss": model.mean, "inflation": model.inflation}
        predicted = predicted_errors(self.channel, experiment)
        known = {"seed": self.channel.seed, "recorder": BASE, "graph": self.channel.graph, "hosts": hosts}
        document = known | {"predicted": predicted} | counts
        return document | {"findings": channel_findings(document)}


def predicted_errors(channel: Channel, experiment: Experiment) -> dict[str, Any] | None:
    """Errors predicted before the run: in place of what the channel loses, the last value received; nothing is late."""
    # None where that is not what happens: bursts are of packets and not of the messages of a link, for example.
    run, noise = experiment.run, experiment.noise
    if run.pace == "lockstep" or run.delivery == "reliable" or noise.loss.any or channel.graph:
        return None
    if any(link.loss.good != link.loss.bad for link in channel.links.values()):
        return None
    from msg_analysis.theory.prediction import predict  # a third of the imports of a run

    document = experiment.to_document()
    probability = channel.agent_loss(experiment.agents) * heard_links(experiment.graph_list, experiment.time)
    arcs = [[j + 1, i + 1, float(probability[i, j])] for i, j in np.argwhere(probability).tolist()]
    if arcs:
        document["noise"] |= {"loss": {"arcs": arcs}, "on_loss": "hold"}
    try:
        predicted = predict(Experiment.parse(document)).emulated
    except InputError:
        return None
    return {"system_error": predicted.system_error, "node_errors": predicted.node_errors.tolist()}


def channel_findings(
    channel: Mapping[str, Any], lost: LostMessages | None = None, period_ms: float | None = None
) -> list[str]:
    """Sentences about ``channel``, as in the result of a run, and about the messages of its log in real time."""
    pairs = channel["pairs"]
    found = [words for pair in pairs if (words := _unlike_the_file(pair))]
    full = sorted((pair for pair in pairs if pair["dropped"]), key=lambda pair: -pair["dropped"] / pair["sent"])
    found += [
        f"{percent(pair['dropped'] / pair['sent'])} of the packets from {pair['sender']} to {pair['receiver']} were "
        "dropped by the full queue: more traffic than its rate_mbit carries"
        for pair in full
    ]
    left_out = len(found) - SHOWN_PAIRS
    if left_out > 0:
        found = [*found[:SHOWN_PAIRS], f"the same is true of {left_out} more of these pairs"]
    if channel["overflowed"]:
        found.append(
            f"{counted(channel['overflowed'], 'packet')} came faster than the channel could take them: it lost more "
            "than its file says"
        )
    late = channel["late_ms"]
    if late and period_ms and late["mean"] > period_ms / 10:
        found.append(
            f"packets were passed on {late['mean']:.1f} ms later than the file says, on average, with a period of "
            f"{period_ms:.3g} ms: the machine is too busy for this channel"
        )
    if lost is not None and lost.words():
        found.append(_messages(channel, lost))
    return [f"{words[:1].upper()}{words[1:]}." for words in found]


def _unlike_the_file(pair: Mapping[str, Any]) -> str | None:
    """That a pair lost another fraction at random than the file says; that is rare where it does what it should."""
    sent, loss = pair["sent"], pair["loss"]
    spread = math.sqrt(sent * loss * (1.0 - loss) * pair["inflation"])
    if abs(pair["lost"] - sent * loss) <= max(MOST_Z * spread, 0.5):
        return None
    return (
        f"{percent(pair['lost'] / sent)} of the {sent} packets from {pair['sender']} to {pair['receiver']} were lost "
        f"at random, not {percent(loss)}"
    )


def _messages(channel: Mapping[str, Any], lost: LostMessages) -> str:
    """Why messages were not received in time: the losses of the experiment, those of the channel, and the rest."""
    host = {agent - 1: name for name, host in channel["hosts"].items() for agent in host["agents"]}
    losses = {(pair["sender"], pair["receiver"]): pair["loss"] for pair in channel["pairs"]}
    by_channel = by_both = 0.0
    rows = zip(lost.links.tolist(), lost.messages.tolist(), lost.probability.tolist(), strict=True)
    for (receiver, sender), messages, probability in rows:
        loss = losses.get((host[sender], host[receiver]), 0.0)
        by_channel += messages * (1.0 - probability) * loss
        by_both += messages * (probability + (1.0 - probability) * loss)
    fraction, (low, high), expected = lost.share()
    total = int(lost.messages.sum())
    words = (
        f"of the messages between agents, {percent(fraction)} ({100 * low:.3g} to {100 * high:.3g} %) were not "
        f"received in time: the experiment loses {percent(expected)}, the channel {percent(by_channel / total)} more"
    )
    if low > by_both / total:
        return f"{words}; the others were late or dropped"
    if high < by_both / total:
        return f"{words}; lost messages were sent again in time"
    return words
