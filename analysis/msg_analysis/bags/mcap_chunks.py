# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Records and chunks of MCAP, and how they are compressed.

Chunks of an MCAP file: decompressed, and all their messages found at once.

Damage is recognised here and reported as DamageError, or as an error of the decompressor.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from msg_analysis.common.arrays import AnyArray, IntArray
from msg_analysis.errors import InputError

Compression = Literal["none", "zstd", "lz4"]
COMPRESSIONS: tuple[Compression, ...] = ("none", "zstd", "lz4")
MEGABYTE = 10**6
# As in rosbag2: small enough that a killed recorder loses little, large enough that the readers' work per chunk does
# not matter. With a third of it, reading takes a fifth longer.
CHUNK_SIZE = 768 * 1024
SMALLEST_SPLIT = 0.1  # MB; about the size of a chunk
SQLITE_SUFFIX, ZSTD_SUFFIX = ".db3", ".zstd"  # the latter of rosbag2's compression mode `file`
BAG_SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".db3.zstd")  # of the files that can be read


@dataclass(frozen=True, slots=True)
class Storage:
    """Compression of the chunks, and when the bag goes on in a new file."""

    compression: Compression = "zstd"
    # Bytes of messages per file; None: one file. A file gets larger by its head, its summary and one chunk.
    split_size: int | None = None
    chunk_size: int = CHUNK_SIZE  # bytes

    def __post_init__(self) -> None:
        """Check them, wherever they came from."""
        if self.compression not in COMPRESSIONS:
            raise InputError(f"compression: {self.compression!r}: expected one of {', '.join(COMPRESSIONS)}")
        if self.split_size is not None and self.split_size <= 0:
            raise InputError(f"split size: {self.split_size} bytes: expected more than 0")


DEFAULT_STORAGE = Storage()


RECORD_LIMIT = 2**28  # bytes of one record or chunk; recorders write megabytes, only damage claims more
RECORD = struct.Struct("<BQ")  # opcode and length, before the content of every record
CHUNK_TIMES = struct.Struct("<QQ")  # first and last log time, at the start of a chunk
# Fields of a message record before the CDR bytes: 22 bytes; times in ns.
MESSAGE_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])
_CHUNK = struct.Struct("<QQQII")  # start and end time, size, CRC (0: none), length of the compression's name
INDEX_HEAD = 6  # bytes before the entries of a message index record: channel, length; an entry: time, offset
_RECORD_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8")])
_LENGTH = struct.Struct("<Q")
CHUNK_CRC = slice(RECORD.size + 24, RECORD.size + 28)  # place of the CRC in the record of a chunk
_ALIKE = 16  # records of equal length in a row, after which more are expected


class DamageError(Exception):
    """A record whose content does not fit its type."""


def gather(data: bytes, start: IntArray, size: int) -> AnyArray:
    """(pieces,) of type ``V<size>``: pieces of a buffer, ``size`` >= 1 bytes each, copied from the offsets ``start``.

    ``.view`` gives them their type. IndexError where a piece ends behind the buffer.
    """
    count = len(data) - size + 1
    if count < 1:
        if len(start):
            raise IndexError(f"{size} bytes of a buffer of {len(data)}")
        return np.empty(0, f"V{size}")
    # One element at every byte, overlapping the next ones: indexing copies whole pieces.
    windows: AnyArray = np.ndarray(count, f"V{size}", data, strides=(1,))
    return np.asarray(windows[start])


def scatter(data: AnyArray, start: IntArray, pieces: AnyArray) -> None:
    """Copy (pieces,) of type ``V<size>`` to the offsets ``start`` of a buffer, (bytes,) uint8, where none overlap."""
    size = pieces.itemsize
    windows: AnyArray = np.ndarray(len(data) - size + 1, f"V{size}", data, strides=(1,))
    windows[start] = pieces


def chunk_head(index: ChunkIndex) -> bytes:
    """The first bytes of the record of a chunk, before its data, as its index describes it; with 0 as CRC."""
    name = index.compression.encode()
    times = (index.message_start_time, index.message_end_time)
    content = _CHUNK.pack(*times, index.uncompressed_size, 0, len(name)) + name + _LENGTH.pack(index.compressed_size)
    head: bytes = RECORD.pack(Opcode.CHUNK, index.chunk_length - RECORD.size) + content
    return head


def unpack(content: bytes, zstd: zstandard.ZstdDecompressor, limit: int = RECORD_LIMIT) -> bytes:
    """The records in a chunk, from the content of its record; DamageError: too large, or a wrong checksum.

    ``zstd`` is reused from chunk to chunk: making one takes longer than a small chunk.
    """
    _, _, size, crc, name_size = _CHUNK.unpack_from(content)
    at = _CHUNK.size + name_size
    name = content[_CHUNK.size : at]
    (packed_size,) = _LENGTH.unpack_from(content, at)
    at += _LENGTH.size
    packed = memoryview(content)[at : at + packed_size]
    if size > limit:
        raise DamageError
    if name == b"zstd":
        if zstandard.frame_content_size(packed) > limit:
            raise DamageError  # max_output_size is ignored where the frame states its size
        data = zstd.decompress(packed, max_output_size=size)
    elif name == b"lz4":
        import lz4.frame

        frame = lz4.frame.LZ4FrameDecompressor()
        data = frame.decompress(packed, max_length=limit)
        if not frame.eof:
            raise DamageError
    else:
        data = bytes(packed)
    if crc and zlib.crc32(data) != crc:  # 0: no checksum; other wrong fields do not matter, the records decide
        raise DamageError
    return data


def locate(data: bytes, index: Sequence[bytes]) -> tuple[IntArray, IntArray] | None:
    """(messages,) offsets of the contents of all message records of a chunk, ascending, and (messages,) their sizes.

    ``index`` has the contents of the message index records behind the chunk. None where the messages that it names do
    not fill the chunk from the first byte to the last: then only a walk from record to record finds what is there.
    """
    entries = [np.frombuffer(record, "<u8", offset=INDEX_HEAD) for record in index if _is_index(record)]
    if not entries or len(entries) < len(index):
        return None
    start = np.concatenate(entries)[1::2]
    start.sort(kind="stable")  # each channel's offsets are sorted already: a stable sort merges them, ten times as fast
    if not len(start) or len(data) < RECORD.size or start[-1] > len(data) - RECORD.size:
        return None
    start = start.astype(np.int64)
    head = gather(data, start, RECORD.size).view(_RECORD_HEAD)
    start += RECORD.size
    size = np.minimum(head["length"], RECORD_LIMIT + 1).astype(np.int64)
    end = start + size
    followed = start[0] == RECORD.size and end[-1] == len(data) and (start[1:] - end[:-1] == RECORD.size).all()
    return (start, size) if followed and (head["opcode"] == Opcode.MESSAGE).all() else None


def run_of_messages(data: bytes, at: int) -> tuple[IntArray, IntArray, int]:
    """(messages,) content offsets and (messages,) sizes of the whole message records that follow ``at``, and their end.

    Records are walked one by one while their lengths differ; after ``_ALIKE`` of equal length, the others of that
    length are found at once.
    """
    starts: list[IntArray] = []
    sizes: list[IntArray] = []
    walked: list[tuple[int, int]] = []
    before, alike, end = -1, 0, len(data) - RECORD.size

    def keep_walked() -> None:
        if walked:
            places = np.array(walked, dtype=np.int64)
            starts.append(places[:, 0])
            sizes.append(places[:, 1])
            walked.clear()

    while at <= end:
        opcode, length = RECORD.unpack_from(data, at)
        step = RECORD.size + length
        if opcode != Opcode.MESSAGE or at + step > len(data):
            break
        alike = alike + 1 if length == before else 0
        before = length
        if alike < _ALIKE:
            walked.append((at + RECORD.size, length))
            at += step
            continue
        heads: AnyArray = np.ndarray((len(data) - at) // step, _RECORD_HEAD, data, at, (step,))
        others = np.flatnonzero((heads["opcode"] != Opcode.MESSAGE) | (heads["length"] != length))
        count = int(others[0]) if len(others) else len(heads)
        keep_walked()
        starts.append(at + RECORD.size + step * np.arange(count))
        sizes.append(np.full(count, length))
        at, before = at + step * count, -1
    keep_walked()
    none = np.empty(0, dtype=np.int64)
    return np.concatenate([none, *starts]), np.concatenate([none, *sizes]), at


def indexed(start: IntArray, index: Sequence[bytes]) -> bool:
    """Whether a non-empty index names exactly the messages whose contents begin at ``start``, (messages,) ascending."""
    if not all(map(_is_index, index)):
        return False
    entries = [np.frombuffer(record, "<u8", offset=INDEX_HEAD)[1::2] for record in index]
    return np.array_equal(np.sort(np.concatenate(entries)), (start - RECORD.size).astype(np.uint64))


def _is_index(record: bytes) -> bool:
    """Whether it has the length that it states, in whole entries."""
    if len(record) < INDEX_HEAD:
        return False
    size = int.from_bytes(record[INDEX_HEAD - 4 : INDEX_HEAD], "little")
    return size == len(record) - INDEX_HEAD and size % 16 == 0
