# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A file of a bag, whatever its storage: its topics, and its messages in batches that numpy can work on.

Also how new files are compressed and split, and the files of rosbag2's sqlite3 storage.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import zstandard
from mcap.records import Attachment, Channel, Metadata, Schema

from msg_analysis.common.arrays import AnyArray, BoolArray, IntArray
from msg_analysis.errors import BagError, InputError

Compression = Literal["none", "zstd", "lz4"]
COMPRESSIONS: tuple[Compression, ...] = ("none", "zstd", "lz4")
MEGABYTE = 10**6
SMALLEST_SPLIT = 0.1  # MB; about the size of a chunk
SQLITE_SUFFIX, ZSTD_SUFFIX = ".db3", ".zstd"  # the latter of rosbag2's compression mode `file`
# As in rosbag2: small enough that a killed recorder loses little, large enough that the readers' work per chunk does
# not matter. With a third of it, reading takes a fifth longer.
CHUNK_SIZE = 768 * 1024
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
# Fields of a message record before the CDR bytes: 22 bytes; times in ns.
MESSAGE_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])


class DamageError(Exception):
    """A record whose content does not fit its type."""


def gather(data: bytes, start: IntArray, size: int) -> AnyArray:
    """(pieces,) of type ``V<size>``, to be viewed as another: copies of a buffer from ``start`` on; else IndexError."""
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


# Unpacked bytes for every byte of the file, at most, and those that any file may have: states shrink at most 200 times.
MOST_EXPANSION = 1000
FREE_EXPANSION = 2**26
MOST_CHANNELS = 2**13  # of a file: writing the metadata of each topic takes a tenth of a millisecond
_ZSTD_FRAME = b"\x28\xb5\x2f\xfd"  # first bytes; no CDR message begins like that
_UNPACKED = 2**22  # bytes of a batch of messages that were unpacked one by one
_DDS_TYPE = re.compile(r"(\w+)(?:::|/)msg(?:::|/)dds_(?:::|/)(\w+)_")
_SHORT_TYPE = re.compile(r"(\w+)(?:/|::|::msg::)(\w+)")
# The sqlite3 storage. Of `topics`, the last two columns are not in all versions of rosbag2.
_AT_ONCE = 2**20  # bytes of a batch of rows, and of a file that are unpacked together
_WAL = 2  # write version in the head of a file in the mode WAL
_WRITE_VERSION = 18  # its place
_ROW = 32  # bytes that a row counts beside its message
_COLUMNS = ("id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
_REQUIRED = 4
_ROWS = "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"


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
        """From the places of the contents of its records in ``data``; DamageError: too short, or no possible time."""
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
        """The same messages, unpacked those that rosbag2 compressed one by one; several batches if they are large."""
        zstd = zstandard.ZstdDecompressor()
        pieces: list[bytes] = []
        filled = first = 0
        for index, compressed in enumerate(packed.tolist()):
            piece = batch.message(index)
            if compressed:
                piece = self._unpacked_message(piece, zstd, batch.end)
            pieces.append(piece)
            filled += len(piece)
            last = index + 1 == len(packed)
            if filled > _UNPACKED or last:
                # All but the last batch end before the chunk does: more of it follows.
                yield batch_of(pieces, batch.head[first : index + 1], batch.end if last else batch.end - 1)
                pieces, filled, first = [], 0, index + 1

    def _unpacked_message(self, piece: bytes, zstd: zstandard.ZstdDecompressor, end: int) -> bytes:
        """The message, or the piece as it is where it cannot be unpacked."""
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


def ros_type(name: str) -> str:
    """A type as ROS 2 names it, from the name in DDS, such as ``std_msgs::msg::dds_::String_``, or that of ROS 1."""
    found = _DDS_TYPE.fullmatch(name) or _SHORT_TYPE.fullmatch(name)
    return f"{found[1]}/msg/{found[2]}" if found else name


def ros_topic(name: str) -> str:
    """The absolute name of a topic in ROS 2, from that in DDS, such as ``rt/chatter``."""
    return name if name.startswith("/") else f"/{name.removeprefix('rt/')}"


def no_time(head: AnyArray) -> BoolArray:
    """(messages,) whether the log or publish time is 2^63 ns or more, which no clock shows."""
    octets = head.view(np.uint8).reshape(len(head), MESSAGE_HEAD.itemsize)
    return np.asarray((octets[:, 13] | octets[:, 21]) >= 128)  # the highest byte of either


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


@dataclass(slots=True)
class SqliteFile(StoredFile):
    """A sqlite3 file (.db3) to be read once, by iterating over ``batches()``; compressed if named *.zstd."""

    def _stored(self) -> Iterator[Batch]:
        with contextlib.ExitStack() as stack:
            try:
                if not self.path.stat().st_size:
                    raise BagError(f"{self.path}: empty: nothing was recorded")
                file = self.path
                if file.suffix == ZSTD_SUFFIX:
                    file = stack.enter_context(self._unpacked())
                size = file.stat().st_size
                try:
                    connection = _connect(file)
                    stack.callback(connection.close)
                    numbers = self._read_topics(connection)
                except sqlite3.OperationalError:  # SQLite would have to write: to finish what its log or journal holds
                    logs = [log for end in ("-wal", "-journal") if (log := file.with_name(file.name + end)).exists()]
                    if not logs:
                        raise
                    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                    for each in (file, *logs):
                        shutil.copyfile(each, folder / each.name)
                    self.channels.clear()
                    connection = _connect(folder / file.name, "rw")
                    stack.callback(connection.close)
                    numbers = self._read_topics(connection)
            except (OSError, sqlite3.Error, zstandard.ZstdError) as error:
                raise BagError(f"{self.path}: cannot be read ({error})") from error
            yield from self._rows(connection, numbers, size)

    @contextlib.contextmanager
    def _unpacked(self) -> Iterator[Path]:
        """A temporary file with the content: SQLite needs to read here and there. What is cut off is missing."""
        with tempfile.NamedTemporaryFile(suffix=".db3") as copy, self.path.open("rb") as packed:
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while piece := reader.read(_AT_ONCE):
                self.count_expanded(len(piece), packed.tell())
                copy.write(piece)
            copy.flush()
            self._expanded = 0
            yield Path(copy.name)

    def _read_topics(self, connection: sqlite3.Connection) -> dict[int, int]:
        """Note the topics; number of the channel by number of the topic. BagError: not a bag."""
        tables = connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
        )
        names = {name for (name,) in tables}
        columns = [row[1] for row in connection.execute("PRAGMA table_info(topics)")]
        if not {"topics", "messages"} <= names or not set(_COLUMNS[:_REQUIRED]) <= set(columns):
            raise BagError(
                f"{self.path}: not a bag: expected the tables of ROS 2's sqlite3 storage, topics and messages"
            )
        definitions: dict[str, list[str]] = {}
        if "message_definitions" in names:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {kind: rest for kind, *rest in connection.execute(f"{query} LIMIT {MOST_CHANNELS}")}
        wanted = ", ".join(name if name in columns else "''" for name in _COLUMNS)
        numbers: dict[int, int] = {}
        schemas: dict[str, int] = {}
        for topic, *texts in connection.execute(f"SELECT {wanted} FROM topics ORDER BY id LIMIT {MOST_CHANNELS + 1}"):
            name, kind, encoding, qos, type_hash = map(str, texts)
            kind = ros_type(kind)
            if kind not in schemas:
                schemas[kind] = len(schemas) + 1
                form, definition = map(str, definitions.get(kind, ("ros2msg", "")))
                self.schemas[schemas[kind]] = Schema(schemas[kind], definition.encode(), form, kind)
            numbers[topic] = len(numbers) + 1
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": type_hash}
            self.add_channel(Channel(numbers[topic], name, encoding, metadata, schemas[kind]))
        return numbers

    def _rows(self, connection: sqlite3.Connection, numbers: dict[int, int], size: int) -> Iterator[Batch]:
        """The messages, in the order of their rows, of a file of ``size`` bytes."""
        pieces: list[bytes] = []
        heads: list[tuple[int, int, int, int]] = []
        filled = 0
        try:
            for topic, time, data in connection.execute(_ROWS):
                if type(time) is not int or time < 0 or type(data) is not bytes:
                    self.damaged_chunks += 1
                    continue
                pieces.append(data)
                heads.append((numbers.get(topic, 0), 0, time, time))
                filled += len(data) + _ROW
                if filled > _AT_ONCE:
                    self.count_expanded(filled, size)
                    self.whole_bytes = min(size, self.whole_bytes + filled)
                    yield batch_of(pieces, np.array(heads, MESSAGE_HEAD), self.whole_bytes)
                    pieces, heads, filled = [], [], 0
        except sqlite3.Error as error:
            if not self.whole_bytes and not pieces:
                raise BagError(f"{self.path}: cannot be read ({error})") from error
            self.torn = f"cannot be read to its end ({error})"
        self.whole_bytes = size if self.torn is None else min(size, self.whole_bytes + filled)
        if pieces:
            yield batch_of(pieces, np.array(heads, MESSAGE_HEAD), self.whole_bytes)


def _connect(file: Path, mode: str = "ro") -> sqlite3.Connection:
    """Open a file; with the mode "ro" without changing anything, also in a directory that cannot be written."""
    with file.open("rb") as stream:
        head = stream.read(_WRITE_VERSION + 1)
    log = file.with_name(file.name + "-wal")
    # Without a log beside it, the mode WAL would make one.
    alone = head[_WRITE_VERSION:] == bytes([_WAL]) and not (log.exists() and log.stat().st_size)
    connection = sqlite3.connect(f"{file.absolute().as_uri()}?{'immutable=1' if alone else f'mode={mode}'}", uri=True)
    connection.text_factory = lambda text: text.decode(errors="replace")
    connection.execute("PRAGMA writable_schema=ON")  # or a file that is cut off could not be read at all
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, RECORD_LIMIT)
    return connection
