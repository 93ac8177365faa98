# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The messages of a file of rosbag2's sqlite3 storage, in the order in which they were recorded.

SQLite itself, Python's module, reads the file; of its tables, `topics` and `messages` matter, and the columns that all
versions of rosbag2 have.
"""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from mcap.records import Channel, Schema

from msg_analysis.bags.mcap_chunks import MESSAGE_HEAD, RECORD_LIMIT, ZSTD_SUFFIX
from msg_analysis.bags.stored_file import MOST_CHANNELS, Batch, StoredFile, batch_of
from msg_analysis.errors import BagError

_AT_ONCE = 2**20  # bytes of a batch
_COPIED = 2**20  # bytes that are unpacked together
_WAL = 2  # write version in the head of a file in the mode WAL
_WRITE_VERSION = 18  # its place
_ROW = 32  # bytes that a row counts beside its message
# Of `topics`; the last two are not in all versions.
_COLUMNS = ("id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
_REQUIRED = 4
_ROWS = "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"


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
                connection = _connect(file)
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
            while piece := reader.read(_COPIED):
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
        definitions: dict[str, str] = {}
        if "message_definitions" in names:
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
            definitions = dict(connection.execute(f"{query} LIMIT {MOST_CHANNELS}"))
        wanted = ", ".join(name if name in columns else "''" for name in _COLUMNS)
        numbers: dict[int, int] = {}
        schemas: dict[str, int] = {}
        for topic, *texts in connection.execute(f"SELECT {wanted} FROM topics ORDER BY id LIMIT {MOST_CHANNELS + 1}"):
            name, kind, encoding, qos, type_hash = map(str, texts)
            if kind not in schemas:
                schemas[kind] = len(schemas) + 1
                definition = str(definitions.get(kind, "")).encode()
                self.schemas[schemas[kind]] = Schema(schemas[kind], definition, "ros2msg", kind)
            numbers[topic] = len(numbers) + 1
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": type_hash}
            self.add_channel(
                Channel(
                    id=numbers[topic],
                    topic=name,
                    message_encoding=encoding,
                    metadata=metadata,
                    schema_id=schemas[kind],
                )
            )
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


def _connect(file: Path) -> sqlite3.Connection:
    """Open a file without changing anything, also in a directory that cannot be written.

    Without a log beside it, the mode WAL would make one.
    """
    with file.open("rb") as stream:
        head = stream.read(_WRITE_VERSION + 1)
    log = file.with_name(file.name + "-wal")
    alone = head[_WRITE_VERSION:] == bytes([_WAL]) and not (log.exists() and log.stat().st_size)
    connection = sqlite3.connect(f"{file.absolute().as_uri()}?{'immutable=1' if alone else 'mode=ro'}", uri=True)
    connection.text_factory = lambda text: text.decode(errors="replace")
    connection.execute("PRAGMA writable_schema=ON")  # or a file that is cut off could not be read at all
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, RECORD_LIMIT)
    return connection
