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

"""Keys of the leaders, of laws from other packages, and of the run."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator, ValidatorFunctionWrapHandler, WrapValidator

from msg_analysis.model.spec.values import (
    NAME_PATTERN,
    AgentName,
    Count,
    Label,
    Number,
    Positive,
    Section,
    expected,
    is_count,
    is_number,
)


def _start(value: object) -> str | list[float]:
    if isinstance(value, str) and value in ("stationary", "zero"):
        return value
    if isinstance(value, list) and all(is_number(entry) for entry in value):
        return [float(entry) for entry in value]
    raise expected("'stationary', 'zero' or a list of one finite number per agent")


def _processes(value: object) -> str | int:
    if isinstance(value, str) and value in ("auto", "one_per_agent"):
        return value
    if isinstance(value, int) and is_count(value):
        return value
    raise expected("'auto', 'one_per_agent' or a whole number >= 1")


def _gain(value: object) -> float:
    if value in ("inf", ".inf") or (isinstance(value, float) and value == math.inf):
        return math.inf
    if is_number(value) and value > 0:  # type: ignore[operator]
        return float(value)  # type: ignore[arg-type]
    raise expected("a number > 0, or inf for leaders held at the reference")


def _leader(value: object, number: ValidatorFunctionWrapHandler) -> Any:
    """A number, or the name of an agent, which becomes its number once the names are known."""
    return value if isinstance(value, str) and re.match(NAME_PATTERN, value) else number(value)


class LeadersSpec(Section):
    """The agents that know the reference (tracking only)."""

    agents: list[Annotated[Label, WrapValidator(_leader, json_schema_input_type=Label | AgentName)]] = Field(
        min_length=1, description="the leaders, by number or name", examples=[[3]]
    )
    gain: Annotated[
        float,
        PlainValidator(_gain, json_schema_input_type=Positive | Literal["inf"]),
        PlainSerializer(lambda gain: "inf" if math.isinf(gain) else gain, return_type=Any),
    ] = Field(1.0, description="pull towards the reference; inf = held at it", examples=[1.0])
    reference: Number = Field(0.0, description="the value to track", examples=[0.0])


class ProtocolSpec(Section):
    """A law of agents that a package offers, instead of the built-in one. Keys next to its name are its parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    name: str = Field(min_length=1, description="the name under which the package offers it", examples=["metropolis"])


class RunSpec(Section):
    """How long, how often and how to run."""

    dt: Positive = Field(
        0.05,
        description="simulated time of a step; 0.05 by default, always 1 in discrete time",
        examples=[0.05],
    )
    duration: Positive = Field(100.0, description="simulated time units, a whole number of steps", examples=[400.0])
    replicas: Count = Field(1, description="independent copies of every state under the same graphs", examples=[16])
    seed: Annotated[int, Field(strict=True, ge=0)] = Field(
        0, description="of everything random in the run", examples=[7]
    )
    start: Annotated[
        str | list[float],
        PlainValidator(_start, json_schema_input_type=Literal["stationary", "zero"] | list[Number]),
    ] = Field("stationary", description="'stationary', 'zero' or one value per agent", examples=["stationary"])
    pace: Literal["lockstep", "realtime"] = Field(
        "lockstep",
        description="lockstep: as fast as it goes, deterministic; realtime: every agent on its own timer",
        examples=["lockstep"],
    )
    speed: Positive = Field(1.0, description="realtime: simulated time units per second of the clock", examples=[1.0])
    delivery: Literal["reliable", "best_effort"] | None = Field(
        None,
        description="realtime: how agents hear each other. best_effort, the default: what is lost is not sent again; "
        "reliable: it is, and later values wait for it. In lockstep always reliable",
        examples=["best_effort"],
    )
    processes: Annotated[
        str | int,
        PlainValidator(_processes, json_schema_input_type=Literal["auto", "one_per_agent"] | Count),
    ] = Field("auto", description="'auto', 'one_per_agent' or a number of processes", examples=["auto"])

    @property
    def steps(self) -> int:
        """Number of steps."""
        return round(self.duration / self.dt)
