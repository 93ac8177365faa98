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

"""The result of one check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from msg_analysis.errors import InputError

Status = Literal["ok", "warning", "error"]  # error: a run cannot work


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the doctor: what was found, and, unless it is ok, what to do."""

    name: str
    status: Status
    text: str
    value: float | None = None  # what was measured, in the unit that docs/commands.md names

    def to_json(self) -> dict[str, Any]:
        """As docs/commands.md describes it."""
        return asdict(self)


def warn_if(name: str, warning: str | None, text: str, value: float | None = None) -> Check:
    """A warning if there is one, else ok with the text."""
    return Check(name, "warning" if warning else "ok", warning or text, value)


def refusal(name: str, require: Callable[[], object]) -> Check | None:
    """The error by which a run would refuse this machine or shell; None if it would not."""
    try:
        require()
    except InputError as error:
        return Check(name, "error", str(error))
    return None
