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

"""Which processes of a random network are killed or stopped, and when: only what ``docs/faults.md`` says the end of."""

from __future__ import annotations

import random
from dataclasses import asdict, dataclass
from typing import Any

from msg_agents.processes.environment import RESTARTS
from msg_agents.processes.process_plan import RECORDER, SWITCHER
from msg_analysis.wire.topics import agent_name

LATEST = 0.7  # of the steps: later, the run might be over before the fault
LONGEST_WAIT = 0.1  # s between a step and the fault: steps are reported ten times a second
LONGEST_STOP = 1.5  # s
ONE_ENDS_IN = 8  # networks


@dataclass(frozen=True, slots=True)
class Fault:
    """One process is killed, or stopped for a while."""

    node: str  # one of those of the process
    step: int  # that all agents have reached before; -1: the processes have been started
    wait: float  # s after that
    stopped: float | None = None  # s between SIGSTOP and SIGCONT; None: SIGKILL

    @property
    def kills(self) -> bool:
        """Whether the process is killed."""
        return self.stopped is None

    def to_json(self) -> dict[str, Any]:
        """As docs/commands.md describes it."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """The faults of one run, and how many restarts it may make."""

    faults: tuple[Fault, ...]
    restarts: int

    @property
    def survivable(self) -> bool:
        """Whether the run goes on after all of them, and is complete."""
        killed = [fault.node for fault in self.faults if fault.kills]
        return RECORDER not in killed and len(killed) <= self.restarts


def plan_faults(seed: int, agents: int, steps: int) -> FaultPlan:
    """The faults of the network of a seed."""
    draw = random.Random(f"faults {seed}")
    peers = [SWITCHER, *(agent_name(agent) for agent in range(agents))]
    kills = draw.choices(range(RESTARTS + 1), [1, 3, 3, 2])[0]
    victims: list[tuple[str, float | None]] = [(draw.choice(peers), None) for _ in range(kills)]
    for _ in range(draw.choices(range(3), [2, 2, 1])[0]):
        victims.append((draw.choice([*peers, RECORDER]), draw.uniform(0.05, LONGEST_STOP)))
    restarts = RESTARTS
    if draw.randrange(ONE_ENDS_IN) == 0:  # the run cannot go on
        if draw.random() < 0.5:
            victims.append((RECORDER, None))
        else:
            victims.append((draw.choice(peers), None))
            restarts = kills
    faults = [Fault(node, _moment(draw, steps), draw.uniform(0.0, LONGEST_WAIT), stop) for node, stop in victims]
    return FaultPlan(tuple(sorted(faults, key=lambda fault: fault.step)), restarts)


def _moment(draw: random.Random, steps: int) -> int:
    return -1 if draw.random() < 0.15 else draw.randint(0, round(LATEST * steps))
