# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""All topics of a network: name, type, quality of service, the nodes that publish and that read it.

Names without a leading slash are relative to the namespace of the network. ``<i>`` is the number of an agent, from 1;
functions take its index, from 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from msg_analysis.messages import messages
from msg_analysis.messages.messages import MessageType

_NUMBER = "<i>"


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of a publisher or a subscription."""

    depth: int | None = None  # messages stored for slow or late readers; None: all
    reliable: bool = True
    latched: bool = False  # transient-local: late readers get the stored messages

    def __str__(self) -> str:
        depth = "keep-all" if self.depth is None else f"keep-last {self.depth}"
        durability = "latched" if self.latched else "volatile"
        return f"{'reliable' if self.reliable else 'best-effort'}, {depth}, {durability}"

    def offered(self) -> list[dict[str, Any]]:
        """The one profile that the publishers offer, as rosbag2 writes it."""
        unlimited = {"sec": 9223372036, "nsec": 854775807}
        return [
            {
                "history": "keep_all" if self.depth is None else "keep_last",
                "depth": self.depth or 0,
                "reliability": "reliable" if self.reliable else "best_effort",
                "durability": "transient_local" if self.latched else "volatile",
                "deadline": dict(unlimited),
                "lifespan": dict(unlimited),
                "liveliness": "automatic",
                "liveliness_lease_duration": dict(unlimited),
                "avoid_ros_namespace_conventions": False,
            }
        ]


# Reliable, keep-all: a slow reader holds the writer back end to end. Keep-last, of any depth, loses messages silently
# to a busy reader. Rare messages that late readers need are latched. States are not: the start gate waits for their
# readers, and a writer that keeps thousands of old ones works in cold memory, which costs a tenth of the speed.
STREAM, LATCHED = Qos(), Qos(latched=True)
NEWEST = Qos(1, latched=True)
"""Values that replace earlier ones: the writer never waits, and a late reader gets the newest."""
RECENT = Qos(10)
PASSIVE, PASSIVE_NEWEST = Qos(5000, reliable=False), Qos(1, reliable=False)
"""Of readers that no writer waits for: they miss messages if they are too slow. PASSIVE_NEWEST: what such a reader has
not read yet is replaced, and nothing is stored for it."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic, or those of all agents."""

    name: str
    type: MessageType
    qos: Qos
    writers: str  # nodes that publish it
    readers: str  # nodes that subscribe to it
    recorded: bool = False

    def of(self, agent: int) -> str:
        """The name for an agent (index from 0)."""
        return self.name.replace(_NUMBER, str(agent + 1))


def agent_node_name(agent: int) -> str:
    """Name of the node, and namespace of the topics, of an agent (index from 0; the name counts from 1)."""
    return f"agent_{agent + 1}"


EXPERIMENT = Topic("experiment", messages.STRING, LATCHED, "switcher", "recorder, live, markers", recorded=True)
GRAPH = Topic("graph", messages.ACTIVE_GRAPH, LATCHED, "switcher", "agents, recorder", recorded=True)
STATE = Topic(
    f"agent_{_NUMBER}/state", messages.AGENT_STATE, STREAM, "agent", "neighbours, live, markers", recorded=True
)
TRUTH = Topic(f"agent_{_NUMBER}/truth", messages.AGENT_STATE, STREAM, "agent", "live", recorded=True)
# The same messages for the recorder, which records them under the topics above: many in one message, since each message
# costs a reader as much as recording a hundred states. The first agent of every process publishes them.
# Processes that hear most of the network read STATES as well.
STATES = Topic("states", messages.STATE_BATCH, STREAM, "agent", "recorder, agents of dense networks")
TRUTHS = Topic("truths", messages.STATE_BATCH, STREAM, "agent", "recorder")
PROGRESS = Topic("progress", messages.PROGRESS, LATCHED, "agents, recorder", "switcher")
RESEND = Topic("resend", messages.PROGRESS, LATCHED, "agents", "agents")
EPOCH = Topic("epoch", messages.PROGRESS, LATCHED, "switcher", "agents")
END = Topic("end", messages.PROGRESS, LATCHED, "switcher", "agents, recorder, live, markers")
# Before the end of a run that ends early (`--until`): at which step. Recorded, so that a bag is that of a shorter run.
STOP = Topic("stop", messages.PROGRESS, LATCHED, "switcher", "agents, recorder", recorded=True)
# By which nodes that were started one by one know that they have the same run record: its digest as stamp.
RECORD = Topic("record", messages.PROGRESS, LATCHED, "switcher", "agents, recorder")
LEAVE = Topic("leave", messages.PROGRESS, LATCHED, "agents, switcher, recorder", "agents, switcher, recorder")
POSE = Topic(f"agent_{_NUMBER}/pose", MessageType("geometry_msgs", "PoseStamped"), RECENT, "agent", "")
ESTIMATE = Topic("estimate", messages.ESTIMATE, NEWEST, "live", "")
MARKERS = Topic("markers", MessageType("visualization_msgs", "MarkerArray"), NEWEST, "markers", "")
DIAGNOSTICS = Topic("/diagnostics", MessageType("diagnostic_msgs", "DiagnosticArray"), RECENT, "every process", "")
CLOCK = Topic("/clock", MessageType("rosgraph_msgs", "Clock"), RECENT, "player", "nodes with use_sim_time")
TOPICS = (
    *(EXPERIMENT, GRAPH, STATE, TRUTH, STATES, TRUTHS, PROGRESS, RESEND, EPOCH, END, STOP, RECORD, LEAVE),
    *(POSE, ESTIMATE, MARKERS, DIAGNOSTICS, CLOCK),
)


def network_topics(agents: int, namespace: str = "", *, truth: bool = False, stop: bool = False) -> Sequence[Topic]:
    """The recorded ones, absolute; ``truth``: states are published in part or with noise; ``stop``: may end early."""
    root = f"/{namespace.strip('/')}/".replace("//", "/")
    return [
        replace(topic, name=root + topic.of(agent))
        for topic in TOPICS
        if topic.recorded and (truth or topic is not TRUTH) and (stop or topic is not STOP)
        for agent in range(agents if _NUMBER in topic.name else 1)
    ]
