# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""How an MCAP file describes the network's messages: definitions and type hashes, as rosbag2 writes them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources

_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
_FIELD_OF_OTHER_PACKAGE = re.compile(r"^([a-z][a-z0-9_]*)/(?:msg/)?([A-Z]\w*)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type; its hash is the RIHS01 hash of REP-2016, in rosidl's ``share/<package>/msg/<name>.json``."""

    package: str
    name: str
    type_hash: str = ""  # empty: never recorded

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
    file = resources.files("msg_analysis.messages") / "definitions" / package / "msg" / f"{name}.msg"
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
STATE_BATCH = MessageType(_INTERFACES, "StateBatch")
STRING = MessageType("std_msgs", "String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
