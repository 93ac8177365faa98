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

"""What the verdict names as the cause of a disagreement: marked in every picture, and drawn first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Accused:
    """Agents (from 1), links and jumps that the causes name, the first cause first."""

    agents: tuple[int, ...] = ()  # by themselves
    links: tuple[tuple[int, int, str | None], ...] = ()  # sender, receiver or two ends; graph, None: all graphs
    pairs: tuple[tuple[int, int], ...] = ()  # with correlated noise
    jumps: tuple[tuple[str, str | None], ...] = ()  # from a graph to another, None: to any

    @classmethod
    def of(cls, blame: Sequence[Mapping[str, Any]]) -> Accused:
        """Of the causes of a comparison's document."""
        links = [(cause, tuple(cause["link"])) for cause in blame if cause["link"]]
        return cls(
            tuple(dict.fromkeys(cause["agent"] for cause in blame if cause["agent"] is not None)),
            tuple((*ends, cause["graph"]) for cause, ends in links if cause["kind"] != "correlation"),
            tuple(ends for cause, ends in links if cause["kind"] == "correlation"),
            tuple(
                (cause["graph"][0], cause["graph"][1] if len(cause["graph"]) > 1 else None)
                for cause in blame
                if cause["kind"] == "switching" and cause["graph"]
            ),
        )

    @property
    def involved(self) -> list[int]:
        """The agents, and those at the ends of the links."""
        ends = [end for ends in self.entries for end in ends]
        return list(dict.fromkeys([*self.agents, *ends]))

    @property
    def entries(self) -> list[tuple[int, int]]:
        """The two ends of each link, and the pairs."""
        return [*((first, second) for first, second, _ in self.links), *self.pairs]

    def links_of(self, graph: str) -> set[tuple[int, int]]:
        """The links in a graph."""
        return {(first, second) for first, second, where in self.links if where in (None, graph)}

    def jump(self, origin: str, to: str) -> bool:
        """Whether the jump from one graph to another is named."""
        return any(first == origin and second in (None, to) for first, second in self.jumps)


NOBODY = Accused()
