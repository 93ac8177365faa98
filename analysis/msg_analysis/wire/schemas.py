"""How an MCAP file describes the network's messages: definitions, type hashes and QoS, as rosbag2 writes them.

Also the names of the recorded topics.
"""

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
    """A message type; its hash is the RIHS01 hash of REP-2016, in rosidl's ``share/<package>/msg/<name>.json``."""

    package: str
    name: str
    type_hash: str

    @property
    def full_name(self) -> str:
        """``package/msg/Name``."""
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
    """A recorded topic."""

    name: str  # absolute
    type: MessageType
    latched: bool  # whether late subscribers still get the messages

    @property
    def qos(self) -> list[dict[str, Any]]:
        """The one profile that its publishers offer, as rosbag2 writes it: reliable, keep-all, latched or not."""
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
    """What a recorder records: ``experiment``, ``graph``, ``agent_<i>/state`` and, if ``truth``, ``agent_<i>/truth``.

    ``namespace`` is such as ``/lab``; empty for the root. ``truth``: the published states are not the true, whole ones.
    """
    root = "/" + namespace.strip("/") + "/" if namespace.strip("/") else "/"
    return (
        Topic(f"{root}experiment", STRING, latched=True),
        Topic(f"{root}graph", ACTIVE_GRAPH, latched=True),
        *(Topic(state_topic(root, agent), AGENT_STATE, latched=False) for agent in range(1, agents + 1)),
        *(Topic(truth_topic(root, agent), AGENT_STATE, latched=False) for agent in range(1, agents + 1) if truth),
    )


def state_topic(root: str, agent: int) -> str:
    """Topic of the states that agent ``agent`` (from 1) publishes; ``root`` ends with a slash: "/" or "/lab/"."""
    return f"{root}agent_{agent}/state"


def truth_topic(root: str, agent: int) -> str:
    """Topic of the true states, where the published ones differ; arguments as of ``state_topic``."""
    return f"{root}agent_{agent}/truth"
