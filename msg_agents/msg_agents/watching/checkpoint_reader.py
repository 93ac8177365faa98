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

"""Reads the states of a running network from the checkpoint files of its agents.

Nothing is sent and nothing waits: the network pays only for the CPU time of the reader.
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msg_agents.recovery.checkpoint import MARK, entry_size, published_size, room_for
from msg_analysis.model.arithmetic.step_clock import SECOND
from msg_analysis.model.run.record import RunRecord
from msg_analysis.types import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.wire.messages import STATE_HEAD, STATE_MODE
from msg_analysis.wire.topics import agent_name

if TYPE_CHECKING:
    from msg_analysis.inference.online.logged_states import LoggedStates, StateLog

BLOCK = 2000
"""Steps that are taken at once: limits the memory that a large network needs."""


class CheckpointReader:
    """Reads whole steps from the checkpoints of the agents, each at most once, in order."""

    def __init__(self, record: RunRecord, directory: Path) -> None:
        experiment = record.experiment
        self._directory, self._agents, self._width = directory, experiment.agents, experiment.width
        size, self._beside = entry_size(record), published_size(record)
        self._total, self._slot = room_for(size), size + MARK.size
        self._size, self._capacity = size, self._total // self._slot
        self._rings: list[AnyArray] = []  # (capacity, slot) bytes of each agent
        self._next = 0
        self._log: StateLog | None = None
        self._logged: LoggedStates | None = None
        self.missed = 0  # steps that were overwritten before or while they were read

    def ready(self) -> bool:
        """Whether every agent has its checkpoint; opens them when they are there."""
        if not self._rings:
            paths = [self._directory / f"{agent_name(agent)}.states" for agent in range(self._agents)]
            if not all(path.exists() and path.stat().st_size == self._total for path in paths):
                return False
            self._rings = [self._open(path) for path in paths]
        return True

    def keep(self, log: StateLog) -> None:
        """From now on, ``logged`` has the steps that are taken."""
        self._log = log

    def logged(self) -> LoggedStates | None:
        """The steps of the last ``take``, from the first one to the one after the last; None: there were none."""
        return self._logged

    def _open(self, path: Path) -> AnyArray:
        with path.open("rb") as file:
            ring = np.frombuffer(mmap.mmap(file.fileno(), self._total, access=mmap.ACCESS_READ), np.uint8)
        return ring.reshape(self._capacity, self._slot)

    def take(self, reached: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """The next steps that all agents have made, at most ``BLOCK``; ``reached``: newest state of all agents.

        Returns steps k (b,), modes from 0 of k -> k+1 (b,), x(k) (b, m, width), x(k+1) (b, m, width). Modes are those
        of the first agent; in real time others may have used another graph.
        """
        oldest = max(reached - self._capacity // 2, 0)  # older ones may be overwritten while they are read
        if self._next < oldest:
            self.missed += oldest - self._next
            self._next = oldest
        last = min(reached, self._next + BLOCK)
        count = max(last - self._next, 0)
        self._logged = None
        if not count:
            none = np.empty(0, np.int64)
            return none, none, np.empty((0, self._agents, self._width)), np.empty((0, self._agents, self._width))
        steps = np.arange(self._next, last + 1)
        states, modes = np.empty((count + 1, self._agents, self._width)), np.empty(0, np.int64)
        there: BoolArray = np.ones(count + 1, dtype=bool)
        entries, lengths = [], []
        for agent, ring in enumerate(self._rings):
            data, length, whole = self._read(ring, steps)
            states[:, agent] = self._numbers(data, length - self._beside, self._width)
            if agent == 0:
                modes = np.ascontiguousarray(data[:, STATE_MODE : STATE_MODE + 4]).view("<u4")[:, 0].astype(np.int64)
            if self._log is not None:
                entries.append(data)
                lengths.append(length)
            there &= whole
        self._next = last
        if self._log is not None:
            self._logged = self._read_log(steps, entries, lengths, there)
        good = there[:-1] & there[1:] & (modes[1:] >= 1)
        self.missed += int((~good).sum())
        return steps[:-1][good], modes[1:][good] - 1, states[:-1][good], states[1:][good]

    def stamps(self, steps: IntArray) -> IntArray:
        """Stamps [ns] of these states of every agent, (b, m); -1 where a slot does not hold its step."""
        slots, found = steps % self._capacity, []
        for ring in self._rings:
            head = np.ascontiguousarray(ring[slots, : STATE_HEAD.itemsize]).view(STATE_HEAD)[:, 0]
            stamp = head["seconds"].astype(np.int64) * SECOND + head["nanoseconds"]
            mark = np.ascontiguousarray(ring[slots, self._size :]).view("<u8")[:, 1]
            found.append(np.where(mark == steps + 1, stamp, -1))
        return np.stack(found, axis=1)

    def _read(self, ring: AnyArray, steps: IntArray) -> tuple[AnyArray, IntArray, BoolArray]:
        """Slots (b, slot), lengths of the entries in them (b,), and whether they still held these steps (b,)."""
        slots = steps % self._capacity
        data = ring[slots]
        marks = np.ascontiguousarray(data[:, self._size :]).view("<u8")
        again = np.ascontiguousarray(ring[slots, self._size :]).view("<u8")
        whole = (marks[:, 1] == steps + 1) & (again[:, 1] == steps + 1)
        return data, np.where(whole, marks[:, 0], self._size).astype(np.int64), whole

    @staticmethod
    def _numbers(data: AnyArray, end: IntArray, count: int) -> FloatArray:
        """(b, count): the numbers in the slots (b, slot) that end there (b,): messages differ in length."""
        columns = end[:, None] - 8 * count + np.arange(8 * count)
        return np.asarray(np.take_along_axis(data, columns, axis=1).view("<f8"))

    def _read_log(
        self, steps: IntArray, entries: list[AnyArray], lengths: list[IntArray], there: BoolArray
    ) -> LoggedStates:
        """The whole ones of these steps, from the slots (b, slot) of every agent."""
        assert self._log is not None
        data = np.stack([entry[there] for entry in entries], axis=1)  # (b, m, slot)
        length = np.stack([each[there] for each in lengths], axis=1)
        published = b""
        if self._beside:
            flat = data.reshape(-1, self._slot)
            published = self._numbers(flat, length.reshape(-1), self._beside // 8).tobytes()
        start = np.arange(length.size) * self._slot
        return self._log.read(steps[there], data.tobytes(), start, length.reshape(-1) - self._beside, published)
