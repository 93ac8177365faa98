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
"""How far the clocks of other hosts are from ours, from the times of messages in both directions.

A message sent at time s of its sender's clock and received at time r of ours has taken r - s plus how far the sender's
clock is ahead, which is not negative: so r - s bounds the offset from one side, and the same of the other direction
from the other. The fastest messages bound it best.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

MILLISECOND = 1e6  # ns


@dataclass(slots=True)
class Offset:
    """How far another clock is ahead of ours is between these [ns]; infinite: no message in that direction yet."""

    low: float = -inf
    high: float = inf

    @property
    def least(self) -> float:
        """The smallest distance of the clocks that is possible [ns]."""
        return max(self.low, -self.high, 0.0)


class ClockOffsets:
    """Of the clocks of some nodes, by name."""

    def __init__(self) -> None:
        self._offsets: dict[str, Offset] = {}

    def hear(self, node: str, sent: int, received: int, at_most: float = inf) -> None:
        """A message that a node sent at ``sent`` of its clock came at ``received`` of ours.

        ``at_most``: how far its clock is ahead at most, by what it has heard from here; all in ns.
        """
        offset = self._offsets.setdefault(node, Offset())
        offset.low = max(offset.low, float(sent - received))
        offset.high = min(offset.high, at_most)

    def warning(self, limit: float) -> str | None:
        """Which clocks are certainly more than ``limit`` [ns] from ours, and how far; None: none is."""
        apart = {node: offset for node, offset in self._offsets.items() if offset.least > limit}
        if not apart:
            return None
        worst = max(apart, key=lambda node: apart[node].least)
        ahead = "ahead of" if apart[worst].low > 0 else "behind"
        return (
            f"the clocks of {', '.join(sorted(apart))} are not that of the switcher: {worst} is at least "
            f"{apart[worst].least / MILLISECOND:.1f} ms {ahead} it, more than dt / speed = {limit / MILLISECOND:g} ms: "
            "synchronise the hosts (NTP, PTP)"
        )

    def to_json(self) -> list[dict[str, Any]]:
        """How far each clock is ahead of ours [ms], for JSON; None: not bounded on that side."""
        return [
            {"node": node, "ahead_ms": [_milliseconds(offset.low), _milliseconds(offset.high)]}
            for node, offset in sorted(self._offsets.items())
        ]


def _milliseconds(value: float) -> float | None:
    return None if abs(value) == inf else value / MILLISECOND
