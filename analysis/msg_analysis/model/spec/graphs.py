# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Keys of the graphs, and of the Markov chain that switches between them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field

from msg_analysis.model.spec.values import (
    Count,
    Label,
    Matrix,
    NonNegative,
    Positive,
    Section,
    expected,
    is_count,
    is_number,
)

Link = tuple[int, int, float]


def _link(value: object) -> Link:
    wanted = expected("[agent, agent] or [agent, agent, weight], agents from 1, the weight a number > 0")
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise wanted
    first, second = value[:2]
    for label in (first, second):
        if not is_count(label):
            raise wanted
    weight = value[2] if len(value) == 3 else 1.0
    if not is_number(weight) or weight <= 0:
        raise expected("a weight > 0 as the third entry")
    return (first, second, float(weight))


def _rows(value: object) -> object:
    return value.tolist() if hasattr(value, "tolist") else value  # an array of numpy


def _grid(value: object) -> object:
    sizes = value if isinstance(value, list | tuple) else ()
    if len(sizes) != 2 or not all(is_count(size) for size in sizes):
        raise expected("[rows, columns], two whole numbers >= 1")
    return value


Links = list[
    Annotated[
        Link,
        BeforeValidator(_link, json_schema_input_type=tuple[Label, Label] | tuple[Label, Label, Positive]),
    ]
]


class Star(Section):
    """A star: every agent is connected with the centre."""

    center: Label = Field(description="the agent in the middle", examples=[1])


class GraphSpec(Section):
    """One graph, given in one of these ways. Agents are numbered from 1."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    path: list[Label] | None = Field(None, min_length=2, description="agents along a line", examples=[[1, 2, 3]])
    cycle: list[Label] | None = Field(None, min_length=3, description="agents around a ring", examples=[[1, 2, 3]])
    edges: Links | None = Field(
        None,
        description="undirected: [i, j] or [i, j, weight], weight 1 by default",
        examples=[[[1, 2], [2, 3, 0.5]]],
    )
    arcs: Links | None = Field(
        None,
        description="directed: [1, 2, 0.5] means that agent 2 listens to agent 1",
        examples=[[[1, 2], [2, 3, 0.5]]],
    )
    star: Star | None = Field(None, description="a star with its centre", examples=[{"center": 1}])
    complete: Literal[True] | None = Field(None, description="every agent with every other agent", examples=[True])
    grid: Annotated[tuple[Count, Count], BeforeValidator(_grid)] | None = Field(
        None, description="[rows, columns], agents row by row", examples=[[3, 4]]
    )
    graphml: str | None = Field(
        None,
        min_length=1,
        description="a GraphML file, relative to the experiment file; node ids that are whole numbers are the agents' "
        "numbers, others their names; edge attribute 'weight', default 1",
        examples=["network.graphml"],
    )
    csv: str | None = Field(
        None,
        min_length=1,
        description="a CSV file, relative to the experiment file, with the header source,target[,weight][,type]; "
        "target listens to source; nodes as with graphml; type directed (default) or undirected",
        examples=["edges.csv"],
    )
    adjacency: Annotated[list[list[NonNegative]], BeforeValidator(_rows)] | None = Field(
        None,
        min_length=2,
        description="square matrix: row i has the weights with which agent i listens to the others, 0: not at all",
        examples=[[[0, 1], [1, 0]]],
    )

    @property
    def kinds(self) -> list[str]:
        """Ways in which this graph is given (one, in a valid file)."""
        return [key for key in type(self).model_fields if getattr(self, key) is not None]


class SwitchingSpec(Section):
    """The Markov chain that switches between the graphs. May be left out where there is one graph."""

    generator: Matrix | None = Field(
        None,
        description="continuous time: rates between the graphs in file order; every row sums to 0",
        examples=[[[-0.5, 0.5], [0.5, -0.5]]],
    )
    rates: dict[str, dict[str, NonNegative]] | None = Field(
        None,
        description="continuous time: rates by name, from: {to: rate}; left out = 0",
        examples=[{"line": {"ring": 1.0}, "ring": {"line": 1.0}}],
    )
    scale: Positive = Field(1.0, description="multiplies the rates", examples=[0.5])
    transition: Matrix | None = Field(
        None,
        description="discrete time: probabilities between the graphs in file order; every row sums to 1",
        examples=[[[0.9, 0.1], [0.2, 0.8]]],
    )
    initial: str = Field("stationary", description="'stationary' or a graph's name", examples=["stationary"])
