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

"""One thing that is wrong with a run, in words and numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

CauseKind = Literal[
    "frozen",
    "graph",
    "gain",
    "ignored",
    "reference",
    "offset",
    "noise",
    "correlation",
    "lag",
    "outlier",
    "stale",
    "switching",
    "sojourns",
    "loss",
    "broadcast",
    "unknown",
]


@dataclass(frozen=True, slots=True)
class Cause:
    """One thing that is wrong."""

    kind: CauseKind
    words: str  # a sentence
    agent: int | None = None  # from 1; None where the cause is not one agent
    link: tuple[int, int] | None = None  # from 1: sender and receiver, or the two ends of an edge or of a correlation
    graph: str | list[str] | None = None  # name; for switching [from, to] or [from]; None: all graphs
    estimate: float | None = None  # measured: factor of a gain or variance, share, rate, correlation or value
    interval: tuple[float, float] | None = None  # 95 %, for this cause alone
    expected: float | None = None  # the same according to the experiment; 1 for a factor
    p: float | None = None  # adjusted for all candidate causes; 0 where the law makes it impossible
    steps: tuple[int, int] | None = None  # first and last, where the cause is a stretch of the run

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "kind": self.kind,
            "words": self.words,
            "agent": self.agent,
            "link": list(self.link) if self.link else None,
            "graph": self.graph,
            "estimate": self.estimate,
            "interval": list(self.interval) if self.interval else None,
            "expected": self.expected,
            "p": self.p,
            "steps": list(self.steps) if self.steps else None,
        }


def numbers_text(value: float, interval: tuple[float, float]) -> str:
    """A number and its interval."""
    return f"{value:#.3g} ({interval[0]:#.3g} to {interval[1]:#.3g})"
