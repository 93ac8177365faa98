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

"""What the channel did, counted per ordered pair of hosts; the file in which its process says so."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from msg_analysis.common.files import write_whole


@dataclass(slots=True)
class PairCounts:
    """Packets from one host to another."""

    sent: int = 0  # packets that the sender gave to the channel
    bytes: int = 0  # of these
    lost: int = 0  # at random
    queued: int = 0  # that waited while others were sent
    dropped: int = 0  # because the queue was full
    cut: int = 0  # because no active link joined the hosts


@dataclass(slots=True)
class ChannelCounts:
    """Of one run."""

    pairs: dict[tuple[str, str], PairCounts] = field(default_factory=dict)  # by sender and receiver
    overflowed: int = 0  # packets that the process was too slow to take
    late_mean: float = 0.0  # ms by which packets were passed on later than the link says
    late_most: float = 0.0  # ms

    def to_json(self) -> dict[str, Any]:
        """As in the result of a run."""
        names = PairCounts.__slots__
        return {
            "pairs": [
                {"sender": sender, "receiver": receiver} | {name: getattr(counts, name) for name in names}
                for (sender, receiver), counts in self.pairs.items()
            ],
            "overflowed": self.overflowed,
            "late_ms": {"mean": self.late_mean, "max": self.late_most},
        }

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_whole(path, json.dumps(self.to_json()).encode())


def read_counts(path: Path) -> dict[str, Any] | None:
    """The newest counts of a channel, as JSON; None if it has written none."""
    with suppress(OSError, ValueError):
        found: dict[str, Any] = json.loads(path.read_bytes())
        return found
    return None
