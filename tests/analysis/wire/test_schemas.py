"""Definitions and hashes against the ROS packages and rosbags."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

import msg_analysis.messages
from msg_analysis.messages.messages import ACTIVE_GRAPH, AGENT_STATE, ESTIMATE, PROGRESS, STRING, MessageType

DEFINITIONS = Path(msg_analysis.messages.__file__).parent / "definitions"
INTERFACES = Path(__file__).parents[3] / "ros_ws" / "src" / "msg_agents_interfaces"
TYPES = [AGENT_STATE, ACTIVE_GRAPH, ESTIMATE, PROGRESS, STRING]


@pytest.mark.parametrize("package", ["msg_agents_interfaces", "std_msgs", "builtin_interfaces"])
def test_definitions_are_those_of_the_packages(package: str) -> None:
    share = INTERFACES if package == "msg_agents_interfaces" else Path(sys.prefix) / "share" / package
    if not share.exists():
        pytest.skip(f"{package} is not installed: run make setup")
    ours = sorted((DEFINITIONS / package / "msg").glob("*.msg"))
    assert ours
    if package == "msg_agents_interfaces":
        assert [file.name for file in ours] == [file.name for file in sorted((share / "msg").glob("*.msg"))]
    for file in ours:
        assert file.read_bytes() == (share / "msg" / file.name).read_bytes()


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.name)
def test_type_hashes(typestore: Any, kind: MessageType) -> None:
    assert kind.type_hash == typestore.hash_rihs01(kind.full_name)
    description = Path(sys.prefix) / "share" / kind.package / "msg" / f"{kind.name}.json"
    if description.exists():
        hashes = json.loads(description.read_text())["type_hashes"]
        assert {"type_name": kind.full_name, "hash_string": kind.type_hash} in hashes


def test_schema_lists_every_dependency_once() -> None:
    parts = AGENT_STATE.schema.split("\n" + "=" * 80 + "\nMSG: ")
    assert [part.split("\n", 1)[0] for part in parts[1:]] == ["std_msgs/Header", "builtin_interfaces/Time"]
    assert "=====" not in STRING.schema
