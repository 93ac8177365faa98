# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""State messages as columns: those in the agents' own layout are decoded a batch at a time.

Other valid layouts (big-endian, with a ``frame_id``) are first encoded again in the agents' own.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from msg_analysis.arithmetic.step_clock import SECOND
from msg_analysis.bags.mcap_chunks import gather
from msg_analysis.bags.stored_file import Batch
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.messages.cdr import LITTLE_ENDIAN, CdrError
from msg_analysis.messages.messages import STATE_HEAD, STATE_SIZE, AgentState

_ENCAPSULATION = struct.unpack("<I", LITTLE_ENDIAN)[0]


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States in the order of the bag, still in the bytes of their batch, from which the columns are taken on demand."""

    data: bytes  # messages in the agents' own layout
    start: IntArray  # (messages,) offset of the CDR bytes
    head: AnyArray  # (messages,) of type ``STATE_HEAD``
    replicas: IntArray  # (messages,) length of ``state``
    position: IntArray  # (messages,) place among the bag's messages of this kind, from 0

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, index: AnyArray | slice) -> States:
        """Some of them, by an array of indices or of bools, or by a slice."""
        return States(self.data, self.start[index], self.head[index], self.replicas[index], self.position[index])

    def of_run(self, run: tuple[int, int]) -> BoolArray:
        """(messages,) whether they are of the run with this :func:`run_number`."""
        found = self.head["run"]
        return np.asarray((found[:, 0] == run[0]) & (found[:, 1] == run[1]))

    @property
    def agent(self) -> IntArray:
        """(messages,) as sent, from 1."""
        return np.asarray(self.head["agent"].astype(np.int64))

    @property
    def step(self) -> IntArray:
        """(messages,) clipped to the range of int64."""
        return np.asarray(np.minimum(self.head["step"], np.uint64(2**63 - 1)).astype(np.int64))

    @property
    def mode(self) -> IntArray:
        """(messages,) as sent, from 1; 0 at step 0."""
        return np.asarray(self.head["mode"].astype(np.int64))

    @property
    def stamp(self) -> IntArray:
        """(messages,) [ns]."""
        return np.asarray(self.head["seconds"].astype(np.int64) * SECOND + self.head["nanoseconds"])

    @property
    def heard_count(self) -> IntArray:
        """(messages,) length of ``heard``."""
        return np.asarray(self.head["heard_count"].astype(np.int64))

    def heard(self, most: int) -> AnyArray:
        """(messages, most) the first entries of ``heard``, uint64; 0 beyond its end."""
        out = np.zeros((len(self), most), np.uint64)
        length = np.minimum(self.heard_count, most)
        for size in np.unique(length[length > 0]).tolist():
            alike = length == size
            values = gather(self.data, self.start[alike] + STATE_HEAD.itemsize, 8 * size).view("<u8")
            out[alike, :size] = values.reshape(-1, size)
        return out

    def state(self, width: int) -> FloatArray:
        """(messages, width) of states that all have this length."""
        if not width:
            return np.empty((len(self), 0))
        values = gather(self.data, self.start + STATE_SIZE + 8 * self.heard_count, 8 * width).view("<f8")
        return np.asarray(values.reshape(len(self), width), dtype=np.float64)

    def alone(self) -> States:
        """The same with bytes of their own, so that those of the batch can be freed."""
        size = STATE_SIZE + 8 * (self.heard_count + self.replicas)
        ranges = zip(self.start.tolist(), (self.start + size).tolist(), strict=True)
        data = b"".join([self.data[first:end] for first, end in ranges])
        return States(data, np.cumsum(size) - size, self.head, self.replicas, self.position)


def run_number(run: bytes) -> tuple[int, int]:
    """The 16 bytes of a run id as two little-endian uint64, by which :class:`States` tells runs apart."""
    first, second = struct.unpack("<QQ", run)
    return first, second


def decode_states(batch: Batch, chosen: IntArray, position: int) -> tuple[States, int]:
    """The messages with the indices ``chosen``, (k,), of a batch as states, and how many of them are not an AgentState.

    ``position`` is the place in the bag of the first of them.
    """
    start, size = batch.start[chosen], batch.size[chosen]
    place = position + np.arange(len(chosen))
    states, fixed = own_layout(batch.data, start, size, place)
    if fixed.all():
        return states, 0
    data, pieces, end = batch.data, [], len(batch.data)
    for index in np.flatnonzero(~fixed).tolist():
        try:
            piece = _in_own_layout(batch.message(int(chosen[index])))
        except CdrError:
            continue
        fixed[index], start[index], size[index] = True, end, len(piece)
        pieces.append(piece)
        end += len(piece)
    states, _ = own_layout(b"".join((data, *pieces)), start[fixed], size[fixed], place[fixed])
    return states, len(chosen) - len(states)


def own_layout(data: bytes, start: IntArray, size: IntArray, position: IntArray) -> tuple[States, BoolArray]:
    """The messages that have the agents' own layout, and (messages,) which ones have it.

    Their offsets and sizes in ``data``, and their places in the bag, are (messages,) each.
    """
    fixed = size >= STATE_SIZE
    long = start if fixed.all() else np.where(fixed, start, 0)
    if len(data) < STATE_SIZE:
        return States(data, start[:0], np.empty(0, STATE_HEAD), start[:0], start[:0]), np.zeros(len(start), np.bool_)
    head = gather(data, long, STATE_HEAD.itemsize).view(STATE_HEAD)
    fixed &= (head["encapsulation"] == _ENCAPSULATION) & (head["frame_size"] == 1) & (head["frame_end"] == 0)
    numbers, count = size - STATE_SIZE, head["heard_count"].astype(np.int64)
    fixed &= numbers & 7 == 0
    replicas = (numbers >> 3) - count
    fixed &= replicas >= 0
    behind = np.where(fixed, start + STATE_HEAD.itemsize + 8 * count, 0)
    fixed &= gather(data, behind, 4).view("<u4") == replicas
    states = States(data, start, head, replicas, position)
    return states if fixed.all() else states[fixed], fixed


def _in_own_layout(data: bytes) -> bytes:
    """The same message as the agents would have written it; CdrError where it is not an AgentState."""
    message = AgentState.decode(data)
    own = AgentState(
        *(message.stamp, message.run, message.agent, message.step, message.mode, message.state, message.heard)
    )
    try:
        return own.encode().ljust(STATE_SIZE + 8 * len(message.heard), b"\x00")  # no padding before an empty state
    except struct.error as error:
        raise CdrError("AgentState.header: a time out of range") from error
