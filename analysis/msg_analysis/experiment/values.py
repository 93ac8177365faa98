# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Values of keys in the experiment file: numbers, agents, and numbers by link."""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, TypeGuard

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import PydanticCustomError

LARGEST_NUMBER = 1e100  # so that no sum or product of two numbers overflows
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
LARGEST_COUNT = 2**32 - 1  # messages carry agents as uint32
Count = Annotated[int, Field(strict=True, ge=1, le=LARGEST_COUNT)]
Label = Count
NAME_PATTERN = r"^\S(.{0,62}\S)?$"
GraphName = Annotated[str, Field(pattern=NAME_PATTERN)]
AgentName = Annotated[str, Field(pattern=NAME_PATTERN)]
Probability = Annotated[Number, Field(ge=0, lt=1)]
Matrix = list[list[Number]]


def _agent(value: object, number: ValidatorFunctionWrapHandler) -> Any:
    """A number, or the name of an agent, which becomes its number once the names are known."""
    return value if isinstance(value, str) and re.match(NAME_PATTERN, value) else number(value)


Agent = Annotated[Label, WrapValidator(_agent, json_schema_input_type=Label | AgentName)]


def expected(text: str) -> PydanticCustomError:
    """The error of a value that is not what ``text`` says, such as "a number > 0"."""
    return PydanticCustomError("expected", "{text}", {"text": text})


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a number, not a boolean, of at most ``LARGEST_NUMBER``."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER


def is_count(value: object) -> bool:
    """Whether a value is a whole number from 1 to ``LARGEST_COUNT``."""
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= LARGEST_COUNT


class Section(BaseModel):
    """A part of the file; a key that it does not have is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


Link = tuple[int, int, float]
WrittenLink = tuple[int | str, int | str, float]  # with names of agents, too


def is_agent(value: object) -> bool:
    """Whether it is the number of an agent, or may be its name."""
    return is_count(value) or (isinstance(value, str) and re.match(NAME_PATTERN, value) is not None)


def parts(value: object, counts: tuple[int, ...], wanted: str) -> list[Any]:
    """A list of so many entries that begins with two agents; else ``wanted`` says what was expected."""
    if not isinstance(value, list | tuple) or len(value) not in counts or not all(map(is_agent, value[:2])):
        raise expected(wanted)
    return list(value)


End = Label | AgentName
LinkValue = tuple[int | str, int | str, float]


def _link_value(value: object, *, what: str, most: float) -> LinkValue:
    wanted = f"[agent, agent, {what}], agents by number or name, 0 <= {what}" + f" < {most:g}" * (most < LARGEST_NUMBER)
    first, second, found = parts(value, (3,), wanted)
    if not is_number(found) or not 0 <= found < most:
        raise expected(wanted)
    return (first, second, float(found))


_lossy_link = partial(_link_value, what="probability", most=1.0)
_switching_link = partial(_link_value, what="rate", most=LARGEST_NUMBER)
_Losses = list[Annotated[LinkValue, BeforeValidator(_lossy_link, json_schema_input_type=tuple[End, End, Probability])]]
_Rates = list[
    Annotated[LinkValue, BeforeValidator(_switching_link, json_schema_input_type=tuple[End, End, NonNegative])]
]


class _ByLink(Section):
    """A number for every link."""

    if TYPE_CHECKING:
        default: float
        edges: list[LinkValue]
        arcs: list[LinkValue]

    @property
    def any(self) -> bool:
        """Whether that of some link is not 0."""
        return self.default > 0 or any(value > 0 for *_, value in (*self.edges, *self.arcs))

    def short(self) -> Any:
        """What a file would have: the number alone where all links have the same."""
        links = {key: found for key in ("edges", "arcs") if (found := getattr(self, key))}
        return {"default": self.default, **links} if links else self.default


class LossSpec(_ByLink):
    """The probability that a message is lost, by link."""

    default: Probability = Field(0.0, description="of all links that are not listed", examples=[0.1])
    edges: _Losses = Field(
        [], description="of links in both directions: [agent, agent, probability]", examples=[[[1, 2, 0.5]]]
    )
    arcs: _Losses = Field(
        [],
        description="of links in one direction: [1, 2, 0.5] means messages from agent 1 to agent 2",
        examples=[[[1, 2, 0.5]]],
    )


class RateSpec(_ByLink):
    """How fast links switch: rates in continuous time, probabilities of a step in discrete time."""

    default: NonNegative = Field(0.0, description="of all links that are not listed", examples=[0.5])
    edges: _Rates = Field([], description="of undirected links: [agent, agent, rate]", examples=[[[1, 2, 0.5]]])
    arcs: _Rates = Field(
        [], description="of links in one direction: [1, 2, 0.5] means that from agent 1 to 2", examples=[[[1, 2, 0.5]]]
    )


def _loss(value: object, section: ValidatorFunctionWrapHandler) -> Any:
    """The section; a number stands for one with nothing but a default."""
    if isinstance(value, dict | LossSpec):
        return section(value)
    if not is_number(value):
        raise expected("a probability, or keys with probabilities: default, edges, arcs")
    if not 0 <= value < 1:
        raise expected("a number >= 0" if value < 0 else "a number < 1")
    return section({"default": value})


def _rate(value: object, section: ValidatorFunctionWrapHandler) -> Any:
    if not isinstance(value, dict | RateSpec):
        if not is_number(value) or value < 0:
            raise expected("a rate >= 0, or keys with rates: default, edges, arcs")
        value = {"default": value}
    return section(value)


_short = PlainSerializer(_ByLink.short, return_type=Any)
Loss = Annotated[LossSpec, WrapValidator(_loss, json_schema_input_type=Probability | LossSpec), _short]
Rate = Annotated[RateSpec, WrapValidator(_rate, json_schema_input_type=NonNegative | RateSpec), _short]
