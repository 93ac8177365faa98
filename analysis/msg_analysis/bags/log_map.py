# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The map of a log: where in a bag, or a table, the states of the agents and the graphs are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, PlainValidator, ValidationError

from msg_analysis.common.text import listed
from msg_analysis.errors import InputError
from msg_analysis.experiment.loading import read_yaml
from msg_analysis.experiment.problems import ExperimentError, problem, show, translate
from msg_analysis.experiment.values import NonNegative, Positive, Section, expected, is_agent, is_number

EVERY = "*"  # key of the entry of all agents that have none of their own
NUMBER, NAME = "{i}", "{name}"  # in a topic or field of that entry

Seconds = Annotated[Positive, Field(ge=1e-9, le=1e9)]
Scale = Annotated[Positive, Field(ge=1e-50, le=1e50)]
LONGEST = 1000  # characters of a topic or field
Text = Annotated[str, Field(min_length=1, max_length=LONGEST)]


class Source(Section):
    """Where the state of an agent is."""

    topic: Text | None = Field(None, description="topic of a bag; none in a table", examples=["/robot_1/odom"])
    field: Text | None = Field(
        None, description="field of its messages, or column of a table", examples=["pose.pose.position.x"]
    )
    fields: list[Text] | None = Field(
        None,
        min_length=1,
        description="instead of `field`: coordinates that move by the same law, independently of each other",
        examples=[["pose.pose.position.x", "pose.pose.position.y"]],
    )
    hears: Literal["number", "point", "pose"] = Field(
        "number",
        description="in a run: what it is told of others. number: std_msgs/Float64, point and pose: "
        "geometry_msgs/PointStamped and PoseStamped, with x = the state",
        examples=["pose"],
    )

    @property
    def all_fields(self) -> list[str]:
        """One or several."""
        return self.fields or [self.field or ""]


class GraphSource(Section):
    """Where the path of the graphs is: a topic, a file, or one graph that was there all the time."""

    topic: Text | None = Field(None, description="topic with the graph from then on", examples=["/network/active"])
    field: Text | None = Field(
        None,
        description="field with the name of a graph, or its number from 1; a column of a table",
        examples=["data"],
    )
    file: Text | None = Field(
        None,
        description="CSV file of a recorded topology, relative to the map; times in s on the clock of `time`",
        examples=["trace.csv"],
    )
    hold: Positive | None = Field(None, description="with `file`: how long a contact is valid [s]", examples=[1])
    radius: Positive | None = Field(None, description="with `file`: distance of linked agents", examples=[2.5])
    undirected: bool | None = Field(None, description="with `file`: whether the source listens, too", examples=[True])
    fixed: Text | None = Field(None, description="the graph that was there all the time", examples=["line"])
    hidden: Literal[True] | None = Field(None, description="as `graph: hidden`: not in the log", examples=[True])


class Units(Section):
    """How large the units of the law are in the log."""

    time: Seconds = Field(1.0, description="s per unit of simulated time", examples=[1.0])
    state: Scale = Field(1.0, description="units of the log per unit of the law's states", examples=[0.01])


def _graph(value: object) -> object:
    return {"hidden": True} if value == "hidden" else value


def _noise(value: object) -> float | list[float] | str:
    numbers = value if isinstance(value, list) else [value]
    if value == "estimate" or (numbers and all(is_number(each) and each >= 0 for each in numbers)):
        return value  # type: ignore[return-value]
    raise expected("a standard deviation >= 0, one per agent, or 'estimate'")


class LogMap(Section):
    """The map of a log."""

    model_config = ConfigDict(frozen=True, extra="forbid", title="map of a log")

    agents: dict[int | str, Source] = Field(
        min_length=1,
        description="by number or name; '*' for all others, with {i} or {name} in its topic or field",
        examples=[{"*": {"topic": "/robot_{i}/odom", "field": "pose.pose.position.x"}}],
    )
    time: Text = Field(
        "header",
        description="'header' (stamp of the message), 'log' (when it was recorded), or the column of a table",
        examples=["log"],
    )
    period: Seconds | None = Field(
        None, description="use the first sample of each agent in every such time [s]; by default all", examples=[0.1]
    )
    graph: Annotated[
        GraphSource | None,
        BeforeValidator(_graph, json_schema_input_type=GraphSource | Literal["hidden"] | None),
    ] = Field(
        None,
        description="the path of the graphs, or 'hidden': not in the log; may be left out with one graph",
        examples=[{"fixed": "line"}],
    )
    units: Units = Field(Units(), description="units of the law in the log", examples=[{"time": 1.0}])
    measurement_noise: Annotated[
        float | list[float] | str,
        PlainValidator(_noise, json_schema_input_type=NonNegative | list[NonNegative] | Literal["estimate"]),
    ] = Field(0.0, description="standard deviation, one per agent, or 'estimate': from the log", examples=[0.05])
    law: Literal["continuous", "steps"] | None = Field(
        None,
        description="the differential equation, or the steps of length run.dt; by default as the law's `time`",
        examples=["continuous"],
    )

    def sources(self, agents: int, names: Sequence[str] | None = None) -> list[Source]:
        """Of all agents; InputError: the map does not mention one."""
        found = [self.source(number, names[number - 1] if names else str(number)) for number in range(1, agents + 1)]
        missing = [number for number, each in enumerate(found, start=1) if each is None]
        if missing:
            raise InputError(f"agents: {listed(missing)}: not in the map: expected all {agents} agents of the law")
        return [each for each in found if each is not None]

    def source(self, number: int, name: str) -> Source | None:
        """Of the agent with this number, from 1, and name; None: the map does not mention it."""
        for key in (number, str(number), name):
            if key in self.agents:
                return self.agents[key]
        pattern = self.agents.get(EVERY)
        if pattern is None:
            return None

        def filled(text: str | None) -> str | None:
            return text and text.replace(NUMBER, str(number)).replace(NAME, name)

        return Source(
            topic=filled(pattern.topic),
            field=filled(pattern.field),
            fields=pattern.fields and [str(filled(each)) for each in pattern.fields],
            hears=pattern.hears,
        )


def load_map(path: Path) -> LogMap:
    """Read a map; InputError: it cannot be read; ExperimentError: all mistakes."""
    document = read_yaml(path)
    if not isinstance(document, Mapping):
        lines = [problem("map", show(document), "expected keys with values", "start with `agents:`")]
        raise ExperimentError(str(path), lines)
    return parse_map(document, str(path))


def parse_map(document: Mapping[Any, Any], source: str) -> LogMap:
    """Check the document of a map; ExperimentError: all mistakes."""
    try:
        found = LogMap.model_validate(dict(document))
    except ValidationError as error:
        lines = [translate(detail, LogMap) for detail in error.errors(include_url=False)]
        raise ExperimentError(source, lines) from error
    lines = []
    for key, each in found.agents.items():
        if key != EVERY and not is_agent(key):
            lines.append(problem("agents", show(key), "expected agents by number from 1 or name, or '*'", "rename it"))
        if (each.field is None) == (each.fields is None):
            lines.append(problem(f"agents.{key}", "field", "expected one of `field` and `fields`", "give one"))
    pattern = found.agents.get(EVERY)
    if pattern and not any(mark in str(pattern) for mark in (NUMBER, NAME)):
        lines.append(
            problem(f"agents.{EVERY}", "missing {i}", "expected {i} or {name} in the topic or field", "add it")
        )
    texts = Counter(map(str, found.agents))
    lines += [
        problem(f"agents.{key}", "given twice", "expected it once", "remove one") for key in texts if texts[key] > 1
    ]
    if any(len(set(each.all_fields)) < len(each.all_fields) for each in found.agents.values()):
        lines.append(problem("agents", "a field twice", "expected different coordinates of an agent", "remove one"))
    if len({len(each.all_fields) for each in found.agents.values()}) > 1:
        lines.append(problem("agents", "fields", "expected as many coordinates of every agent", "correct them"))
    if found.graph:
        lines += _graph_problems(found.graph)
    if lines:
        raise ExperimentError(source, lines)
    return found


def _graph_problems(graph: GraphSource) -> list[str]:
    kinds = [key for key in ("field", "file", "fixed", "hidden") if getattr(graph, key) is not None]
    if len(kinds) != 1:
        found = ", ".join(kinds) or "none"
        return [
            problem(
                "graph", found, "expected one of `topic` with `field`, `file`, `fixed`, or graph: hidden", "give one"
            )
        ]
    others = [key for key in ("hold", "radius", "undirected") if getattr(graph, key) is not None]
    if others and graph.file is None:
        return [problem(f"graph.{others[0]}", "given", "expected with `file` only", "remove it")]
    if graph.topic is not None and graph.field is None:
        return [problem("graph.topic", graph.topic, "expected with `field` only", "remove it")]
    return []


def json_schema() -> dict[str, Any]:
    """JSON Schema of the map, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | LogMap.model_json_schema()
