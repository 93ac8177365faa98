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

"""Types of the values in an experiment file, each with its limits; errors of values that do not fit."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field
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


def expected(text: str) -> PydanticCustomError:
    """The error of a value that is not what ``text`` says, such as "a number > 0"."""
    return PydanticCustomError("expected", "{text}", {"text": text})


def is_number(value: object) -> bool:
    """Whether a value is a number, not a boolean, of at most ``LARGEST_NUMBER``."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER


def is_count(value: object) -> bool:
    """Whether a value is a whole number from 1 to ``LARGEST_COUNT``."""
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= LARGEST_COUNT


class Section(BaseModel):
    """A part of the file; a key that it does not have is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")
