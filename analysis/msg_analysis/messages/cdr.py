# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Fields of messages in CDR bytes (OMG CDR, or XCDR1, as ROS 2 middleware sends it), and many states in one message.

Layout: a 4-byte encapsulation header (00 01: little-endian, 00 00: big-endian, two bytes of options), then the fields
in order, each primitive aligned to its own size, counted from the end of the header. A string is its length with the
closing NUL (uint32), its UTF-8 bytes and the NUL; a sequence is its length (uint32) and its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.common.arrays import AnyArray, IntArray

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
HEADER_SIZE = 4
RUN_SIZE = 16
# Bytes that may follow a message: Fast DDS aligns the end as if elements followed an empty sequence of 8-byte
# numbers, and fills up to a multiple of four.
_MAX_PADDING = 7


class CdrError(ValueError):
    """Bytes that are not the expected message; the text names the field and what is wrong with it."""


_NUMBERS = {order: {code: struct.Struct(order + code) for code in "iIQ"} for order in "<>"}


class CdrReader:
    """Reads fields of a message, and copies them; CdrError, which names message and field: other bytes, or too few."""

    def __init__(self, data: bytes, kind: str) -> None:
        self._kind = kind
        if len(data) < HEADER_SIZE or data[0] != 0 or data[1] > 1:
            start = bytes(data[:HEADER_SIZE]).hex(" ") or "nothing"
            raise CdrError(f"{kind}: begins with {start}, expected a CDR header 00 01 00 00")
        self._data, self._order = data, "<" if data[1] else ">"
        self._numbers = _NUMBERS[self._order]
        self._at = HEADER_SIZE

    def _take(self, size: int, alignment: int, what: str) -> int:
        start = self._at + (HEADER_SIZE - self._at) % alignment
        if start + size > len(self._data):
            raise CdrError(f"{self._kind}.{what}: needs {start + size} bytes, the message has {len(self._data)}")
        self._at = start + size
        return start

    def number(self, code: str, what: str) -> int:
        """An integer; ``code`` is a type code of ``struct``: "i", "I" or "Q"."""
        form = self._numbers[code]
        value: int = form.unpack_from(self._data, self._take(form.size, form.size, what))[0]
        return value

    def raw(self, size: int, what: str) -> bytes:
        """So many octets."""
        start = self._take(size, 1, what)
        return bytes(self._data[start : self._at])

    def string(self, what: str) -> str:
        """A string; it must end with NUL and be UTF-8."""
        size = self.number("I", what)
        text = self.raw(size, what)
        if size and text[-1]:
            raise CdrError(f"{self._kind}.{what}: a string without its closing NUL")
        try:
            return text[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"{self._kind}.{what}: not UTF-8") from error

    def array(self, code: str, what: str) -> AnyArray:
        """(length,) a sequence of numbers; ``code`` is a type code of numpy, such as "f8"."""
        count = self.number("I", what)
        if not count:  # nothing follows, not even padding
            return np.empty(0, dtype=code)
        size = np.dtype(code).itemsize
        start = self._take(count * size, size, what)
        return np.frombuffer(self._data, self._order + code, count, start).astype(code)

    def header(self) -> tuple[int, str, bytes]:
        """Stamp [ns], frame_id and run id, which begin the network's messages."""
        stamp = self.number("i", "header") * SECOND + self.number("I", "header")
        return stamp, self.string("header.frame_id"), self.raw(RUN_SIZE, "run")

    def rest(self) -> bytes:
        """The bytes that have not been read."""
        return self._data[self._at :]

    def end(self) -> None:
        """Check that nothing but padding follows."""
        left = len(self._data) - self._at
        if left > _MAX_PADDING:
            raise CdrError(f"{self._kind}: {left} bytes too many")


class CdrWriter:
    """Appends fields to little-endian CDR bytes."""

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN)

    def _align(self, size: int) -> None:
        self._data += bytes((HEADER_SIZE - len(self._data)) % size)

    def number(self, code: str, value: int) -> None:
        """An integer; ``code`` is a type code of ``struct``, such as "I"."""
        self._align(struct.calcsize(code))
        self._data += struct.pack("<" + code, value)

    def raw(self, value: bytes) -> None:
        """Octets, without their number."""
        self._data += value

    def string(self, text: str) -> None:
        """A string."""
        encoded = text.encode() + b"\x00"
        self.number("I", len(encoded))
        self._data += encoded

    def array(self, code: str, values: AnyArray | Sequence[Any]) -> None:
        """(length,) a sequence of numbers; ``code`` is a type code of numpy, such as "f8"."""
        array = np.asarray(values, dtype="<" + code)
        self.number("I", len(array))
        if len(array):
            self._align(array.itemsize)
            self._data += array.tobytes()

    def header(self, stamp: int, frame_id: str, run: bytes) -> None:
        """Stamp [ns], frame_id and run id, which begin the network's messages; ValueError: not 16 bytes of run id."""
        if len(run) != RUN_SIZE:
            raise ValueError(f"run: {len(run)} bytes, expected the {RUN_SIZE} bytes of a UUID")
        self.number("i", stamp // SECOND)
        self.number("I", stamp % SECOND)
        self.string(frame_id)
        self.raw(run)

    def bytes(self) -> bytes:
        """The message."""
        return bytes(self._data)


_HEAD = struct.Struct(f"<4s{RUN_SIZE}sI")  # encapsulation, run, number of messages
_LENGTH = struct.Struct("<I")


def encode_batch(run: bytes, messages: Sequence[bytes]) -> bytes:
    """A StateBatch of the run with this id (16 bytes)."""
    sizes = struct.pack(f"<{len(messages)}I", *map(len, messages))
    data = b"".join(messages)
    return b"".join((_HEAD.pack(LITTLE_ENDIAN, run, len(messages)), sizes, _LENGTH.pack(len(data)), data))


def decode_batch(data: bytes) -> tuple[bytes, IntArray, bytes]:
    """Run id, (messages,) sizes, and the messages one behind the other; CdrError where it is not a StateBatch."""
    reader = CdrReader(data, "StateBatch")
    run, sizes = reader.raw(RUN_SIZE, "run"), reader.array("u4", "size").astype(np.int64)
    messages = reader.array("u1", "messages").tobytes()
    reader.end()
    if int(sizes.sum()) != len(messages):
        raise CdrError(f"StateBatch: sizes of {int(sizes.sum())} bytes, messages of {len(messages)}")
    return run, sizes, messages
