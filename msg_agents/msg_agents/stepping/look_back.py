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

"""The lockstep of an agent whose steps use older values of others: with a delay, or the last one heard. No ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msg_agents.stepping.agent_inputs import Value
from msg_agents.stepping.synchronizer import KEPT_AFTER_USE, RESEND_LIMIT, Synchronizer
from msg_analysis.wire.refusals import Refusal


class LookBackSynchronizer(Synchronizer[Value]):
    """As Synchronizer, but step k uses x_j(``needed``(j, k)), a step that is at most k and does not fall with k.

    Values may come in any order: those that are sent again after a restart come behind newer ones. A value that is
    older than what is kept anyway, and is still needed, is held.
    """

    def __init__(self, *, needed: Callable[[int, int], int], delay: int, **options: Any) -> None:
        self._needed_step = needed
        self._held: dict[int, tuple[int, Value]] = {}  # by place
        self._oldest: list[int] = []  # by place, the step of the value that the next step would use
        super().__init__(kept=max(KEPT_AFTER_USE, delay + 1), **options)
        self._look()

    def _look(self) -> None:
        self._oldest = [self._needed_step(j, self.step) for j in self._places]

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """See Synchronizer."""
        place = self._places.get(agent)
        if place is None:
            return Refusal.NOT_A_PEER
        ahead = step - self.step
        if ahead > self._window + 1:
            return Refusal.TOO_NEW
        known = self._value(place, step)
        if known is not None:
            return Refusal.REPEATED if known == value else Refusal.CONTRADICTION
        if step < self._oldest[place]:  # of no use, but it shows the progress of the peer
            if ahead < -self._window - RESEND_LIMIT:
                return Refusal.TOO_OLD
            if step <= self._newest[agent]:
                return Refusal.REPEATED
        elif ahead >= -self._kept:
            self._row(step)[place] = value
        elif step == self._oldest[place]:  # those between it and the kept ones are never used
            self._held[place] = step, value
        self._newest[agent] = max(self._newest[agent], step)
        if self._needed and self._needed.flags[place] and step == self._oldest[place]:
            self._missing -= 1
        return None

    def known(self, agent: int, step: int) -> Value:
        """See Synchronizer."""
        value = self._value(self._places[agent], step)
        assert value is not None
        return value

    def inputs(self) -> tuple[int, list[Value]]:
        """See Synchronizer: the states x_j(needed(j, step))."""
        assert self._needed is not None
        found = [self._value(place, step) for place, step in enumerate(self._oldest)]
        return self._mode, list(self._needed.pick(found))

    def advance(self) -> None:
        """See Synchronizer."""
        leaving, row = self.step - self._kept, self._row(self.step - self._kept)
        for j, place in self._places.items():
            value = row[place]
            if value is not None and self._needed_step(j, self.step + 1) == leaving:
                self._held[place] = leaving, value
        super().advance()

    def _plan(self) -> None:
        """See Synchronizer."""
        self._look()
        super()._plan()
        if self._needed is not None:
            found = [self._value(place, step) for place, step in enumerate(self._oldest)]
            self._missing = self._needed.pick(found).count(None)

    def _value(self, place: int, step: int) -> Value | None:
        held = self._held.get(place)
        if held is not None and held[0] == step:
            return held[1]
        return self._row(step)[place] if step >= self.step - self._kept else None

    def _next(self, place: int) -> tuple[int, Value | None]:
        """See Synchronizer."""
        return self._oldest[place], self._value(place, self._oldest[place])
