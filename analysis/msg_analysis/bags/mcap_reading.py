# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The messages of an MCAP file, whole or torn, in batches that numpy can work on.

Damaged chunks are counted and left out. Behind a damaged record, reading goes on at the next whole one, with the
schemas and channels of the summary; a tear ends it.
"""

from __future__ import annotations

import contextlib
import io
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Header, Metadata, Schema, Statistics

from msg_analysis.bags.mcap_records import (
    CHUNK,
    FOOTER,
    INDEX_HEAD,
    LAST_OPCODE,
    LENGTH,
    MAGIC,
    RECORD,
    RECORD_HEAD,
    SUMMARY_OPCODES,
    Source,
    chunk_length,
    fits,
    is_message,
    read_summary,
    run_of_messages,
    walk,
)
from msg_analysis.bags.stored_file import (
    MESSAGE_HEAD,
    RECORD_LIMIT,
    ZSTD_SUFFIX,
    Batch,
    DamageError,
    StoredFile,
    gather,
    no_time,
    ros_type,
)
from msg_analysis.common.arrays import IntArray
from msg_analysis.errors import BagError

CHUNK_CRC = slice(RECORD.size + 24, RECORD.size + 28)  # place of the CRC in the record of a chunk
MOST_OTHERS = 2**18  # records of a chunk that are no messages: two for every number of a channel
MOST_DESCRIBED = 2**26  # bytes of the schemas and channels in the chunks of a file: what they describe is kept
_IN_CHUNKS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_LOOSE = 2**18  # bytes of a batch of messages that are not in chunks


@dataclass(slots=True)
class _Chunk:
    """A chunk and the message index records behind it."""

    content: bytes
    end: int  # bytes of the file up to the end of its record
    index: list[bytes] = field(default_factory=list)
    _filled: int = 0

    def add_index(self, content: bytes) -> None:
        """Take the content of one more index record, up to ``RECORD_LIMIT`` bytes of all."""
        self._filled += len(content)
        if self._filled <= RECORD_LIMIT:
            self.index.append(content)


@dataclass(slots=True)
class McapFile(StoredFile):
    """An MCAP file to be read once, by iterating over ``batches()``; compressed as a whole if named *.zstd."""

    statistics: Statistics | None = None
    false_indexes: int = 0  # chunks whose index is wrong: here the records decide, other programs use the index
    loose: int = _LOOSE  # bytes of a batch of messages that are not in chunks
    stated: Statistics | None = None  # by a whole summary, which is read where something is damaged
    _described: int = 0  # bytes of the schemas and channels in the chunks
    _chunks: int = 0  # so far, damaged ones too
    _skipped: int = 0  # damaged records outside chunks that may have held messages
    _damaged: bool = False
    _ended: bool = False  # whether only the summary follows

    def _stored(self) -> Iterator[Batch]:
        try:
            size = self.path.stat().st_size
            with contextlib.ExitStack() as stack:
                stream = stack.enter_context(self.path.open("rb"))
                if self.path.suffix == ZSTD_SUFFIX:
                    size = 2**62  # not known before all is unpacked
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
            raise BagError(f"{self.path}: empty: nothing was recorded")
        if start != MAGIC:
            raise BagError(f"{self.path}: not an MCAP file: expected a bag of ROS 2's mcap storage")
        self.whole_bytes = len(MAGIC)
        _keep_memory()
        zstd = zstandard.ZstdDecompressor()  # for all chunks: making one takes longer than a small chunk
        chunk: _Chunk | None = None
        for opcode, content, places in self._records(Source(stream, self.loose), size):
            if opcode == Opcode.MESSAGE_INDEX and chunk is not None:
                chunk.add_index(content)
                continue
            if chunk is not None:
                yield from self._chunk(chunk, zstd)
                chunk = None
            if opcode == Opcode.CHUNK:
                self._chunks += 1
                chunk = _Chunk(content, self.whole_bytes)
            elif opcode == Opcode.MESSAGE:
                batch = _loose_batch(content, *places, self.whole_bytes, chunks=self._chunks > 0)
                if len(batch.size) < len(places[0]):
                    self._skipped += 1
                    self._consult_summary()
                yield batch
            else:
                with contextlib.suppress(DamageError):
                    self.note(opcode, content)
        if chunk is not None:
            yield from self._chunk(chunk, zstd)
        stated = self.stated.chunk_count if self.stated else 0
        self.damaged_chunks += max(0, stated - self._chunks) if stated else self._skipped

    def _records(self, source: Source, size: int) -> Iterator[tuple[int, bytes, tuple[IntArray, IntArray]]]:
        """Opcode, content and (offsets, sizes) of each record; message records in a row come together; 0: a gap."""
        none = np.empty(0, dtype=np.int64)
        while True:
            head = source.read(RECORD.size)
            if len(head) < RECORD.size:
                self.torn = f"ends after {self.whole_bytes} bytes without a footer"
                return
            opcode, length = RECORD.unpack(head)
            content = b""
            if opcode == Opcode.MESSAGE and not self._only_in_chunks:
                data, start, sizes, whole = source.messages(head)
                if whole:
                    self.whole_bytes += whole
                    yield opcode, data, (start, sizes)
                    continue
            if length <= min(RECORD_LIMIT, size - self.whole_bytes):
                content = source.read(length)
            if len(content) == length and self._belongs(opcode, content, source):
                self.whole_bytes += RECORD.size + length
                if opcode == Opcode.FOOTER:
                    if source.read(len(MAGIC)) != MAGIC:
                        self.torn = "the closing magic bytes are missing"
                    return
                self._ended |= opcode in SUMMARY_OPCODES
                yield opcode, content, (np.array([0]), np.array([length]))
                continue
            self._consult_summary()
            whole_one = opcode not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX) and fits(opcode, content)
            if whole_one and not self._ended:  # the next one is damaged, or bytes of this one are lost
                yield opcode, content, (np.array([0]), np.array([length]))
            chunk = opcode == Opcode.CHUNK or fits(Opcode.CHUNK, content)
            # Of a damaged chunk that is not compressed, no message is taken: nothing would tell that it was changed.
            chunks = self.stated.chunk_count if self.stated else self._chunks or chunk
            inside = bool(chunks) and not self._ended
            source.unread(head + content)
            skipped = source.skip(_IN_CHUNKS if inside else ())
            if skipped is None:
                fitting = bool(content) and fits(opcode, content)
                self.whole_bytes += (RECORD.size + length) * fitting
                self.torn = f"the record at byte {self.whole_bytes} is cut off or damaged"
                if not opcode or fitting:  # a power cut leaves zeros
                    self.torn = f"no record at byte {self.whole_bytes}, where one should be"
                return
            index = self._chunks and (opcode == Opcode.MESSAGE_INDEX or fits(Opcode.MESSAGE_INDEX, content))
            array = int.from_bytes(content[INDEX_HEAD - 4 : INDEX_HEAD], "little")
            more = skipped > RECORD.size + max(length, INDEX_HEAD + array)  # than the index, if it is one
            self._skipped += chunk or (not self._ended and (more or not index))
            self.false_indexes += 1
            self.whole_bytes += skipped
            yield 0, b"", (none, none)

    @property
    def _only_in_chunks(self) -> bool:
        """Whether a message outside chunks is a sign of damage."""
        return self._ended or (self._damaged and self._chunks > 0)

    def _belongs(self, opcode: int, content: bytes, source: Source) -> bool:
        """Whether a record can stand where it does; not the opcode and length of something else."""
        if opcode == Opcode.MESSAGE:
            return not self._only_in_chunks and source.followed(content)
        if opcode == Opcode.FOOTER:
            return len(content) == FOOTER.size
        if opcode == Opcode.CHUNK:  # where bytes of it are lost, it would end in the next one
            return not self._ended and _ends_there(content, followed=source.whole_ahead(_IN_CHUNKS))
        if self._ended and opcode <= LAST_OPCODE:
            return opcode in SUMMARY_OPCODES or fits(opcode, content)
        if fits(opcode, content):
            return source.record_at(0)
        # Types of later versions of the format are left out, unless they look like one of this.
        number = int.from_bytes(content[:2], "little")
        message = not self._chunks and number in self.channels and len(content) >= MESSAGE_HEAD.itemsize
        other = message or any(fits(each, content) for each in Opcode)
        return opcode > LAST_OPCODE and not other and source.record_at(0)

    def _consult_summary(self) -> None:
        """Take the topics of the summary: the chunk that describes them may be lost."""
        if self._damaged or self.path.suffix == ZSTD_SUFFIX:
            return
        self._damaged = True
        summary = McapFile(self.path)
        for opcode, content in read_summary(self.path) or ():
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                with contextlib.suppress(DamageError):
                    summary.note(opcode, content)
        self.stated = summary.statistics
        self.schemas = summary.schemas | self.schemas
        for number in summary.channels.keys() - self.channels.keys():
            self.add_channel(summary.channels[number])

    def note(self, opcode: int, content: bytes) -> None:
        """Take the content of a record that is no message; DamageError: not of its type; BagError: too many topics."""
        stream = ReadDataStream(io.BytesIO(content))
        try:
            if opcode == Opcode.HEADER:
                header = Header.read(stream)
                self.profile, self.library = header.profile, header.library
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                schema.name = ros_type(schema.name)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self.add_channel(Channel.read(stream))
            elif opcode == Opcode.METADATA:
                self.metadata.append(Metadata.read(stream))
            elif opcode == Opcode.STATISTICS:
                self.statistics = Statistics.read(stream)
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(Attachment.read(stream))
        except BagError:
            raise
        except Exception as error:  # the library raises many kinds of errors on damage
            raise DamageError from error

    def _chunk(self, chunk: _Chunk, zstd: zstandard.ZstdDecompressor) -> Iterator[Batch]:
        try:
            data = unpack(chunk.content, zstd)
            self.count_expanded(len(data), chunk.end)
            places = locate(data, chunk.index)
            if places is None:
                places = self._walk(data)
                named = _indexed_places(chunk.index)
                right = named is not None and np.array_equal(named, (places[0] - RECORD.size).astype(np.uint64))
                self.false_indexes += bool(chunk.index) and not right
            batch = Batch.of_contents(data, *places, chunk.end)
        except BagError:
            raise
        except Exception:  # decompressors and the library raise many kinds of errors on damage
            self.damaged_chunks += 1
            self._consult_summary()
        else:
            yield batch

    def _walk(self, data: bytes) -> tuple[IntArray, IntArray]:
        """(messages,) content offsets and sizes of all message records of a chunk; other records are noted."""
        starts, sizes, at, others = [], [], 0, 0
        while at < len(data):
            start, size, at = run_of_messages(data, at)
            starts.append(start)
            sizes.append(size)
            if at == len(data):
                break
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            others += 1
            if length > len(data) - at or opcode in (0, Opcode.MESSAGE) or others > MOST_OTHERS:
                raise DamageError
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):  # nothing else belongs into a chunk
                self._described += length
                if self._described > MOST_DESCRIBED:
                    raise DamageError
                self.note(opcode, data[at : at + length])
            at += length
        none = np.empty(0, dtype=np.int64)
        return np.concatenate([none, *starts]), np.concatenate([none, *sizes])


def _ends_there(chunk: bytes, *, followed: bool) -> bool:
    """Whether a chunk ends where its record does; ``followed``: a whole record stands there."""
    beyond = (chunk_length(chunk) or 0) - len(chunk)  # more than 0: the size in its head may be wrong
    if beyond < 0 or (followed and not beyond):
        return not beyond
    try:
        data = unpack(chunk, zstandard.ZstdDecompressor())
    except Exception:  # decompressors raise many kinds of errors on damage
        return False
    whole = sum((RECORD.size + len(each)) * (opcode in _IN_CHUNKS) for opcode, each in walk(data, 0, len(data)))
    return CHUNK.unpack_from(chunk)[3] > 0 or (not beyond and whole == len(data))


def _keep_memory() -> None:
    """Let the C library keep large blocks that are freed from chunk to chunk."""
    # Mapping fresh pages each time takes longer than all that is done with a chunk. Freeing one large block raises the
    # threshold (mallopt(3), M_MMAP_THRESHOLD).
    np.empty(2**24, np.uint8)


def _loose_batch(data: bytes, start: IntArray, size: IntArray, end: int, *, chunks: bool) -> Batch:
    """Messages that are not in a chunk; damaged ones are left out one by one."""
    start, size = start[size >= MESSAGE_HEAD.itemsize], size[size >= MESSAGE_HEAD.itemsize]
    head = gather(data, start, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
    timed = ~no_time(head) & is_message(data, start, size, head, chunks=chunks)
    return Batch.of_contents(data, start[timed], size[timed], end)


def chunk_head(index: ChunkIndex) -> bytes:
    """The first bytes of the record of a chunk, before its data, as its index describes it; with 0 as CRC."""
    name = index.compression.encode()
    times = (index.message_start_time, index.message_end_time)
    content = CHUNK.pack(*times, index.uncompressed_size, 0, len(name)) + name + LENGTH.pack(index.compressed_size)
    head: bytes = RECORD.pack(Opcode.CHUNK, index.chunk_length - RECORD.size) + content
    return head


def unpack(content: bytes, zstd: zstandard.ZstdDecompressor, limit: int = RECORD_LIMIT) -> bytes:
    """The records in a chunk, from the content of its record; DamageError: too large, or a wrong checksum."""
    _, _, size, crc, name_size = CHUNK.unpack_from(content)
    at = CHUNK.size + name_size
    name = content[CHUNK.size : at]
    (packed_size,) = LENGTH.unpack_from(content, at)
    at += LENGTH.size
    packed = memoryview(content)[at : at + packed_size]
    if size > limit or not (crc or fits(Opcode.CHUNK, content)):
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
    """(messages,) ascending offsets and sizes of the contents of the records of a chunk, by its index records."""
    start = _indexed_places(index)
    # Unless these messages fill the chunk, only a walk from record to record finds what is there.
    if start is None or not len(start) or len(data) < RECORD.size or start[-1] > len(data) - RECORD.size:
        return None
    start = start.astype(np.int64)
    head = gather(data, start, RECORD.size).view(RECORD_HEAD)
    start += RECORD.size
    size = np.minimum(head["length"], RECORD_LIMIT + 1).astype(np.int64)
    end = start + size
    followed = start[0] == RECORD.size and end[-1] == len(data) and (start[1:] - end[:-1] == RECORD.size).all()
    return (start, size) if followed and (head["opcode"] == Opcode.MESSAGE).all() else None


def _indexed_places(index: Sequence[bytes]) -> IntArray | None:
    """(messages,) ascending places of the messages that index records name; None: no records, or a wrong length."""
    sizes = [int.from_bytes(record[INDEX_HEAD - 4 : INDEX_HEAD], "little") for record in index]
    whole = all(len(record) == INDEX_HEAD + size and not size % 16 for record, size in zip(index, sizes, strict=True))
    if not index or not whole:
        return None
    places = np.concatenate([np.frombuffer(record, "<u8", offset=INDEX_HEAD)[1::2] for record in index])
    places.sort(kind="stable")  # each channel's are sorted already: a stable sort merges them, ten times as fast
    return places
