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

"""When a run may end before its duration: `--until` of `msg-agents run`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

from msg_analysis.errors import InputError

DECIDED = "decided"
DECIDED_PRECISION = 0.05
"""Precision at which ``decided`` ends a run that the evidence does not contradict."""


@dataclass(frozen=True, slots=True)
class Until:
    """The run ends when the interval of the system error is narrow enough, or its evidence disagrees."""

    precision: float  # half-width of the interval that holds at all times at once, over the system error
    decided: bool = False  # whether it also ends when the evidence passes 1 / level

    @classmethod
    def parse(cls, text: str, source: str = "--until") -> Self:
        """``decided``, or a precision such as ``1%``; InputError: neither."""
        if text == DECIDED:
            return cls(DECIDED_PRECISION, decided=True)
        found = re.fullmatch(r"([0-9]*\.?[0-9]+) ?%", text)
        if not found or not 0.0 < float(found[1]) < 100.0:
            raise InputError(
                f"{source}: {text!r}: expected a precision in percent, above 0 and below 100, such as 1%, or {DECIDED}"
            )
        return cls(float(found[1]) / 100.0)

    def __str__(self) -> str:
        return DECIDED if self.decided else f"{100.0 * self.precision:.12g}%"
