# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Writes MCAP files with their messages in chunks, and one file of a bag with its run record and topics.

``McapWriter`` writes the same bytes as ``mcap.writer.Writer`` in half its time, and encodes the records other than
messages and their indexes with that library.
"""

from __future__ import annotations

import contextlib
import functools
import os
import struct
import tempfile
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, McapRecord, Metadata, MetadataIndex, Schema

from msg_analysis.bags.files import ChannelCount, FileCount, bag_information, dump
from msg_analysis.bags.mcap_records import MAGIC
from msg_analysis.bags.stored_file import MESSAGE_HEAD, Compression, Storage, gather, scatter
from msg_analysis.common.arrays import AnyArray, IntArray
from msg_analysis.messages.topics import Qos, Topic

RECORD_NAME = "msg_agents"  # of the MCAP metadata record with the run record
ROSBAG2_RECORD = "rosbag2"
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time; then the data
_MESSAGE_RECORD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("head", MESSAGE_HEAD)])  # the same
ENTRY = struct.Struct("<QQ")  # of an index: log time, place among the records of the chunk
MESSAGE_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of the entries; then the entries
CHUNK = struct.Struct("<BQQQQI")  # opcode, length, first and last time, size and checksum of the records
FOOTER = struct.Struct("<BQQQ")  # what of it the checksum of the summary covers
INDEXES_IN_MEMORY = 2**24  # bytes of the indexes of chunks; what is beyond is in a temporary file
ZSTD_LEVEL = -1  # noisy states: 3 % larger than with zstd's own level, 3, in a third of the time
COMPRESSION_NAMES: dict[Compression, str] = {"none": "", "zstd": "zstd", "lz4": "lz4"}


class McapWriter:
    """An MCAP file being written to a stream; OSError, from every method: the stream takes no more."""

    def __init__(
        self,
        stream: BinaryIO,
        *,
        chunk_size: int,
        compression: Compression,
        level: int = ZSTD_LEVEL,
        profile: str = "ros2",
        library: str = "mcap",
        directory: str | None = None,  # of a temporary file; None: that of the system
        indexes_in_memory: int = INDEXES_IN_MEMORY,
    ) -> None:
        self._stream, self._chunk_size = stream, chunk_size
        self._compression, self._level = compression, level
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        # An index of a chunk has an entry for every channel: an hour of a thousand agents has gigabytes of them.
        self._chunk_indexes = tempfile.SpooledTemporaryFile(indexes_in_memory, dir=directory)  # noqa: SIM115
        self._chunks = 0
        self._first: int | None = None  # log time [ns] of the first message
        self._last = 0
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._counts: dict[int, int] = {}  # messages by channel, of the chunks that are finished
        self._chunk: list[bytes] = []  # records of the chunk in progress, in parts
        self._size = 0  # of the chunk in progress
        self._index: dict[int, bytearray] = defaultdict(bytearray)  # by channel: an ENTRY for each message
        stream.write(MAGIC + _encoded(records.Header(profile=profile, library=library)))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Append a metadata record, outside the chunks."""
        record = _encoded(Metadata(name=name, metadata=data))
        self._metadata_indexes.append(MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._stream.write(record)

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment, outside the chunks."""
        record = _encoded(attachment)
        a, place = attachment, self._stream.tell()
        index = AttachmentIndex(place, len(record), a.log_time, a.create_time, len(a.data), a.name, a.media_type)
        self._attachment_indexes.append(index)
        self._stream.write(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema; its number."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        return self._register(self._schemas)

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Register a channel; its number."""
        self._channels.append(Channel(len(self._channels) + 1, topic, encoding, metadata, schema))
        return self._register(self._channels)

    def _register(self, so_far: Sequence[McapRecord]) -> int:
        record = _encoded(so_far[-1])
        self._chunk.append(record)
        self._size += len(record)
        if self._size > self._chunk_size:
            self._finish_chunk()
        return len(so_far)

    def add_message(
        self, channel: int, time_ns: int, data: bytes, sequence: int, published_ns: int | None = None
    ) -> None:
        """Append a message, logged at that time, and published then if no other time is given."""
        length = len(data)
        published = time_ns if published_ns is None else published_ns
        self._chunk += (MESSAGE.pack(Opcode.MESSAGE, length + 22, channel, sequence, time_ns, published), data)
        self._index[channel] += ENTRY.pack(time_ns, self._size)
        self._size += length + MESSAGE.size
        if self._size > self._chunk_size:
            self._finish_chunk()

    def add_messages(self, head: AnyArray, data: bytes, start: IntArray, size: IntArray) -> None:
        """Append messages: heads (``MESSAGE_HEAD``), places and sizes of their bytes in ``data``, (messages,) each."""
        done = 0
        while done < len(head):  # the same bytes as by ``add_message`` for each, in a fraction of the time
            piece = slice(done, done + self.fitting(size[done:]))
            self._add_piece(head[piece], data, start[piece], size[piece])
            done = piece.stop

    def fitting(self, size: IntArray) -> int:
        """How many of the messages with these sizes, (messages,), go into the chunk in progress."""
        end = np.cumsum(size + MESSAGE.size)
        whole = int(np.searchsorted(end, self._chunk_size - self._size, side="right"))
        return min(whole + 1, len(size))  # a chunk ends with the message that makes it too large

    def _add_piece(self, head: AnyArray, data: bytes, start: IntArray, size: IntArray) -> None:
        """Append messages to one chunk, and finish that when it is full."""
        place = np.cumsum(size + MESSAGE.size) - size  # of their bytes among the records
        total = int(place[-1] + size[-1])
        written = np.empty(total, dtype=np.uint8)
        heads = np.empty(len(head), _MESSAGE_RECORD)
        heads["opcode"], heads["length"], heads["head"] = Opcode.MESSAGE, size + MESSAGE_HEAD.itemsize, head
        scatter(written, place - MESSAGE.size, heads.view(f"V{MESSAGE.size}"))
        for length in np.unique(size).tolist():
            of_it = np.flatnonzero(size == length)
            if length:
                scatter(written, place[of_it], gather(data, start[of_it], length))
        self._chunk.append(written.tobytes())
        order = np.argsort(head["channel"], kind="stable")
        entries = np.column_stack((head["log_time"], (place - MESSAGE.size + self._size).astype(np.uint64)))
        flat = memoryview(entries[order].astype("<u8").tobytes())
        channels, first, counts = np.unique(head["channel"][order], return_index=True, return_counts=True)
        for number in np.argsort(order[first]).tolist():  # as they come
            begin = int(first[number])
            self._index[int(channels[number])] += flat[ENTRY.size * begin : ENTRY.size * (begin + int(counts[number]))]
        self._size += total
        if self._size > self._chunk_size:
            self._finish_chunk()

    def _finish_chunk(self) -> None:
        """Write the chunk in progress; one without messages stays in progress."""
        if not self._index:
            return
        content, entries = b"".join(self._chunk), dict(self._index)
        self._chunk.clear()
        self._index.clear()
        self._size = 0
        compressed = _compressed(content, self._compression, self._level)
        name = COMPRESSION_NAMES[self._compression].encode()
        times = np.frombuffer(b"".join(entries.values()), "<u8")[::2]
        start, end = int(times.min()), int(times.max())
        tail = struct.pack(f"<I{len(name)}sQ", len(name), name, len(compressed))
        length = CHUNK.size - 9 + len(tail) + len(compressed)
        head = CHUNK.pack(Opcode.CHUNK, length, start, end, len(content), zlib.crc32(content)) + tail
        place = self._stream.tell()
        after = place + len(head) + len(compressed)
        indexes, offsets = bytearray(), {}
        for channel, its in entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(its) // ENTRY.size
            offsets[channel] = after + len(indexes)
            indexes += MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, len(its) + 6, channel, len(its))
            indexes += its
        for part in (head, compressed, indexes):
            self._stream.write(part)
        index = records.ChunkIndex(
            chunk_length=after - place,
            chunk_start_offset=place,
            compression=name.decode(),
            compressed_size=len(compressed),
            message_end_time=end,
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=start,
            uncompressed_size=len(content),
        )
        self._chunk_indexes.write(_encoded(index))
        self._chunks += 1
        self._first = start if self._first is None else min(self._first, start)
        self._last = max(self._last, end)

    def flush(self) -> None:
        """Finish the chunk in progress and hand everything to the operating system."""
        self._finish_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the summary; the stream stays open."""
        self._finish_chunk()
        self._stream.write(_encoded(records.DataEnd(0)))
        start, checksum = self._stream.tell(), 0
        offsets = b""
        for opcode, parts in self._groups():
            begin = self._stream.tell()
            for part in parts:
                checksum = zlib.crc32(part, checksum)
                self._stream.write(part)
            length = self._stream.tell() - begin
            offsets += _encoded(records.SummaryOffset(group_opcode=opcode, group_start=begin, group_length=length))
        self._chunk_indexes.close()
        offset_start = self._stream.tell()
        checksum = zlib.crc32(FOOTER.pack(Opcode.FOOTER, 20, start, offset_start), zlib.crc32(offsets, checksum))
        footer = records.Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=checksum)
        self._stream.write(offsets + _encoded(footer) + MAGIC)

    def _groups(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        """Opcode and bytes of the groups of the summary."""
        yield Opcode.SCHEMA, map(_encoded, self._schemas)
        yield Opcode.CHANNEL, map(_encoded, self._channels)
        yield Opcode.STATISTICS, [_encoded(self._statistics())]
        self._chunk_indexes.seek(0)
        yield Opcode.CHUNK_INDEX, iter(lambda: self._chunk_indexes.read(2**20), b"")
        yield Opcode.ATTACHMENT_INDEX, map(_encoded, self._attachment_indexes)
        yield Opcode.METADATA_INDEX, map(_encoded, self._metadata_indexes)

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            message_end_time=self._last,
            message_start_time=self._first or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


def _compressed(data: bytes, compression: Compression, level: int) -> bytes:
    if compression == "zstd":
        import zstandard

        compressed: bytes = zstandard.compress(data, level=level)
        return compressed
    if compression == "lz4":
        import lz4.frame

        framed: bytes = lz4.frame.compress(data)
        return framed
    return data


@dataclass(frozen=True, slots=True, order=True)
class LatchedMessage:
    """A message that later files repeat at their heads; in the order of time, then of its topic's messages."""

    time: int  # [ns]
    sequence: int  # among the messages of its topic, from 0
    topic: str
    data: bytes
    until: int | None  # last time [ns] at which it is in force; None: always


class WrittenFile:
    """A new file; OSError, from every method: exists, or cannot be written."""

    def __init__(self, path: Path, earlier: Sequence[FileCount], storage: Storage, begin: int) -> None:
        self.count = FileCount(path.name)
        self.begin = begin  # first time that belongs into it [ns]
        # Last one [ns]; None: not full. Messages up to it still belong into a full file of a split bag.
        self.bound: int | None = None
        self.behind: set[str] = set()  # topics of which messages up to the bound may still come
        self._earlier, self._storage, self._directory = list(earlier), storage, str(path.parent)
        self._numbers: dict[str, int] = {}  # of the channels
        self._stream: BinaryIO = path.open("xb")

    def write_head(
        self, topics: Sequence[Topic], record: str | None, custom: Mapping[str, str], latched: Iterable[LatchedMessage]
    ) -> None:
        """Write the run record, the topics, and what is in force of the latched ones; the first thing to be written."""
        storage, self._custom = self._storage, custom
        self.mcap = McapWriter(
            self._stream,
            chunk_size=min(storage.chunk_size, storage.split_size or storage.chunk_size),
            compression=storage.compression,
            directory=self._directory,
        )
        self._add_information()
        if record is not None:
            self.mcap.add_metadata(RECORD_NAME, {"record": record})
        schemas: dict[str, int] = {}
        for topic in topics:
            kind = topic.type.full_name
            if kind not in schemas:
                schemas[kind] = self.mcap.register_schema(kind, "ros2msg", topic.type.schema.encode())
            type_hash, count = topic.type.type_hash, self.count.channels
            count[topic.name] = ChannelCount(topic.name, kind, type_hash, topic.qos.offered())
            metadata = {"offered_qos_profiles": _offered(topic.qos), "topic_type_hash": type_hash}
            self._numbers[topic.name] = self.mcap.register_channel(topic.name, "cdr", schemas[kind], metadata)
        for message in latched:
            self.repeat(message)
        self.mcap.flush()
        # The head is not counted: it may be larger than the limit, and every file has it.
        self._limit = None if storage.split_size is None else self._stream.tell() + storage.split_size

    @property
    def full(self) -> bool:
        """Whether it has as many bytes as a file of a split bag should have."""
        return self._limit is not None and self._stream.tell() >= self._limit

    def add(self, topic: str, data: bytes, time_ns: int, sequence: int, published_ns: int | None = None) -> None:
        """Append a message."""
        self.mcap.add_message(self._numbers[topic], time_ns, data, sequence, published_ns)
        self._counted(topic, 1, time_ns, time_ns)

    def repeat(self, message: LatchedMessage) -> None:
        """Append a message again that another file has: logged at the beginning of this one, published when it was."""
        self.add(message.topic, message.data, self.begin, message.sequence, message.time)

    def add_many(
        self,
        topics: Sequence[str],
        of: IntArray,
        time_ns: IntArray,
        data: bytes,
        start: IntArray,
        size: IntArray,
        sequences: dict[str, int],
    ) -> list[str]:
        """Append messages (see ``BagWriter.write_many``) and count them in ``sequences``; the topics that they have."""
        head = np.zeros(len(of), MESSAGE_HEAD)
        head["log_time"] = head["publish_time"] = time_ns
        order = np.argsort(of.astype(np.uint16), kind="stable")  # a radix sort; channels of MCAP have 16 bits
        present, first, counts = np.unique(of[order], return_index=True, return_counts=True)
        names = [topics[topic] for topic in present.tolist()]
        earlier = [sequences[name] for name in names]
        head["channel"][order] = np.repeat([self._numbers[name] for name in names], counts)
        head["sequence"][order] = np.arange(len(of)) + np.repeat(np.array(earlier) - first, counts)
        self.mcap.add_messages(head, data, start, size)
        begin, end = int(time_ns.min()), int(time_ns.max())
        for name, count in zip(names, counts.tolist(), strict=True):
            sequences[name] += count
            self._counted(name, count, begin, end)
        return names

    def _counted(self, topic: str, messages: int, begin: int, end: int) -> None:
        self.count.channels[topic].messages += messages
        self.count.start, self.count.end = min(self.count.start, begin), max(self.count.end, end)

    def finish(self) -> None:
        """Write the summary; then the file is whole and on the disk."""
        self._add_information()
        self.mcap.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):  # closing tries again to write what is left
            self._stream.close()

    def _add_information(self) -> None:
        information = bag_information([*self._earlier, self.count], self._custom)
        self.mcap.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": dump(information)})


@functools.cache
def _offered(qos: Qos) -> str:
    """Of all agents' topics the same."""
    return dump(qos.offered())
