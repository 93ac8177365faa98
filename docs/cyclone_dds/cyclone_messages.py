"""The topics of a network for Cyclone DDS: their types, names and quality of service, without ROS 2.

A ROS 2 topic ``name`` of type ``package/msg/Type`` is the DDS topic ``rt/name`` of type ``package::msg::dds_::Type_``.
The package cyclonedds reads the annotations of the types as they are: they must not be deferred (``from __future__``).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

from cyclonedds.core import Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

Id: TypeAlias = array[uint8, 16]

RELIABLE = Policy.Reliability.Reliable(duration(seconds=10))
STREAM = Qos(RELIABLE, Policy.History.KeepAll)
LATCHED = Qos(RELIABLE, Policy.History.KeepAll, Policy.Durability.TransientLocal)
NEWEST = Qos(RELIABLE, Policy.History.KeepLast(1), Policy.Durability.TransientLocal)


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """builtin_interfaces/msg/Time."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """std_msgs/msg/Header."""

    stamp: Time
    frame_id: str


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """std_msgs/msg/String."""

    data: str


@dataclass
class AgentState(IdlStruct, typename="msg_agents_interfaces::msg::dds_::AgentState_"):
    """msg_agents_interfaces/msg/AgentState."""

    header: Header
    run: Id
    agent: uint32
    step: uint64
    mode: uint32
    heard: sequence[uint64]
    state: sequence[float64]


@dataclass
class StateBatch(IdlStruct, typename="msg_agents_interfaces::msg::dds_::StateBatch_"):
    """msg_agents_interfaces/msg/StateBatch."""

    run: Id
    size: sequence[uint32]
    messages: sequence[uint8]


@dataclass
class ActiveGraph(IdlStruct, typename="msg_agents_interfaces::msg::dds_::ActiveGraph_"):
    """msg_agents_interfaces/msg/ActiveGraph."""

    header: Header
    run: Id
    sequence: uint32
    mode: uint32
    name: str
    first_step: uint64
    last_step: uint64
    source: sequence[uint32]
    target: sequence[uint32]
    weight: sequence[float64]


@dataclass
class Progress(IdlStruct, typename="msg_agents_interfaces::msg::dds_::Progress_"):
    """msg_agents_interfaces/msg/Progress."""

    header: Header
    run: Id
    agent: uint32
    step: uint64


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """rmw_dds_common/msg/Gid."""

    data: Id


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """rmw_dds_common/msg/NodeEntitiesInfo."""

    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """rmw_dds_common/msg/ParticipantEntitiesInfo."""

    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


# The topics with a fixed name; those of an agent are named by ``state_topic``.
TOPICS: dict[str, tuple[type[IdlStruct], Qos]] = {
    "experiment": (String, LATCHED),
    "graph": (ActiveGraph, LATCHED),
    "states": (StateBatch, STREAM),
    "progress": (Progress, LATCHED),
    "resend": (Progress, LATCHED),
    "epoch": (Progress, LATCHED),
    "end": (Progress, LATCHED),
}


def state_topic(agent: int) -> str:
    """Name of the topic of an agent's states; agents count from 1."""
    return f"agent_{agent}/state"


class Node:
    """A participant that other nodes of ROS 2 know by a name, in the root namespace."""

    def __init__(self, name: str, domain: int) -> None:
        self.name = name
        self.participant = DomainParticipant(domain)
        self.readers: dict[str, DataReader] = {}
        self.writers: dict[str, DataWriter] = {}
        names = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo)
        self._announcement = DataWriter(self.participant, names, NEWEST)
        self._announced = DataReader(self.participant, names, LATCHED)
        self._nodes: dict[bytes, list[NodeEntitiesInfo]] = {}  # by the identity of their participant

    def read(self, topic: str, *policies: Any) -> DataReader:
        """Subscribe to a topic, with more policies if wanted, such as a limit of what may wait to be taken."""
        kind, qos = TOPICS.get(topic, (AgentState, STREAM))
        qos = Qos(*policies, base=qos)
        self.readers[topic] = DataReader(self.participant, Topic(self.participant, f"rt/{topic}", kind), qos)
        return self.readers[topic]

    def write(self, topic: str) -> DataWriter:
        """Offer a topic."""
        kind, qos = TOPICS.get(topic, (AgentState, STREAM))
        self.writers[topic] = DataWriter(self.participant, Topic(self.participant, f"rt/{topic}", kind), qos)
        return self.writers[topic]

    def without_writer(self) -> list[str]:
        """Topics that it reads and for which it knows no writer yet."""
        return [topic for topic, reader in self.readers.items() if not _matched(reader.get_matched_publications)]

    def announce(self) -> None:
        """Say the name and which endpoints belong to it: from then on, nodes that wait for this name take it for ready.

        So it must know their writers: it would miss what one that it does not know sends it. DDS itself knows no nodes;
        in ROS 2 every participant lists its nodes on the topic ``ros_discovery_info``.
        """
        readers, writers = ([_gid(e.guid.bytes) for e in s.values()] for s in (self.readers, self.writers))
        node = NodeEntitiesInfo("/", self.name, readers, writers)
        self._announcement.write(ParticipantEntitiesInfo(_gid(self.participant.guid.bytes), [node]))

    def readers_of(self, topic: str) -> set[str]:
        """Names of the nodes that have announced a reader of a topic of this node, which the writer has matched."""
        self._nodes |= {
            bytes(info.gid.data): info.node_entities_info_seq
            for info in self._announced.take(N=1000)
            if isinstance(info, ParticipantEntitiesInfo)
        }
        readers = {
            bytes(gid.data): node.node_name
            for nodes in self._nodes.values()
            for node in nodes
            for gid in node.reader_gid_seq
        }
        writer = self.writers[topic]
        handles = _matched(writer.get_matched_subscriptions)
        matched = [writer.get_matched_subscription_data(handle) for handle in handles]
        return {readers[reader.key.bytes] for reader in matched if reader is not None and reader.key.bytes in readers}


def _matched(ask: Callable[[], list[int]]) -> list[int]:
    """Who is matched. The package counts, then lists: where one more is matched in between, it raises IndexError."""
    while True:
        try:
            return ask()
        except IndexError:
            continue


def _gid(identity: Iterable[int]) -> Gid:
    return Gid(list(identity))
