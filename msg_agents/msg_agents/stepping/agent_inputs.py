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

"""What one agent knows of the others, in lockstep and in real time. No ROS, no arithmetic, no clock."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Generic, TypeVar

Value = TypeVar("Value")
NOTHING = -1  # in place of a step: no state received yet


class AgentInputs(Generic[Value]):
    """Steps count from 0; x(0) is the start, the run ends at x(steps). Agents count from 0, in texts from 1."""

    def __init__(
        self,
        *,
        agent: int,
        steps: int,  # N
        inputs: Sequence[Sequence[int]],  # per mode, the other agents that the agent's row uses, ascending
        peers: Collection[int],  # every other agent that it ever hears or is heard by; includes ``inputs``
        start: int = 0,  # the current step, after a takeover
    ) -> None:
        self.agent, self.step, self.steps = agent, start, steps
        self._inputs = [tuple(row) for row in inputs]
        self._newest = dict.fromkeys(sorted(peers), NOTHING)  # newest step received of each peer
        missing = {j for row in inputs for j in row} - self._newest.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, which are not among its peers {sorted(peers)}")

    def end_at(self, steps: int) -> None:
        """The run ends early, at x(steps); not before the current step."""
        self.steps = max(steps, self.step)

    @property
    def finished(self) -> bool:
        """Whether x(steps) has been reached."""
        return self.step >= self.steps
