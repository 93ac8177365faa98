# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The records of an MCAP file that may be damaged: which are whole, where the next whole one is, and the summary.

https://mcap.dev/spec
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from msg_analysis.bags.stored_file import MESSAGE_HEAD, RECORD_LIMIT
from msg_analysis.common.arrays import AnyArray, BoolArray, IntArray

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode and length, before the content of every record
CHUNK = struct.Struct("<QQQII")  # start and end time, size, CRC (0: none), length of the compression's name
LENGTH = struct.Struct("<Q")
RECORD_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8")])
INDEX_HEAD = 6  # bytes before the entries of a message index record: channel, length; an entry: time, offset
FOOTER = struct.Struct("<QQI")  # starts of summary and summary offsets; CRC of all from the summary up to itself
_COMPRESSIONS = (b"", b"zstd", b"lz4")
_READERS = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}
LAST_OPCODE = max(_READERS)
_PRIVATE = 0x80  # and above: of applications
# That stand behind all data only.
SUMMARY_OPCODES = {Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS, Opcode.METADATA_INDEX}
SUMMARY_OPCODES |= {Opcode.SUMMARY_OFFSET, Opcode.DATA_END}
_LEAST = {Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.CHUNK: 40}  # bytes
_ANY_HEAD = re.compile(rb"[\x03-\x0f][\s\S]{3}[\x00-\x10]\0{3}")  # of a record below RECORD_LIMIT
_DATA_END = RECORD.pack(Opcode.DATA_END, 4)
_FOOTER_HEAD = RECORD.pack(Opcode.FOOTER, FOOTER.size)
_SEARCHED = 2**20  # bytes that are searched at once
_LARGEST_FOUND = 2**24  # bytes of a record behind damage that only its own content proves
_NEAR = 3600 * 10**9  # ns between messages that follow each other
_SUMMARIES = 16  # places at which a summary might begin
_ALIKE = 16  # records of equal length in a row, after which more are expected


def fits(opcode: int, content: bytes) -> bool:
    """Whether the content of a record that is no message is one of its type, to its last byte."""
    if opcode == Opcode.CHUNK:
        return chunk_length(content) == len(content)
    if opcode == Opcode.MESSAGE_INDEX:
        size = int.from_bytes(content[INDEX_HEAD - 4 : INDEX_HEAD], "little")
        return len(content) == INDEX_HEAD + size and not size % 16
    if opcode not in _READERS:
        return False
    stream = io.BytesIO(content)
    try:
        _READERS[Opcode(opcode)].read(ReadDataStream(stream))
    except Exception:  # the library raises many kinds of errors on damage
        return False
    return stream.tell() == len(content)


def chunk_length(head: bytes) -> int | None:
    """Bytes of the content of a chunk, by its first ones; None: not those of a chunk."""
    if len(head) < CHUNK.size + LENGTH.size:
        return None
    _, _, size, _, name_size = CHUNK.unpack_from(head)
    at: int = CHUNK.size + name_size
    if size > RECORD_LIMIT or head[CHUNK.size : at] not in _COMPRESSIONS or len(head) < at + LENGTH.size:
        return None
    return at + LENGTH.size + int.from_bytes(head[at : at + LENGTH.size], "little")


def is_message(data: bytes, start: IntArray, size: IntArray, head: AnyArray, *, chunks: bool) -> BoolArray:
    """(messages,) False where a record outside chunks, as if of another type, had its opcode damaged."""
    # The content decides where these few numbers can be those of another type.
    doubtful = (chunks & (head["sequence"] == size - INDEX_HEAD)) | (head["log_time"] & 0xFFFF == 0)
    doubtful[:1] = True
    others = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK}
    others |= {Opcode.MESSAGE_INDEX} if chunks else set()
    messages = np.ones(len(size), dtype=np.bool_)
    for index in np.flatnonzero(doubtful).tolist():
        content = data[start[index] : start[index] + size[index]]
        messages[index] = not any(fits(opcode, content) for opcode in others)
    return messages


def read_summary(file: Path) -> list[tuple[int, bytes]] | None:
    """Opcodes and contents of the records of the summary, also where bytes before it were lost; None: not whole."""
    with file.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - 100))
        tail = stream.read()
        place = tail.rfind(_FOOTER_HEAD)
        if place < 0 or len(tail) < place + RECORD.size + FOOTER.size:
            return None
        first, _, crc = FOOTER.unpack_from(tail, place + RECORD.size)
        footer = size - len(tail) + place
        if not first:
            return None
        wanted = max(2 * (footer - first), 4 * _SEARCHED)
        stream.seek(max(0, footer - min(wanted, RECORD_LIMIT)))
        data = stream.read(footer - stream.tell() + RECORD.size + FOOTER.size - 4)  # 4: the CRC
    end = len(data) + 4 - RECORD.size - FOOTER.size
    place = end
    for _ in range(_SUMMARIES):
        place = data.rfind(_DATA_END, 0, place)
        if place < 0:
            return None
        start = place + len(_DATA_END) + 4
        if not crc or zlib.crc32(data[start:]) == crc:
            found = list(walk(data, start, end))
            if sum(RECORD.size + len(content) for _, content in found) == end - start:
                return found if crc or all(fits(*record) for record in found) else None
    return None


def walk(data: bytes, at: int, end: int) -> Iterator[tuple[int, bytes]]:
    """The records that follow each other, up to one that does not end before ``end``."""
    while at + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if length > end - at:
            return
        yield opcode, data[at : at + length]
        at += length


class Source:
    """A stream of records that gives out many message records in a row at once; nothing else may read the stream."""

    def __init__(self, stream: io.BufferedReader, loose: int) -> None:
        self._stream, self._loose = stream, loose
        self._buffer, self._at = b"", 0  # bytes read from the stream, and how many of them were given out

    def read(self, size: int) -> bytes:
        """So many bytes; fewer at the end."""
        found = self._buffer[self._at : self._at + size]
        self._at += size
        if len(found) < size:
            self._buffer, self._at = b"", 0
            found += self._stream.read(size - len(found))
        return found

    def unread(self, data: bytes) -> None:
        """Take back bytes that were read last."""
        self._buffer, self._at = data + self._buffer[self._at :], 0

    def _peek(self, size: int) -> bytes:
        """So many bytes, which are not given out yet; fewer at the end."""
        if len(self._buffer) - self._at < size:
            more = self._stream.read(size - len(self._buffer) + self._at)
            if more:
                self._buffer, self._at = self._buffer[self._at :] + more, 0
        return self._buffer[self._at : self._at + size]

    def messages(self, head: bytes) -> tuple[bytes, IntArray, IntArray, int]:
        """Buffer, (messages,) offsets and sizes of contents, and bytes, of message records; ``head``: of the first."""
        if self._at >= len(head):
            self._at -= len(head)
        else:
            self._buffer, self._at = head, 0
        for _ in range(2):
            start, size, end = run_of_messages(self._buffer, self._at)
            if len(start):
                break
            self._buffer, self._at = self._buffer[self._at :] + self._stream.read(self._loose), 0
        length, self._at = end - self._at, end
        data = self._buffer
        if not length:  # cut off, or longer than ``loose``: the head counts as read again
            self._at += len(head)
        elif not self.followed(data[start[-1] : start[-1] + MESSAGE_HEAD.itemsize]):  # its length may be wrong
            last = int(start[-1]) - RECORD.size
            self.unread(data[last:end])
            start, size, length = start[:-1], size[:-1], length - (end - last)
            if not length:
                self.read(len(head))
        return data, start, size, length

    def followed(self, message: bytes) -> bool:
        """Whether the content of a message is followed by a record, damaged or not, or the end of the file."""
        following = self._peek(RECORD.size + MESSAGE_HEAD.itemsize)
        if min(len(message), len(following) - RECORD.size) < MESSAGE_HEAD.itemsize:
            return True
        opcode, length = RECORD.unpack_from(following)
        if opcode == Opcode.MESSAGE:
            head = (message, following[RECORD.size :])
            one, other = (int(np.frombuffer(each, MESSAGE_HEAD, 1)["log_time"][0]) for each in head)
            if abs(one - other) < _NEAR:
                return True
        elif _plausible(opcode, length):
            return True
        return 0 < length < _SEARCHED and self.record_at(RECORD.size + length)

    def record_at(self, offset: int) -> bool:
        """Whether something like a record, or the end of the file, is so many bytes ahead."""
        head = self._peek(offset + RECORD.size)[offset:]
        return len(head) < RECORD.size or _plausible(*RECORD.unpack(head))

    def skip(self, others: Collection[int]) -> int | None:
        """Go on to the next whole record, of no type in ``others``; bytes that were left out, None: there is none."""
        skipped = 1
        self.read(1)
        while True:
            if len(self._buffer) - self._at < 2 * RECORD.size:
                self._peek(_SEARCHED)
            match = _ANY_HEAD.search(self._buffer, self._at)
            start = match.start() if match else max(self._at, len(self._buffer) - RECORD.size + 1)
            skipped, self._at = skipped + start - self._at, start
            head = self._peek(RECORD.size)
            if len(head) < RECORD.size:
                return None
            if match:
                if self.whole_ahead(others):
                    return skipped
                skipped, self._at = skipped + 1, self._at + 1

    def whole_ahead(self, others: Collection[int]) -> bool:
        """Whether a whole record is ahead, of no type in ``others`` and followed by another, or the end of the file."""
        head = self._peek(RECORD.size)
        if len(head) < RECORD.size:
            return True
        opcode, length = RECORD.unpack(head)
        if opcode in others or not _plausible(opcode, length):
            return False
        if opcode == Opcode.CHUNK:
            start = self._peek(RECORD.size + CHUNK.size + LENGTH.size + 4)[RECORD.size :]
            return chunk_length(start) == length and self.record_at(RECORD.size + length)
        if length > _LARGEST_FOUND:
            return False
        record = self._peek(RECORD.size + length)
        if len(record) < RECORD.size + length or not self.record_at(len(record)):
            return False
        return opcode == Opcode.MESSAGE or fits(opcode, record[RECORD.size :])


def _plausible(opcode: int, length: int) -> bool:
    """Whether a known type, or one of an application, can have such a length."""
    if opcode == Opcode.FOOTER:
        return length == FOOTER.size
    if opcode >= _PRIVATE:
        return length <= RECORD_LIMIT
    return Opcode.FOOTER < opcode <= LAST_OPCODE and _LEAST.get(Opcode(opcode), 4) <= length <= RECORD_LIMIT


def run_of_messages(data: bytes, at: int) -> tuple[IntArray, IntArray, int]:
    """(messages,) offsets and sizes of the contents of the whole message records that follow ``at``, and their end."""
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
        if alike < _ALIKE:  # one by one while the lengths differ; then all of the same length at once
            walked.append((at + RECORD.size, length))
            at += step
            continue
        heads: AnyArray = np.ndarray((len(data) - at) // step, RECORD_HEAD, data, at, (step,))
        others = np.flatnonzero((heads["opcode"] != Opcode.MESSAGE) | (heads["length"] != length))
        count = int(others[0]) if len(others) else len(heads)
        keep_walked()
        starts.append(at + RECORD.size + step * np.arange(count))
        sizes.append(np.full(count, length))
        at, before = at + step * count, -1
    keep_walked()
    none = np.empty(0, dtype=np.int64)
    return np.concatenate([none, *starts]), np.concatenate([none, *sizes]), at
