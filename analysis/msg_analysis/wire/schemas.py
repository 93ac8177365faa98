"""How an MCAP file describes the network's messages: definitions, type hashes and QoS, in rosbag2's words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
_FIELD_OF_OTHER_PACKAGE = re.compile(r"^([a-z][a-z0-9_]*)/(?:msg/)?([A-Z]\w*)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type.

    Attributes
    ----------
    package, name
        of the type
    type_hash
        RIHS01 hash of its description (REP-2016), as rosidl writes it to ``share/<package>/msg/<name>.json``
    """

    package: str
    name: str
    type_hash: str

    @property
    def full_name(self) -> str:
        """Package/msg/name."""
        return f"{self.package}/msg/{self.name}"

    @property
    def schema(self) -> str:
        """Its .msg text, followed by those of all types that it is made of."""
        text = _definition(self.package, self.name)
        pending, seen = _FIELD_OF_OTHER_PACKAGE.findall(text), {(self.package, self.name)}
        while pending:
            package, name = pending.pop(0)
            if (package, name) not in seen:
                seen.add((package, name))
                definition = _definition(package, name)
                text += f"{_SEPARATOR}{package}/{name}\n{definition}"
                pending += _FIELD_OF_OTHER_PACKAGE.findall(definition)
        return text


def _definition(package: str, name: str) -> str:
    file = resources.files("msg_analysis.wire") / "definitions" / package / "msg" / f"{name}.msg"
    return file.read_text(encoding="utf-8")


_INTERFACES = "msg_agents_interfaces"
AGENT_STATE = MessageType(
    _INTERFACES, "AgentState", "RIHS01_855e25ca7b9bb12acd4cc3177f2571fd1fd2a525ed333a403d6296120e29a9e6"
)
ACTIVE_GRAPH = MessageType(
    _INTERFACES, "ActiveGraph", "RIHS01_494043cce7f43cfa3b137d0b7770f26bb0802ec0032a6ecf7b44f6dbfc422c82"
)
PROGRESS = MessageType(
    _INTERFACES, "Progress", "RIHS01_075d0eb0154f1de34225d33cb0aa303f408a92a2011e46c0487e20ae63394fe6"
)
ESTIMATE = MessageType(
    _INTERFACES, "Estimate", "RIHS01_115be21e1cecad98ff8eecdcae1ab03d2a324db256d5b58f8060f94cb918c9df"
)
STRING = MessageType("std_msgs", "String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")


@dataclass(frozen=True, slots=True)
class Topic:
    """A recorded topic.

    Attributes
    ----------
    name
        absolute
    type
        of its messages
    latched
        whether who comes late still gets the messages
    """

    name: str
    type: MessageType
    latched: bool

    @property
    def qos(self) -> list[dict[str, Any]]:
        """The one profile that its publishers offer, in rosbag2's words: reliable, keep-all, maybe latched."""
        forever = {"sec": 9223372036, "nsec": 854775807}
        return [
            {
                "history": "keep_all",
                "depth": 0,
                "reliability": "reliable",
                "durability": "transient_local" if self.latched else "volatile",
                "deadline": dict(forever),
                "lifespan": dict(forever),
                "liveliness": "automatic",
                "liveliness_lease_duration": dict(forever),
                "avoid_ros_namespace_conventions": False,
            }
        ]


def network_topics(agents: int, namespace: str = "", *, truth: bool = False) -> Sequence[Topic]:
    """What a recorder of the network records: ``experiment``, ``graph``, ``agent_<i>/state``, ``agent_<i>/truth``.

    Parameters
    ----------
    agents
        their number m
    namespace
        of the network, such as ``/lab``; empty for the root
    truth
        whether the states are published with noise, and as they are on a topic of their own
    """
    root = "/" + namespace.strip("/") + "/" if namespace.strip("/") else "/"
    return (
        Topic(f"{root}experiment", STRING, latched=True),
        Topic(f"{root}graph", ACTIVE_GRAPH, latched=True),
        *(Topic(state_topic(root, agent), AGENT_STATE, latched=False) for agent in range(1, agents + 1)),
        *(Topic(truth_topic(root, agent), AGENT_STATE, latched=False) for agent in range(1, agents + 1) if truth),
    )


def state_topic(root: str, agent: int) -> str:
    """Topic of the states of an agent (from 1) below a root that ends with a slash.

    Parameters
    ----------
    root
        such as "/" or "/lab/"
    agent
        number from 1
    """
    return f"{root}agent_{agent}/state"


def truth_topic(root: str, agent: int) -> str:
    """Topic of the states as they are, where others are published, of an agent (from 1) below a root.

    Parameters
    ----------
    root
        such as "/" or "/lab/"
    agent
        number from 1
    """
    return f"{root}agent_{agent}/truth"
