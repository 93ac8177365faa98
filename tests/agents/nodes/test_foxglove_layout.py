"""The Foxglove layout shows what our messages have."""

import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from msg_agents_interfaces.msg import ActiveGraph, AgentState, Estimate
from visualization_msgs.msg import MarkerArray

from msg_analysis.messages import topics

LAYOUT = Path(__file__).parents[3] / "ros_ws/src/msg_agents_bringup/foxglove/five_agents.json"
TOPICS: dict[str, Any] = {
    **{f"/{topics.STATE.of(agent)}": AgentState for agent in range(5)},
    f"/{topics.GRAPH.name}": ActiveGraph,
    f"/{topics.ESTIMATE.name}": Estimate,
    f"/{topics.MARKERS.name}": MarkerArray,
    topics.DIAGNOSTICS.name: DiagnosticArray,
}


def field_type(message: Any, path: str) -> str:
    """The ROS type at the end of a path of fields; KeyError if there is none."""
    name, _, rest = path.partition(".")
    found = re.fullmatch(r"(\w+)(\[\d+\])?", name)
    assert found, path
    kind = message.get_fields_and_field_types()[found[1]]
    if found[2]:
        inner = re.fullmatch(r"sequence<(.*)>|(.*)\[\d+\]", kind)
        assert inner, f"{path}: {kind} has no elements"
        kind = inner[1] or inner[2]
    if not rest:
        return kind
    package, _, name = kind.partition("/")
    return field_type(getattr(importlib.import_module(f"{package}.msg"), name), rest)


def panels(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        yield from panels(node["first"])
        yield from panels(node["second"])


def test_panels_topics_and_paths() -> None:
    """Every panel is placed once, every topic is ours, and every path leads to a number in a message of ours."""
    layout = json.loads(LAYOUT.read_text())
    shown = layout["configById"]
    assert sorted(panels(layout["layout"])) == sorted(shown)
    topics_shown = [*shown["3D!network"]["topics"], shown["DiagnosticSummary!health"]["topicToRender"]]
    topics_shown.append(shown["RawMessages!graph"]["topicPath"])
    assert [TOPICS[topic] for topic in topics_shown] == [MarkerArray, DiagnosticArray, ActiveGraph]
    paths = [path for panel in shown.values() for path in panel.get("paths", [])]
    assert len(paths) == 5 + 3 + 1
    for path in paths:
        topic, _, fields = path["value"].partition(".")
        assert field_type(TOPICS[topic], fields) in {"double", "uint32", "uint64"}, path
        assert path["timestampMethod"] == "headerStamp"
        assert field_type(TOPICS[topic], "header.stamp") == "builtin_interfaces/Time"
