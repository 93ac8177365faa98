"""States of a running network, read where its agents keep them for whoever takes over from them.

Nothing is sent for it, and nobody waits: it costs the network no more than the time of the processor that reads.
"""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np

from msg_agents.processes.process_plan import agent_name
from msg_agents.recovery.checkpoint import MARK, longest_heard, room_for
from msg_analysis.model.run.record import RunRecord
from msg_analysis.types import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.wire.messages import STATE_MODE, StateFrame

BLOCK = 2000
"""Steps that are taken at once: what comes of a large network stays small in memory."""


class Tap:
    """Reads whole steps out of the checkpoints of the agents, each at most once, in order.

    Parameters
    ----------
    record
        of the run
    directory
        of the checkpoints

    Attributes
    ----------
    missed
        steps that had been written over before they were read
    """

    def __init__(self, record: RunRecord, directory: Path) -> None:
        experiment = record.experiment
        self._directory, self._agents, self._width = directory, experiment.agents, experiment.width
        size = StateFrame(record.run.bytes, experiment.width, longest_heard(record)).size
        self._total, self._slot = room_for(size), size + MARK.size
        self._size, self._capacity = size, self._total // self._slot
        self._rings: list[AnyArray] = []  # (capacity, slot) bytes of each agent
        self._next = 0
        self.missed = 0

    def ready(self) -> bool:
        """Whether every agent has its checkpoint; they are opened then."""
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
        """Steps that all agents have made since the last time; not all of them, if they are many.

        Parameters
        ----------
        reached
            the newest state that every agent has published

        Returns
        -------
        tuple[IntArray, IntArray, FloatArray, FloatArray]
            steps : (b,) k modes : (b,) graph from 0 of the step k -> k+1, as the first agent says; in real time others
            may say otherwise states, after : (b, m, width) x(k), x(k+1)
        """
        oldest = max(reached - self._capacity // 2, 0)  # what is older may be written over while it is read
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

    def _read(self, ring: AnyArray, steps: IntArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """(b, width) states, (b,) modes from 1, and whether they are those of these steps."""
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
