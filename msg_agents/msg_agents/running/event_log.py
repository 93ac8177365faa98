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

"""When, in steps, processes of a run were killed and were back, and messages were first refused."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from msg_agents.processes.status_file import Account

_ACCOUNT_EVERY = 1.0  # s between two looks at the files of refused messages


class EventLog:
    """Appends dictionaries with "kind", "step", "node" and "words" to a list.

    The kind is "killed", "back" or "refused". The step is that of the node that was killed, else the newest of all.
    """

    def __init__(self, events: list[dict[str, Any]], clock: Callable[[], float] = time.monotonic) -> None:
        self._events, self._clock = events, clock
        self._absent: dict[str, tuple[Sequence[int], int]] = {}  # by node: its agents from 0, their step
        self._refused: set[tuple[str, str, str]] = set()
        self._next_account = clock()
        self._newest = 0

    def killed(self, node: str, agents: Sequence[int], step: int, words: str) -> None:
        """Note that a process, with these agents (from 0), has ended after this step.

        One without agents, such as the switcher, is not known to be back: it makes no steps.
        """
        if agents:
            self._absent[node] = agents, step
        self._add("killed", step if agents else self._newest, node, words)

    def look(self, steps: Sequence[int], account: Callable[[], Account], *, last: bool = False) -> None:
        """Note who is back and what is refused, given the newest step of every agent; ``last``: at the end."""
        newest = self._newest = max(steps, default=0)
        for node, (agents, step) in list(self._absent.items()):
            if steps and min(steps[agent] for agent in agents) > step:
                del self._absent[node]
                self._add("back", newest, node, f"{node}: back")
        if self._clock() < self._next_account and not last:
            return
        self._next_account = self._clock() + _ACCOUNT_EVERY
        for key in sorted(set(account().refused) - self._refused):
            self._refused.add(key)
            node, topic, reason = key
            self._add("refused", newest, node, f"{node}: refused on {topic}: {reason} (first noticed)")

    def _add(self, kind: str, step: int, node: str, words: str) -> None:
        self._events.append({"kind": kind, "step": max(step, 0), "node": node, "words": words})
