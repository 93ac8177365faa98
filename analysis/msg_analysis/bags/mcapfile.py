"""The messages of an MCAP file, whole or torn, in batches that numpy can work on."""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from msg_analysis.errors import BagError
from msg_analysis.types import IntArray

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode and length, before the content of every record
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time, before the data of a message
_LIMIT = 2**30  # bytes of one record or chunk; recorders write megabytes, only damage claims more
_LOOSE = 4096  # messages that are not in chunks are collected into batches of so many
_ZSTD = ".zstd"  # suffix of rosbag2's compression mode `file`


class _DamageError(Exception):
    """A record whose content is not what its type wants."""


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages in the order of the file.

    Attributes
    ----------
    data : bytes in which they are
    table : (messages, 6) channel number, sequence, log time [ns], publish time [ns], and start and size of
        the CDR bytes in ``data``
    """

    data: bytes
    table: IntArray

    @property
    def channel(self) -> IntArray:
        """(messages,) channel number."""
        return self.table[:, 0]

    @property
    def extent(self) -> IntArray:
        """(messages, 2) start and size of the CDR bytes in ``data``."""
        return self.table[:, 4:]

    def message(self, index: int) -> bytes:
        """CDR bytes of one message."""
        start, size = self.extent[index].tolist()
        return self.data[start : start + size]


@dataclass(slots=True)
class McapFile:
    """An MCAP file that is read once, from front to back, by iterating over ``batches()``.

    Attributes
    ----------
    path : of the file; compressed as a whole where it ends with .zstd
    channels, schemas : seen so far, by number
    metadata, attachments : seen so far
    profile, library : of the header
    whole_bytes : length of the whole records so far
    torn : what is there instead of the end of the file; None where it ends well (known when all is read)
    damaged_chunks : chunks whose content did not survive; the reading goes on behind them
    """

    path: Path
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    profile: str = ""
    library: str = ""
    whole_bytes: int = 0
    torn: str | None = None
    damaged_chunks: int = 0

    def batches(self) -> Iterator[Batch]:
        """The messages of all whole records.

        Raises
        ------
        BagError : not an MCAP file, empty, or one that cannot be read
        """
        try:
            size = self.path.stat().st_size
            with contextlib.ExitStack() as stack:
                stream = stack.enter_context(self.path.open("rb"))
                if self.path.suffix == _ZSTD:
                    size = 2**62  # known only when all is unpacked
                    unpacked = zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
                    stream = stack.enter_context(io.BufferedReader(unpacked))
                yield from self._batches(stream, size)
        except (OSError, zstandard.ZstdError) as error:
            if self.whole_bytes and isinstance(error, zstandard.ZstdError):
                self.torn = f"cannot be unpacked beyond byte {self.whole_bytes}"
                return
            raise BagError(f"{self.path}: cannot be read ({error})") from error

    def _batches(self, stream: io.BufferedReader, size: int) -> Iterator[Batch]:
        start = stream.read(len(MAGIC))
        if not start:
            raise BagError(f"{self.path}: is empty: nothing was recorded")
        if start != MAGIC:
            raise BagError(f"{self.path}: is no MCAP file: expected a bag of ROS 2's mcap storage")
        self.whole_bytes = len(MAGIC)
        loose: list[tuple[int, ...]] = []
        pieces: list[bytes] = []
        filled = 0
        for opcode, content in self._records(stream, size):
            if opcode == Opcode.CHUNK:
                if loose:
                    yield _batch(b"".join(pieces), loose)
                    loose, pieces, filled = [], [], 0
                batch = self._chunk(content)
                if batch is not None:
                    yield batch
            elif opcode == Opcode.MESSAGE:
                if len(content) < _MESSAGE.size or max(head := _MESSAGE.unpack_from(content)) >= 2**63:
                    continue  # damaged: no clock has such times
                loose.append((*head, filled + _MESSAGE.size, len(content) - _MESSAGE.size))
                pieces.append(content)
                filled += len(content)
                if len(loose) == _LOOSE:
                    yield _batch(b"".join(pieces), loose)
                    loose, pieces, filled = [], [], 0
            else:
                with contextlib.suppress(_DamageError):
                    self._note(opcode, content)
        if loose:
            yield _batch(b"".join(pieces), loose)

    def _records(self, stream: io.BufferedReader, size: int) -> Iterator[tuple[int, bytes]]:
        while True:
            head = stream.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self.torn = f"ends after {self.whole_bytes} bytes without a footer"
                return
            opcode, length = _RECORD.unpack(head)
            content = b""
            if length <= min(_LIMIT, size - self.whole_bytes):
                content = stream.read(length)
            if len(content) < length:
                self.torn = f"the record at byte {self.whole_bytes} is cut off or damaged"
                return
            self.whole_bytes += _RECORD.size + length
            if opcode == Opcode.FOOTER:
                if stream.read(len(MAGIC)) != MAGIC:
                    self.torn = "the closing magic bytes are missing"
                return
            yield opcode, content

    def _note(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if opcode == Opcode.HEADER:
                header = Header.read(stream)
                self.profile, self.library = header.profile, header.library
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
            elif opcode == Opcode.METADATA:
                self.metadata.append(Metadata.read(stream))
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(Attachment.read(stream))
        except Exception as error:  # the library reports damage by whatever goes wrong in it
            raise _DamageError from error

    def _chunk(self, content: bytes) -> Batch | None:
        try:
            chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
            if chunk.uncompressed_size > _LIMIT:
                raise _DamageError
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            data = stream.read(length)
            return _batch(data, list(self._walk(data)))
        except Exception:  # the same
            self.damaged_chunks += 1
            return None

    def _walk(self, data: bytes) -> Iterator[tuple[int, ...]]:
        at, end = 0, len(data)
        while at < end:
            opcode, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if length > end - at:
                raise _DamageError
            if opcode == Opcode.MESSAGE:
                yield (*_MESSAGE.unpack_from(data, at), at + _MESSAGE.size, length - _MESSAGE.size)
            else:
                self._note(opcode, data[at : at + length])
            at += length


def _batch(data: bytes, table: list[tuple[int, ...]]) -> Batch:
    return Batch(data, np.array(table, dtype=np.int64).reshape(-1, 6))
