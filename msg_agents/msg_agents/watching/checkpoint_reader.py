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

import numpy as np

from msg_agents.recovery.checkpoint import MARK, room_for
from msg_analysis.model.arithmetic.step_clock import SECOND
from msg_analysis.model.run.record import RunRecord
from msg_analysis.types import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.wire.messages import STATE_HEAD, STATE_MODE
from msg_analysis.wire.receiving import state_frame
from msg_analysis.wire.topics import agent_name

BLOCK = 2000
"""Steps that are taken at once: limits the memory that a large network needs."""


class CheckpointReader:
    """Reads whole steps from the checkpoints of the agents, each at most once, in order."""

    def __init__(self, record: RunRecord, directory: Path) -> None:
        experiment = record.experiment
        self._directory, self._agents, self._width = directory, experiment.agents, experiment.width
        size = state_frame(record, whole=True).size
        self._total, self._slot = room_for(size), size + MARK.size
        self._size, self._capacity = size, self._total // self._slot
        self._rings: list[AnyArray] = []  # (capacity, slot) bytes of each agent
        self._next = 0
        self.missed = 0  # steps that were overwritten before or while they were read

    def ready(self) -> bool:
        """Whether every agent has its checkpoint; opens them when they are there."""
        if not self._rings:
            paths = [self._directory / f"{agent_name(agent)}.states" for agent in range(self._agents)]
            if not all(path.exists() and path.stat().st_size == self._total for path in paths):
                return False
            self._rings = [self._open(path) for path in paths]
        return True

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
        if not count:
            none = np.empty(0, np.int64)
            return none, none, np.empty((0, self._agents, self._width)), np.empty((0, self._agents, self._width))
        steps = np.arange(self._next, last + 1)
        states, modes = np.empty((count + 1, self._agents, self._width)), np.empty(0, np.int64)
        there: BoolArray = np.ones(count + 1, dtype=bool)
        for agent, ring in enumerate(self._rings):
            states[:, agent], said, whole = self._read(ring, steps)
            modes = said if agent == 0 else modes
            there &= whole
        self._next = last
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

    def _read(self, ring: AnyArray, steps: IntArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """States (b, width), modes from 1 (b,), and whether the slots still held these steps (b,)."""
        slots = steps % self._capacity
        data = ring[slots]
        marks = np.ascontiguousarray(data[:, self._size :]).view("<u8")
        again = np.ascontiguousarray(ring[slots, self._size :]).view("<u8")
        whole = (marks[:, 1] == steps + 1) & (again[:, 1] == steps + 1)
        lengths = np.where(whole, marks[:, 0], self._size).astype(np.int64)
        # The state ends the message, whose length depends on what was heard.
        columns = lengths[:, None] - 8 * self._width + np.arange(8 * self._width)
        states = np.take_along_axis(data, columns, axis=1).view("<f8")
        modes = np.ascontiguousarray(data[:, STATE_MODE : STATE_MODE + 4]).view("<u4")[:, 0]
        return states, modes.astype(np.int64), whole
