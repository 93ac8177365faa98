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

"""What ROS 2 demands of a cell: which messages its readers must get, and which they may get.

Sources: [ROS] "Quality of Service settings" of the ROS 2 documentation; [DDS] OMG Data Distribution Service 1.4.
The rules themselves, each with its source, are in docs/qos.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from msg_agents.doctor.qos.cells import Reader
from msg_analysis.wire.topics import Qos


class Action(Enum):
    """What happens to the readers between two series of messages."""

    JOIN = "join"
    KILL = "kill"
    STOP = "stop"
    CONTINUE = "continue"


Step = Action | range
"""An action, or the numbers of messages that are published."""

FEW, OVER_1000 = 40, 1200  # messages of a try: more than the reader and the writer keep, except if they keep all
BEFORE, AFTER = 10, 10  # of ``FEW``, while a reader that is killed or stopped still reads, and reads again
LONG_BEFORE, LONG_AFTER = 50, 50  # of ``OVER_1000``


@dataclass(frozen=True, slots=True)
class Demand:
    """Of the messages that a reader can have got by a step, and not before."""

    must: range
    may: range  # those that it must get included; all others it must not get
    live: bool = False  # they are published while it reads


def steps_of(reader: Reader, depth: int | None) -> list[Step]:
    """What is done in one try."""
    long = depth is None or depth >= FEW
    count, before, after = (OVER_1000, LONG_BEFORE, LONG_AFTER) if long else (FEW, BEFORE, AFTER)
    middle = range(before, count - after)
    last = range(count - after, count)
    match reader:
        case "first" | "slow":
            return [Action.JOIN, range(count)]
        case "late":
            return [range(count - after), Action.JOIN, last]
        case "killed":
            return [Action.JOIN, range(before), Action.KILL, middle, Action.JOIN, last]
        case "stopped":
            return [Action.JOIN, range(before), Action.STOP, middle, Action.CONTINUE, last]


def demands_of(qos: Qos, steps: Sequence[Step]) -> list[Demand | None]:
    """The demand of each step; None where no reader can have got anything new.

    A reader that is killed and comes back is a new reader. The readers get what a step demands before the next one.
    """
    found: list[Demand | None] = []
    published, held, running, there = range(0), range(0), False, False
    for step in steps:
        demand = None
        match step:
            case Action.JOIN:
                running = there = True
                held = range(0)
                # [DDS] 2.2.3.4: a volatile writer keeps nothing for readers that it does not know; one that is
                # transient local keeps, for late readers, what its history has.
                kept = newest(published, qos.depth) if qos.latched else range(0)
                demand = _demand(kept, kept, qos)
            case Action.KILL:
                running = there = False
            case Action.STOP:
                running = False
            case Action.CONTINUE:
                running = True
                demand, held = _demand(newest(held, qos.depth), held, qos), range(0)
            case range():
                published = range(step.stop)
                if running:
                    demand = _demand(newest(step, qos.depth), step, qos, live=True)
                elif there:
                    held = step
        found.append(demand)
    return found


def newest(messages: range, depth: int | None) -> range:
    """Those that a history of this depth keeps. [DDS] 2.2.3.18: keep last discards the older ones."""
    return messages if depth is None else messages[-depth:]


def _demand(kept: range, given: range, qos: Qos, *, live: bool = False) -> Demand:
    # [DDS] 2.2.3.14: with reliable, all that the writer's history has is delivered; with best effort, it is acceptable
    # that nothing is sent again.
    return Demand(kept if qos.reliable else range(0), given, live)
