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

"""What the readers of a try, and of a cell, have got, beside what ROS 2 demands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from msg_agents.doctor.qos.cells import Cell
from msg_agents.doctor.qos.semantics import Demand
from msg_analysis.inference.statistics.distributions import binomial_interval

NANOSECONDS = 1e-9  # s
VIOLATIONS = ("missing", "unexpected", "doubled", "out_of_order")


@dataclass(frozen=True, slots=True)
class Received:
    """What one reader got, in this order."""

    numbers: Sequence[int]
    times: Sequence[int]  # ns, of the clock that the writer has, too


@dataclass(slots=True)
class Tally:
    """Counts of messages of one reader, or of several together."""

    due: int = 0  # messages that it may have got
    received: int = 0  # of all messages, copies included
    lost: int = 0  # of those that are due, lawfully or not
    missing: int = 0  # lost, and ROS 2 demands that they come
    unexpected: int = 0  # different ones that it must not get
    doubled: int = 0  # copies
    out_of_order: int = 0  # that came after a newer one
    latencies: list[float] = field(default_factory=list)  # s, of messages published while it read

    def add(self, other: Tally) -> None:
        """Count those of another reader, too."""
        self.due += other.due
        self.received += other.received
        self.lost += other.lost
        self.missing += other.missing
        self.unexpected += other.unexpected
        self.doubled += other.doubled
        self.out_of_order += other.out_of_order
        self.latencies.extend(other.latencies)


def tally_reader(received: Received, sent: Mapping[int, int], demands: Iterable[Demand]) -> Tally:
    """Of one reader.

    ``sent``: time [ns] by number, without messages that the middleware refused to send; ``demands``: of its steps.
    """
    must: set[int] = set()
    may: set[int] = set()
    live: set[int] = set()
    for demand in demands:
        must.update(demand.must)
        may.update(demand.may)
        live.update(demand.may if demand.live else ())
    must, may = must & sent.keys(), may & sent.keys()
    seen: set[int] = set()
    tally = Tally(due=len(may), received=len(received.numbers))
    newest = -1
    for number, time in zip(received.numbers, received.times, strict=True):
        if number in seen:
            tally.doubled += 1
            continue
        seen.add(number)
        if number < newest:
            tally.out_of_order += 1
        newest = max(newest, number)
        if number in live and number in sent:
            tally.latencies.append((time - sent[number]) * NANOSECONDS)
    tally.lost = len(may - seen)
    tally.missing = len(must - seen)
    tally.unexpected = len(seen - may)
    return tally


@dataclass(slots=True)
class Try:
    """One try: one topic with all its readers."""

    sent: int = 0
    refused: int = 0  # messages that the middleware did not take from the writer
    tally: Tally = field(default_factory=Tally)
    counts: bool = True  # not if the processes did not find each other, or were stopped for too long


@dataclass(frozen=True, slots=True)
class CellResult:
    """All tries of one cell."""

    cell: Cell
    tries: Sequence[Try]

    @property
    def made(self) -> list[Try]:
        """Tries that count."""
        return [each for each in self.tries if each.counts]

    @property
    def total(self) -> Tally:
        """All readers together."""
        total = Tally()
        for each in self.made:
            total.add(each.tally)
        return total

    def tries_with(self, what: str) -> int:
        """How many tries have a message that was lost, missing, doubled, ..."""
        return sum(getattr(each.tally, what) > 0 for each in self.made)

    @property
    def violating(self) -> int:
        """How many tries contradict ROS 2."""
        return sum(any(getattr(each.tally, what) for what in VIOLATIONS) for each in self.made)

    def to_json(self) -> dict[str, Any]:
        """As docs/qos.md describes it."""
        made, total = len(self.made), self.total
        reliability, durability, history, reader, readers = self.cell.words
        return {
            "reliability": reliability,
            "durability": durability,
            "history": history,
            "reader": reader,
            "readers": readers,
            "tries": made,
            "not_counted": len(self.tries) - made,
            "sent": sum(each.sent for each in self.made),
            "refused": sum(each.refused for each in self.made),
            "due": total.due,
            "received": total.received,
            "lost": total.lost,
            **{what: getattr(total, what) for what in VIOLATIONS},
            "latency": {name: quantile(total.latencies, p) for name, p in (("median", 0.5), ("p99", 0.99), ("max", 1))},
            "tries_with_loss": rate(self.tries_with("lost"), made),
            "tries_with_violation": rate(self.violating, made),
            "violations": [what for what in VIOLATIONS if getattr(total, what)],
        }


def rate(count: int, tries: int) -> dict[str, Any]:
    """A count of tries, and the 95 % interval of the probability."""
    low, high = binomial_interval(count, tries) if tries else (0.0, 1.0)
    return {"count": count, "low": low, "high": high}


def quantile(values: Sequence[float], p: float) -> float | None:
    """The smallest value that is not exceeded by at least this part of them; None without values."""
    return sorted(values)[max(math.ceil(p * len(values)) - 1, 0)] if values else None
