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

"""What an agent uses in real time: the newest values it has. No ROS, no arithmetic, no clock.

The agent makes each step when it is due: with the newest graph that it knows and the newest value that it has of every
neighbour under that graph. Nothing waits, so nothing is buffered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from msg_agents.stepping.agent_inputs import NOTHING, AgentInputs, Value
from msg_analysis.wire.refusals import Refusal


class NewestValues(AgentInputs[Value]):
    """The newest values of one agent; ``reach`` gives the newest step that any agent can have reached by now.

    Newer states are refused. Other options as in AgentInputs.
    """

    def __init__(self, *, reach: Callable[[], int], **options: Any) -> None:
        super().__init__(**options)
        self._reach = reach
        self._reached = NOTHING  # what ``reach`` gave when it was asked last: a clock is not read for every message
        self._values: dict[int, Value] = {}
        self._mode: int | None = None
        self._first_step = NOTHING  # of the newest sojourn

    def learn(self, mode: int, first_step: int) -> str | None:
        """Take a sojourn of the run's path as the newest; None if taken, else a ``Refusal``.

        One may be missing before it: it was over before it arrived here.
        """
        if first_step <= self._first_step:
            return Refusal.REPEATED
        if not self._within_reach(first_step):
            return Refusal.TOO_EARLY
        self._mode, self._first_step = mode, first_step
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step) unless a newer one is known; None if taken, else a ``Refusal``."""
        newest = self._newest.get(agent)
        if newest is None:
            return Refusal.NOT_A_PEER
        if step <= newest:
            differs = step == newest and self._values.get(agent, value) != value
            return Refusal.CONTRADICTION if differs else Refusal.REPEATED
        if step > self.steps or not self._within_reach(step):
            return Refusal.TOO_NEW
        self._newest[agent] = step
        self._values[agent] = value
        return None

    def _within_reach(self, step: int) -> bool:
        if step > self._reached:
            self._reached = self._reach()
        return step <= self._reached

    def known(self, agent: int) -> Value:
        """The newest value of an agent."""
        return self._values[agent]

    def review(self) -> None:
        """Drop what is beyond ``reach``: it was taken before the epoch was known."""
        reach = self._reached = self._reach()
        for j, step in self._newest.items():
            if step > reach:
                self._newest[j] = NOTHING
                self._values.pop(j)
        if self._first_step > reach:
            self._mode, self._first_step = None, NOTHING

    def ready(self) -> bool:
        """Whether the next step can be made when it is due."""
        return self._mode is not None and self.step < self.steps

    def inputs(self) -> tuple[int, list[tuple[int, Value | None]]]:
        """Mode of the due step; step and value of the state to use of each agent that its row uses, ascending.

        ``(NOTHING, None)`` where the agent's own value is to be used.
        """
        assert self._mode is not None, "not ready"
        return self._mode, [self._used(j) for j in self._inputs[self._mode]]

    def _used(self, agent: int) -> tuple[int, Value | None]:
        return self._newest[agent], self._values.get(agent)

    def advance(self) -> None:
        """Count the due step as made."""
        self.step += 1

    def waiting_for(self) -> str:
        """What keeps the agent from making steps when they are due, as text."""
        if self.finished:
            return "nothing, it has finished"
        return "the first graph" if self._mode is None else "nothing"

    @property
    def behind(self) -> dict[int, int]:
        """For each peer, how many steps its newest value is older than the agent's own state."""
        return {j: self.step - newest for j, newest in self._newest.items()}


class NewestOnAir(NewestValues[Value]):
    """The same with messages that are lost, or ``delay`` steps old.

    Of an agent with a newest state x(n), a step uses the newest of those up to x(n - delay), and the own value where
    that one is ``lost`` (of agent and step) or nothing came; with ``holds``, the newest of these that is not lost.
    """

    def __init__(self, *, delay: int, lost: Callable[[int, int], bool], holds: bool, **options: Any) -> None:
        super().__init__(**options)
        self._delay, self._lost, self._holds = delay, lost, holds
        self._kept: dict[int, deque[tuple[int, Value]]] = {j: deque() for j in self._newest}

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """See NewestValues."""
        refusal = super().offer(agent, step, value)
        if refusal is None and not (self._holds and self._lost(agent, step)):
            self._kept[agent].append((step, value))
            self._forget(agent)
        return refusal

    def review(self) -> None:
        """See NewestValues."""
        super().review()
        for j, kept in self._kept.items():
            if self._newest[j] == NOTHING:
                kept.clear()

    def _forget(self, agent: int) -> int:
        """Drop what is older than the state to use; the newest step that may be used."""
        kept, usable = self._kept[agent], max(0, self._newest[agent] - self._delay)
        while len(kept) > 1 and kept[1][0] <= usable:
            kept.popleft()
        return usable

    def _used(self, agent: int) -> tuple[int, Value | None]:
        usable, kept = self._forget(agent), self._kept[agent]
        if not kept or kept[0][0] > usable or (not self._holds and self._lost(agent, kept[0][0])):
            return NOTHING, None
        return kept[0]
