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

"""Keys of the noise, and of what is lost or late between the agents."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import PydanticCustomError

from msg_analysis.model.spec.values import (
    LARGEST_COUNT,
    NAME_PATTERN,
    AgentName,
    GraphName,
    Label,
    Matrix,
    NonNegative,
    Number,
    Probability,
    Section,
    expected,
    is_count,
    is_number,
)

LARGEST_BURST = 1e6  # messages: what an agent that restarts has to draw again grows with it
NoiseGain = float | list[float] | list[list[float]]


def _lossy_link(value: object) -> tuple[int | str, int | str, float]:
    wanted = expected("[agent, agent, probability], agents by number or name, 0 <= probability < 1")
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise wanted
    first, second, probability = value
    for agent in (first, second):
        if not (is_count(agent) or (isinstance(agent, str) and re.match(NAME_PATTERN, agent))):
            raise wanted
    if not is_number(probability) or not 0 <= probability < 1:
        raise wanted
    return (first, second, float(probability))


def _loss(value: object, section: ValidatorFunctionWrapHandler) -> Any:
    """The section; a number stands for one with nothing but a default."""
    if isinstance(value, dict | LossSpec):
        return section(value)
    if not is_number(value):
        raise expected("a probability, or keys with probabilities: default, edges, arcs")
    if not 0 <= value < 1:  # type: ignore[operator]
        raise expected("a number >= 0" if value < 0 else "a number < 1")  # type: ignore[operator]
    return section({"default": value})


def _process(value: object) -> NoiseGain | dict[str, NoiseGain]:
    if not isinstance(value, dict):
        return _noise_gain(value)
    gains, faults = {}, []
    for name, gain in value.items():
        try:
            gains[str(name)] = _noise_gain(gain)
        except PydanticCustomError as error:
            faults.append(f"for graph {name} {error.message().removeprefix('expected ')}")
    if faults:
        raise expected(" and ".join(faults))
    return gains


def _noise_gain(value: object) -> NoiseGain:
    if is_number(value):
        if value < 0:  # type: ignore[operator]
            raise expected("a standard deviation >= 0")
        return float(value)  # type: ignore[arg-type]
    if isinstance(value, list) and value and all(is_number(entry) for entry in value):
        if min(value) < 0:
            raise expected("standard deviations >= 0")
        return [float(entry) for entry in value]
    rows = value if isinstance(value, list) else []
    if rows and all(isinstance(row, list) and all(is_number(entry) for entry in row) for row in rows):
        return [[float(entry) for entry in row] for row in rows]
    raise expected("a finite number, one per agent, or a square matrix F (Q = F F^T)")


LossyLinks = list[
    Annotated[
        tuple[int | str, int | str, float],
        BeforeValidator(_lossy_link, json_schema_input_type=tuple[Label | AgentName, Label | AgentName, Probability]),
    ]
]


class LossSpec(Section):
    """The probability that a message is lost, by link."""

    default: Probability = Field(0.0, description="of all links that are not listed", examples=[0.1])
    edges: LossyLinks = Field(
        [], description="of links in both directions: [agent, agent, probability]", examples=[[[1, 2, 0.5]]]
    )
    arcs: LossyLinks = Field(
        [],
        description="of links in one direction: [1, 2, 0.5] means messages from agent 1 to agent 2",
        examples=[[[1, 2, 0.5]]],
    )

    @property
    def any(self) -> bool:
        """Whether a message of some link can be lost."""
        return self.default > 0 or any(probability > 0 for *_, probability in (*self.edges, *self.arcs))

    def short(self) -> Any:
        """What a file would have: the number alone where all links have the same."""
        links = {key: found for key in ("edges", "arcs") if (found := getattr(self, key))}
        return {"default": self.default, **links} if links else self.default


_Gain = NonNegative | list[NonNegative] | Matrix


class NoiseSpec(Section):
    """What is random besides the graphs."""

    process: Annotated[
        NoiseGain | dict[str, NoiseGain],
        PlainValidator(_process, json_schema_input_type=_Gain | dict[GraphName, _Gain]),
    ] = Field(
        1.0,
        description="noise gain: a number, one per agent, or the matrix F with Q = F F^T; or one of these for every "
        "graph by name",
        examples=[1.0],
    )
    broadcast: NonNegative = Field(0.0, description="standard deviation added to each published value", examples=[0.0])
    link: NonNegative = Field(0.0, description="standard deviation added by each receiver", examples=[0.0])
    loss: Annotated[
        LossSpec,
        WrapValidator(_loss, json_schema_input_type=Probability | LossSpec),
        PlainSerializer(LossSpec.short, return_type=Any),
    ] = Field(
        LossSpec(), description="probability that a directed message is lost; a number, or by link", examples=[0.0]
    )
    on_loss: Literal["own", "hold"] = Field(
        "own",
        description="what an agent uses in place of a lost value: its own, or the last value that it heard",
        examples=["hold"],
    )
    burst: Annotated[Number, Field(ge=1, le=LARGEST_BURST)] | None = Field(
        None,
        description="mean number of messages of a link that are lost in a row; by default losses are independent",
        examples=[5],
    )
    delay: Annotated[int, Field(strict=True, ge=0, le=LARGEST_COUNT)] = Field(
        0, description="age, in steps, of the values of others that a step uses", examples=[0]
    )

    @property
    def on_air(self) -> bool:
        """Whether there is broadcast noise, link noise or loss between the agents."""
        return bool(self.broadcast or self.link or self.loss.any)

    @property
    def holds(self) -> bool:
        """Whether messages can be lost, and the last value heard takes the place of a lost one."""
        return self.loss.any and self.on_loss == "hold"

    @property
    def steps_only(self) -> bool:
        """Whether there is noise on the air, loss or delay, which only steps can have."""
        return self.on_air or self.delay > 0
