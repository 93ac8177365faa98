# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A file of a bag, whatever its storage: its topics, and its messages in batches that numpy can work on.

rosbag2 can compress each message by itself (compression mode `message`); such messages are unpacked here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zstandard
from mcap.records import Attachment, Channel, Metadata, Schema

from msg_analysis.bags.mcap_chunks import MESSAGE_HEAD, RECORD_LIMIT, DamageError, gather
from msg_analysis.common.arrays import AnyArray, BoolArray, IntArray
from msg_analysis.errors import BagError

# Unpacked bytes for every byte of the file, at most, and those that any file may have. States shrink to two thirds,
# those of a run without noise to a two hundredth.
MOST_EXPANSION = 1000
FREE_EXPANSION = 2**26
MOST_CHANNELS = 2**13  # of a file: writing the metadata of each topic takes a tenth of a millisecond
_ZSTD_FRAME = b"\x28\xb5\x2f\xfd"  # first bytes; no CDR message begins like that
_UNPACKED = 2**22  # bytes of a batch of messages that were unpacked one by one


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages in the order of the file; the CDR bytes of each lie behind the rest of its record in ``data``."""

    data: bytes
    start: IntArray  # (messages,) offset of the CDR bytes in ``data``
    size: IntArray  # (messages,) number of CDR bytes
    head: AnyArray  # (messages,) of type ``MESSAGE_HEAD``
    end: int  # bytes of the file up to the end of the chunk, or of the last record, of these messages

    @classmethod
    def of_contents(cls, data: bytes, start: IntArray, size: IntArray, end: int) -> Batch:
        """A batch from the offsets and sizes, (messages,), of the contents of its message records in ``data``.

        DamageError: a record too short for a message, or a time of 2^63 ns or more.
        """
        if (size < MESSAGE_HEAD.itemsize).any():
            raise DamageError
        head = gather(data, start, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
        if no_time(head).any():
            raise DamageError
        return cls(data, start + MESSAGE_HEAD.itemsize, size - MESSAGE_HEAD.itemsize, head, end)

    @property
    def channel(self) -> AnyArray:
        """(messages,) channel number."""
        return np.asarray(self.head["channel"])

    @property
    def table(self) -> IntArray:
        """(messages, 6) int64: channel number, sequence, log time [ns], publish time [ns], start, size."""
        columns = [self.head[name].astype(np.int64) for name in MESSAGE_HEAD.names or ()]
        return np.column_stack((*columns, self.start, self.size))

    def message(self, index: int) -> bytes:
        """CDR bytes of the message at an index of the batch."""
        start = int(self.start[index])
        return self.data[start : start + int(self.size[index])]


@dataclass(slots=True)
class StoredFile:
    """A file to be read once, by iterating over ``batches()``; what is said of it is true of the part that was read."""

    path: Path
    channels: dict[int, Channel] = field(default_factory=dict)  # by number
    schemas: dict[int, Schema] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    profile: str = ""
    library: str = ""
    whole_bytes: int = 0  # length of the whole records so far, with the magic bytes; of a .zstd file, unpacked
    torn: str | None = None  # what is there instead of the end of the file, known when all is read
    damaged_chunks: int = 0  # chunks (of sqlite3: rows) that are left out
    unpacked_messages: int = 0  # messages that were compressed one by one
    _expanded: int = 0  # unpacked bytes so far

    def batches(self) -> Iterator[Batch]:
        """The messages of all whole records; BagError: not such a file, empty, or one that cannot be read."""
        for batch in self._stored():
            packed = _packed(batch)
            if packed.any():
                yield from self._unpack(batch, packed)
            else:
                yield batch

    def _stored(self) -> Iterator[Batch]:
        """The messages as they are in the file."""
        raise NotImplementedError

    def add_channel(self, channel: Channel) -> None:
        """Take a topic; BagError: too many."""
        self.channels[channel.id] = channel
        if len(self.channels) > MOST_CHANNELS:
            raise BagError(f"{self.path}: more than {MOST_CHANNELS} topics: record the topics of the run alone")

    def count_expanded(self, size: int, end: int) -> None:
        """Count bytes unpacked from the first ``end`` bytes of the file; BagError: far too many."""
        self._expanded += size
        if self._expanded > MOST_EXPANSION * end + FREE_EXPANSION:
            raise BagError(
                f"{self.path}: {self._expanded >> 20} MB in chunks of {end >> 10} kB: expected at most "
                f"{MOST_EXPANSION} times as much: the file is damaged, or made to fill the memory"
            )

    def _unpack(self, batch: Batch, packed: BoolArray) -> Iterator[Batch]:
        """The same messages unpacked, in several batches if they are large; one that cannot be unpacked stays."""
        zstd = zstandard.ZstdDecompressor()
        pieces: list[bytes] = []
        filled = first = 0
        for index, compressed in enumerate(packed.tolist()):
            piece = batch.message(index)
            if compressed:
                piece = self._message(piece, zstd, batch.end)
            pieces.append(piece)
            filled += len(piece)
            last = index + 1 == len(packed)
            if filled > _UNPACKED or last:
                # All but the last batch end before the chunk does: more of it follows.
                yield batch_of(pieces, batch.head[first : index + 1], batch.end if last else batch.end - 1)
                pieces, filled, first = [], 0, index + 1

    def _message(self, piece: bytes, zstd: zstandard.ZstdDecompressor, end: int) -> bytes:
        try:
            size = zstandard.frame_content_size(piece)
            if not 0 <= size <= RECORD_LIMIT:
                return piece
            self.count_expanded(size, end)
            unpacked: bytes = zstd.decompress(piece, max_output_size=size)
        except zstandard.ZstdError:
            return piece
        self.unpacked_messages += 1
        return unpacked


def batch_of(pieces: list[bytes], head: AnyArray, end: int) -> Batch:
    """A batch of messages that are not in one buffer yet; ``head``, (messages,), and ``end`` as in ``Batch``."""
    size = np.array([len(piece) for piece in pieces], dtype=np.int64)
    return Batch(b"".join(pieces), np.cumsum(size) - size, size, head, end)


def _packed(batch: Batch) -> BoolArray:
    """(messages,) whether they are compressed one by one."""
    octets = np.frombuffer(batch.data, np.uint8)
    if not len(octets):
        return np.zeros(len(batch.size), dtype=np.bool_)
    # One byte first, which is enough in nearly all files and takes a fraction of the time of four.
    packed = octets.take(batch.start, mode="clip") == _ZSTD_FRAME[0]
    for index in np.flatnonzero(packed).tolist():
        packed[index] = batch.message(index).startswith(_ZSTD_FRAME)
    return np.asarray(packed)


def no_time(head: AnyArray) -> BoolArray:
    """(messages,) whether the log or publish time is 2^63 ns or more, which no clock shows."""
    octets = head.view(np.uint8).reshape(len(head), MESSAGE_HEAD.itemsize)
    return np.asarray((octets[:, 13] | octets[:, 21]) >= 128)  # the highest byte of either
