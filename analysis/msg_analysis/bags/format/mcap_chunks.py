"""Chunks of an MCAP file: taken out of their compression, and all their messages found at once."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
import zstandard
from mcap.opcode import Opcode

from msg_analysis.types import AnyArray, IntArray

LIMIT = 2**28
"""Bytes of one record or chunk; recorders write megabytes, only damage claims more."""

RECORD = struct.Struct("<BQ")
"""Opcode and length, before the content of every record."""

MESSAGE_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])
"""What stands in a message record before the data of the message."""

_CHUNK = struct.Struct("<QQQII")  # start and end time, size, CRC (0: none), length of the compression's name
_INDEX_HEAD = 6  # bytes before the entries of a message index record: channel, length; an entry is (time, place)
_RECORD_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8")])
_LENGTH = struct.Struct("<Q")
_ALIKE = 16  # records of equal length, after which more are expected


class DamageError(Exception):
    """A record whose content is not what its type wants."""


def gather(data: bytes, start: IntArray, size: int) -> AnyArray:
    """Copy equally long pieces of a buffer into one contiguous array.

    Parameters
    ----------
    data
        the buffer
    start
        (pieces,) where each begins
    size
        bytes of each, at least 1

    Returns
    -------
    AnyArray
        (pieces,) of type ``V<size>``: ``.view`` says what they are

    Raises
    ------
    IndexError
        a piece that is not all in the buffer
    """
    count = len(data) - size + 1
    if count < 1:
        if len(start):
            raise IndexError(f"{size} bytes of a buffer of {len(data)}")
        return np.empty(0, f"V{size}")
    # One element at every byte, each overlapping the next: picking elements copies pieces whole.
    windows: AnyArray = np.ndarray(count, f"V{size}", data, strides=(1,))
    return np.asarray(windows[start])


def unpack(content: bytes, zstd: zstandard.ZstdDecompressor) -> bytes:
    """The records in a chunk.

    Parameters
    ----------
    content
        of the chunk's record
    zstd
        zstandard.ZstdDecompressor to be used again from chunk to chunk: making one takes longer than a small chunk

    Raises
    ------
    DamageError
        too large, or a wrong checksum; decompressors raise errors of their own
    """
    _, _, size, crc, name_size = _CHUNK.unpack_from(content)
    at = _CHUNK.size + name_size
    name = content[_CHUNK.size : at]
    (packed_size,) = _LENGTH.unpack_from(content, at)
    at += _LENGTH.size
    packed = memoryview(content)[at : at + packed_size]
    if size > LIMIT:
        raise DamageError
    if name == b"zstd":
        if zstandard.frame_content_size(packed) > LIMIT:
            raise DamageError  # it would be unpacked whole before anyone looks
        data = zstd.decompress(packed, max_output_size=size)
    elif name == b"lz4":
        import lz4.frame

        frame = lz4.frame.LZ4FrameDecompressor()
        data = frame.decompress(packed, max_length=LIMIT)
        if not frame.eof:
            raise DamageError
    else:
        data = bytes(packed)
    if crc and zlib.crc32(data) != crc:  # without one, and whatever the other fields say, the records decide
        raise DamageError
    return data


def locate(data: bytes, index: Sequence[bytes]) -> tuple[IntArray, IntArray] | None:
    """Find all messages of a chunk at once by its index, which is believed only where the records bear it out.

    Parameters
    ----------
    data
        the records in the chunk
    index
        Sequence[bytes] contents of the message index records behind the chunk

    Returns
    -------
    tuple[IntArray, IntArray] | None
        (messages,) where the content of each message's record starts, and its size, in the order of the chunk. None
        where the messages of the index do not fill the chunk from the first byte to the last: then only a walk from
        record to record finds what is there
    """
    entries = [np.frombuffer(record, "<u8", offset=_INDEX_HEAD) for record in index if _is_index(record)]
    if not entries or len(entries) < len(index):
        return None
    start = np.concatenate(entries)[1::2]
    start.sort(kind="stable")  # each channel's are in order already: merging them takes a tenth of the time
    if not len(start) or len(data) < RECORD.size or start[-1] > len(data) - RECORD.size:
        return None
    start = start.astype(np.int64)
    head = gather(data, start, RECORD.size).view(_RECORD_HEAD)
    start += RECORD.size
    size = np.minimum(head["length"], LIMIT + 1).astype(np.int64)
    end = start + size
    followed = start[0] == RECORD.size and end[-1] == len(data) and (start[1:] - end[:-1] == RECORD.size).all()
    return (start, size) if followed and (head["opcode"] == Opcode.MESSAGE).all() else None


def run_of_messages(data: bytes, at: int) -> tuple[IntArray, IntArray, int]:
    """Find the whole message records that follow upon each other from some place on.

    Where the lengths differ they are walked one by one; after some of equal length, all more of them are found at once.

    Parameters
    ----------
    data
        a part of a file
    at
        where a record begins

    Returns
    -------
    tuple[IntArray, IntArray, int]
        (messages,) where the content of each begins, and its size; where what is no whole message record begins
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
    """Whether an index names just the messages that are there.

    Parameters
    ----------
    start
        (messages,) where the content of each message's record starts, ascending
    index
        Sequence[bytes] contents of the message index records behind the chunk
    """
    if not all(map(_is_index, index)):
        return False
    entries = [np.frombuffer(record, "<u8", offset=_INDEX_HEAD)[1::2] for record in index]
    return np.array_equal(np.sort(np.concatenate(entries)), (start - RECORD.size).astype(np.uint64))


def _is_index(record: bytes) -> bool:
    """Whether it has the length that it says, in whole entries."""
    if len(record) < _INDEX_HEAD:
        return False
    size = int.from_bytes(record[_INDEX_HEAD - 4 : _INDEX_HEAD], "little")
    return size == len(record) - _INDEX_HEAD and size % 16 == 0
