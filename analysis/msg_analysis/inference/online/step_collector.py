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

"""Collects single states into whole steps while a network runs."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from msg_analysis.types import FloatArray, IntArray
from msg_analysis.wire.refusals import Refusal

SPREAD = 64  # steps that neighbours can be apart in lockstep
WRITER_HISTORY = 5_000  # states of one agent that may arrive late, after they were sent again
MOST_WAITING = 20_000  # incomplete steps kept, at most


@dataclass(slots=True)
class _Row:
    """What has arrived of one step."""

    payloads: list[bytes | None]  # of the states, and with a log of what was published of them
    left: int  # payloads that are missing
    mode: int  # graph that led to the step, from 1
    messages: list[bytes]  # of the states, where the log is kept; else empty
    usable: bool = True  # False after a contradiction
    used: bool = False
    states: bytes | None = None


class StepCollector:
    """Collects the states of m agents, in any order, into whole steps.

    In lockstep a step is ready only with its successor, which says which graph was used; else graphs are ignored.
    ``logged``: keep the messages, too. ``truth``: a step is whole when what was published of its states is there, too.
    """

    def __init__(
        self, agents: int, modes: int, last: int, *, lockstep: bool, logged: bool = False, truth: bool = False
    ) -> None:
        self._agents, self._modes, self._last, self._lockstep = agents, modes, last, lockstep
        self._logged, self._expected = logged, agents * (2 if truth else 1)
        self._window = min(SPREAD * (agents + 1) + WRITER_HISTORY, MOST_WAITING)
        self._rows: dict[int, _Row] = {}
        self._low = 0  # earlier steps are no longer kept
        self._ready: list[tuple[int, int, bytes, bytes]] = []  # step, mode, states, those after it
        self._log: list[tuple[int, list[bytes], list[bytes]]] = []  # step, messages, what was published
        self._over: int | None = None  # last step of a run that ends early
        self.refused: Counter[str] = Counter()  # states or steps that do not count, by reason
        self.newest = self.whole = -1  # largest step with any state, and with all states; -1: none

    def end_at(self, step: int) -> None:
        """The run ends at this step: what comes after it is not a part of it."""
        self._over = step
        self._rows = {k: row for k, row in self._rows.items() if k <= step}

    def add(
        self, agent: int, step: int, mode: int, payload: bytes, message: bytes = b"", *, published: bool = False
    ) -> None:
        """Take x(step) of an agent (from 0) as little-endian float64, and where the log is kept its message.

        ``mode`` is the graph of the step that led to it, from 1; 0 at step 0. ``published``: the payload is not the
        state, but what was published of it.
        """
        if published:
            agent += self._agents
        row = self._rows.get(step)
        if row is None:
            if self._over is not None and step > self._over:
                return
            if not self._low <= step <= self._last:
                self.refused[Refusal.TOO_LATE if step < self._low else Refusal.OUT_OF_RANGE] += 1
                return
            if step > self.newest:
                self.newest = step
                self._forget(step - self._window)
            messages = [b""] * self._agents if self._logged else []
            row = self._rows[step] = _Row([None] * self._expected, self._expected, mode, messages)
        before = row.payloads[agent]
        if before is not None:
            self.refused[Refusal.REPEATED] += 1
            differs = before != payload or (self._lockstep and mode != row.mode)
            differs |= self._logged and not published and row.messages[agent] != message
            if differs and row.usable:
                row.usable = False  # which copy is genuine is unknown
                self.refused[Refusal.CONTRADICTION] += 1
            return
        row.payloads[agent] = payload
        if self._logged and not published:
            row.messages[agent] = message
        row.left -= 1
        if mode != row.mode and self._lockstep and row.usable:
            row.usable = False
            self.refused[Refusal.OTHER_MODES] += 1
        if not row.left:
            self._complete(step, row)

    def take(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Steps that have become ready since the last call: k (b,), graphs (b,), x(k) and x(k+1) (b, m, width).

        Graphs are those of the step k -> k+1, from 0. Outside lockstep the graphs are 0, and x(k) takes the place of
        x(k+1).
        """
        ready, self._ready = self._ready, []
        steps = np.array([entry[0] for entry in ready], dtype=np.int64)
        modes = np.array([entry[1] - 1 for entry in ready], dtype=np.int64)
        shape = len(ready), self._agents, -1 if ready else 0
        states = np.frombuffer(b"".join([entry[2] for entry in ready]), "<f8").reshape(shape)
        after = np.frombuffer(b"".join([entry[3] for entry in ready]), "<f8").reshape(shape)
        good = np.isfinite(states).all(axis=(1, 2)) & np.isfinite(after).all(axis=(1, 2))
        self.refused[Refusal.NOT_FINITE] += int((~good).sum())
        return steps[good], modes[good], states[good], after[good]

    def take_log(self) -> list[tuple[int, list[bytes], list[bytes]]]:
        """Whole steps since the last call: k, the messages of its states, and what was published of them."""
        log, self._log = self._log, []
        return log

    def _complete(self, step: int, row: _Row) -> None:
        payloads = [payload for payload in row.payloads if payload is not None]
        row.states = b"".join(payloads[: self._agents])
        if self._logged and row.usable:
            self._log.append((step, row.messages, payloads[self._agents :]))
        self.whole = max(self.whole, step)
        if self._lockstep:
            self._pair(step - 1)
            self._pair(step)
        elif row.usable:
            self._ready.append((step, 1, row.states, row.states))
            row.used = True
        while (first := self._rows.get(self._low)) is not None and first.used:
            del self._rows[self._low]
            self._low += 1

    def _pair(self, step: int) -> None:
        """Make a step ready once it and its successor are whole."""
        here, after = self._rows.get(step), self._rows.get(step + 1)
        if here is None or after is None or here.states is None or after.states is None or here.used:
            return
        if here.usable and after.usable and 1 <= after.mode <= self._modes:
            self._ready.append((step, after.mode, here.states, after.states))
        here.used = True

    def _forget(self, low: int) -> None:
        if low - self._low > len(self._rows):  # after a jump: a late reader begins in the middle of the run
            self._rows = {step: row for step, row in self._rows.items() if step >= low}
        else:
            for step in range(self._low, low):
                self._rows.pop(step, None)
        self._low = max(self._low, low)
