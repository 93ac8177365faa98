# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The keys of the experiment file beside graphs and noise: every key, its type, its default and what it means.

Only what one value can tell by itself is checked here; ``validation`` checks what needs several keys.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator

from msg_analysis.experiment.network_spec import (
    Agent,
    AgentName,
    Count,
    GraphName,
    GraphSpec,
    NoiseSpec,
    Number,
    Positive,
    Section,
    SwitchingSpec,
    expected,
    is_agent,
    is_count,
    is_number,
)


def _start(value: object) -> str | list[float] | dict[int | str, float]:
    if isinstance(value, str) and value in ("stationary", "zero"):
        return value
    if isinstance(value, list) and all(is_number(entry) for entry in value):
        return [float(entry) for entry in value]
    if isinstance(value, dict) and value and all(map(is_agent, value)) and all(map(is_number, value.values())):
        return {agent: float(entry) for agent, entry in value.items()}
    raise expected("'stationary', 'zero' or a list of one finite number per agent, or numbers by agent")


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


class LeadersSpec(Section):
    """The agents that know the reference (tracking only)."""

    agents: list[Agent] = Field(min_length=1, description="the leaders, by number or name", examples=[[3]])
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
        0.05, description="simulated time of a step; 0.05 by default, always 1 in discrete time", examples=[0.05]
    )
    duration: Positive = Field(100.0, description="simulated time units, a whole number of steps", examples=[400.0])
    replicas: Count = Field(1, description="independent copies of every state under the same graphs", examples=[16])
    seed: Annotated[int, Field(strict=True, ge=0)] = Field(
        0, description="of everything random in the run", examples=[7]
    )
    start: Annotated[
        str | list[float] | dict[int | str, float],
        PlainValidator(
            _start, json_schema_input_type=Literal["stationary", "zero"] | list[Number] | dict[AgentName, Number]
        ),
    ] = Field(
        "stationary",
        description="'stationary', 'zero', one value per agent, or values by agent (others 0)",
        examples=["stationary"],
    )
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
        str | int, PlainValidator(_processes, json_schema_input_type=Literal["auto", "one_per_agent"] | Count)
    ] = Field("auto", description="'auto', 'one_per_agent' or a number of processes", examples=["auto"])

    @property
    def steps(self) -> int:
        """Number of steps."""
        return round(self.duration / self.dt)


Purpose = Literal["predict", "run"]


class ExperimentSpec(Section):
    """A Markov switching network and a run of it."""

    name: str = Field(
        pattern="^[a-z][a-z0-9_]*$", description="a name for bags and topics, [a-z][a-z0-9_]*", examples=["line_ring"]
    )
    problem: Literal["consensus", "tracking"] = Field(
        "consensus", description="agree with each other, or follow leaders", examples=["consensus"]
    )
    time: Literal["continuous", "discrete"] = Field(
        "continuous",
        description="continuous: Euler steps of run.dt; discrete: W = exp(-Z), one step = 1",
        examples=["continuous"],
    )
    agents: Annotated[int, Field(strict=True, ge=2)] | None = Field(
        None, description="number of agents; by default the largest number in any graph", examples=[5]
    )
    names: list[AgentName] | None = Field(
        None,
        min_length=2,
        description="names of the agents in the order of their numbers, shown instead of these; by default those of "
        "the nodes in graph files",
        examples=[["north", "south"]],
    )
    graphs: dict[GraphName, GraphSpec] = Field(
        min_length=1,
        description="named graphs; their order is the order of the modes",
        examples=[{"line": {"path": [1, 2, 3]}}],
    )
    switching: SwitchingSpec = Field(
        default_factory=SwitchingSpec, examples=[{"generator": [[-0.5, 0.5], [0.5, -0.5]]}]
    )
    noise: NoiseSpec = Field(default_factory=NoiseSpec, examples=[{"process": 1.0}])
    protocol: ProtocolSpec | None = Field(
        None,
        description="what agents do, from an installed package, with parameters of its own; default: the built-in law",
        examples=[{"name": "metropolis"}],
    )
    leaders: LeadersSpec | None = Field(None, examples=[{"agents": [3], "gain": 1.0, "reference": 0.0}])
    run: RunSpec = Field(default_factory=RunSpec, examples=[{"dt": 0.05, "duration": 400}])


def json_schema() -> dict[str, Any]:
    """JSON Schema of the experiment file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | ExperimentSpec.model_json_schema()
