"""Writes a bag that rosbag2, rosbags, Foxglove and PlotJuggler open: a directory with MCAP files.

While it is written, the directory has a locked marker instead of metadata.yaml.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from msg_analysis.bags.format.mcap_chunks import MESSAGE_HEAD
from msg_analysis.bags.format.mcap_writer import McapWriter
from msg_analysis.bags.format.metadata import ChannelCount, FileCount, bag_information, dump, write_metadata
from msg_analysis.bags.format.storage_options import DEFAULT_STORAGE, Storage
from msg_analysis.common.files import require_utf8
from msg_analysis.errors import BagError
from msg_analysis.types import IntArray
from msg_analysis.wire.topics import Topic

# As in rosbag2: small enough that a killed recorder loses little, large enough that the readers' work per chunk does
# not matter. With a third of it, reading takes a fifth longer.
CHUNK_SIZE = 768 * 1024
RECORDING_MARKER = ".recording"
RECORD_NAME = "msg_agents"  # of the MCAP metadata record with the run record
ROSBAG2_RECORD = "rosbag2"


class _Channel:
    """Number of a topic in the current file, its count there, and its number of messages in the files before."""

    __slots__ = ("before", "count", "id")

    def __init__(self, number: int, count: ChannelCount, before: int) -> None:
        self.id, self.count, self.before = number, count, before


class BagWriter:
    """A bag being written: its directory, new or empty, has ``.recording`` (locked) and no metadata.yaml.

    The run record (JSON) is kept in every file. A file is closed and on the disk before the next begins. BagError, here
    and in the methods: cannot be written; what was written before stays readable.
    """

    def __init__(
        self, directory: Path, topics: Sequence[Topic], *, record: str | None = None, storage: Storage = DEFAULT_STORAGE
    ) -> None:
        self.directory = Path(directory).absolute()
        require_utf8(self.directory)
        self._topics, self._record = tuple(topics), record
        self._compression, self._split_size = storage.compression, storage.split_size
        self._chunk_size = min(CHUNK_SIZE, self._split_size or CHUNK_SIZE)
        self._files: list[FileCount] = []
        self._channels: dict[str, _Channel] = {}
        self._custom: dict[str, str] = {}
        if record is not None:
            self._custom["run"] = str(json.loads(record).get("run", ""))
        self._closed = False
        try:
            # It may be there already, empty: a runner that starts several runs at once reserves their names that way.
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise FileExistsError
            self._stream: BinaryIO = self._next_stream()
            self._marker = (self.directory / RECORDING_MARKER).open("w", encoding="utf-8")
        except FileExistsError as error:
            raise exists_already(directory) from error
        except OSError as error:
            raise BagError(f"{directory}: cannot be made ({error.strerror}): choose another place") from error
        try:
            fcntl.flock(self._marker, fcntl.LOCK_EX)  # the system releases it when this process ends
            json.dump({"pid": os.getpid()}, self._marker)
            self._marker.flush()
            self._begin_file()
        except OSError as error:
            raise self._failed(error) from error

    def _next_stream(self) -> BinaryIO:
        self._file = FileCount(f"{self.directory.name}_{len(self._files)}.mcap")
        self._files.append(self._file)
        return (self.directory / self._file.name).open("xb")

    def _begin_file(self) -> None:
        """Write all that is needed to read this file without the others."""
        self._mcap = McapWriter(
            self._stream, chunk_size=self._chunk_size, compression=self._compression, directory=str(self.directory)
        )
        self._add_information()
        if self._record is not None:
            self._mcap.add_metadata(RECORD_NAME, {"record": self._record})
        schemas: dict[str, int] = {}
        for topic in self._topics:
            kind = topic.type.full_name
            if kind not in schemas:
                schemas[kind] = self._mcap.register_schema(kind, "ros2msg", topic.type.schema.encode())
            self._add_channel(topic, schemas[kind])
        self._mcap.flush()
        # The head is not counted: it may be larger than the limit, and every file has it.
        self._full = None if self._split_size is None else self._stream.tell() + self._split_size

    def _add_channel(self, topic: Topic, schema: int) -> None:
        offered = topic.qos.offered()
        count = ChannelCount(topic.name, topic.type.full_name, topic.type.type_hash, offered)
        metadata = {"offered_qos_profiles": dump(offered), "topic_type_hash": topic.type.type_hash}
        number = self._mcap.register_channel(topic.name, "cdr", schema, metadata)
        last = self._channels.get(topic.name)
        self._channels[topic.name] = _Channel(number, count, last.before + last.count.messages if last else 0)
        self._file.channels[topic.name] = count

    def _finish_file(self) -> None:
        self._add_information()
        self._mcap.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def _split(self) -> None:
        self._finish_file()
        self._stream = self._next_stream()
        self._begin_file()

    def write(self, topic: str, data: bytes, time_ns: int) -> None:
        """Append a message (CDR with encapsulation header) to a topic, by absolute name, at a simulated time [ns]."""
        channel = self._channels.get(topic)
        if channel is None or self._closed:
            raise self._refused("is closed" if self._closed else f"has no topic {topic}")
        try:
            if self._full is not None and self._stream.tell() >= self._full:
                self._split()
                channel = self._channels[topic]
            count = channel.count
            self._mcap.add_message(channel.id, time_ns, data, channel.before + count.messages)
        except OSError as error:
            raise self._failed(error) from error
        count.messages += 1
        file = self._file
        if time_ns > file.end:
            file.end = time_ns
        if time_ns < file.start:
            file.start = time_ns

    def write_many(
        self, topics: Sequence[str], of: IntArray, time_ns: IntArray, data: bytes, start: IntArray, size: IntArray
    ) -> None:
        """Append messages; of each, (messages,): index of its topic, time [ns], place and size of its bytes.

        The same as ``write`` for each, in a fraction of the time.
        """
        if self._closed:
            raise self._refused("is closed")
        done = 0
        try:
            while done < len(size):
                if self._full is not None and self._stream.tell() >= self._full:
                    self._split()
                piece = slice(done, done + self._mcap.fitting(size[done:]))
                self._write_piece(topics, of[piece], time_ns[piece], data, start[piece], size[piece])
                done = piece.stop
        except OSError as error:
            raise self._failed(error) from error

    def _write_piece(
        self, topics: Sequence[str], of: IntArray, time_ns: IntArray, data: bytes, start: IntArray, size: IntArray
    ) -> None:
        head = np.zeros(len(of), MESSAGE_HEAD)
        head["log_time"] = head["publish_time"] = time_ns
        order = np.argsort(of, kind="stable")
        present, first, counts = np.unique(of[order], return_index=True, return_counts=True)
        channels = [self._channels[topics[topic]] for topic in present.tolist()]
        number = [channel.id for channel in channels]
        earlier = [channel.before + channel.count.messages for channel in channels]
        head["channel"][order] = np.repeat(number, counts)
        head["sequence"][order] = np.arange(len(of)) + np.repeat(np.array(earlier) - first, counts)
        for channel, count in zip(channels, counts.tolist(), strict=True):
            channel.count.messages += count
        self._mcap.add_messages(head, data, start, size)
        self._file.end = max(self._file.end, int(time_ns.max()))
        self._file.start = min(self._file.start, int(time_ns.min()))

    @property
    def messages(self) -> int:
        """Written so far."""
        return sum(file.messages for file in self._files)

    def flush(self) -> None:
        """Hand everything so far to the operating system, so that it survives the end of this process."""
        try:
            self._mcap.flush()
        except OSError as error:
            raise self._failed(error) from error

    def close(self, complete: bool = True) -> None:
        """Finish the file, write metadata.yaml, remove the marker; ``complete``: whether the end of the run was seen.

        Calling it again does nothing. If the disk is full, the marker stays and the bag can be salvaged.
        """
        if self._closed:
            return
        self._custom["complete"] = "true" if complete else "false"
        try:
            self._finish_file()
            write_metadata(self.directory, bag_information(self._files, self._custom))
            (self.directory / RECORDING_MARKER).unlink()
            self._marker.close()
        except OSError as error:
            raise self._failed(error) from error
        self._closed = True

    def _add_information(self) -> None:
        information = bag_information(self._files, self._custom)
        self._mcap.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": dump(information)})

    def _refused(self, reason: str) -> BagError:
        return BagError(f"{self.directory}: {reason}: nothing more can be written to it")

    def _failed(self, error: OSError) -> BagError:
        self._closed = True
        for stream in (self._stream, self._marker):
            with contextlib.suppress(OSError):  # closing tries again to write what is left
                stream.close()
        return BagError(
            f"{self.directory}: cannot be written ({error.strerror or error}): free some space or choose "
            "another place; what was written before can still be read"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=error is None)


def exists_already(directory: Path) -> BagError:
    """The error for the directory of a new bag that is there already."""
    return BagError(f"{directory}: exists already: choose another name, or move it away first")


def recording_pid(directory: Path) -> int | None:
    """Process that is writing this bag; None where none is: the lock of the marker ends with its process."""
    try:
        with (directory / RECORDING_MARKER).open(encoding="utf-8") as marker:
            try:
                fcntl.flock(marker, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return int(json.load(marker)["pid"])
    except (OSError, ValueError, KeyError, TypeError):  # no marker, or not one of ours
        pass
    return None
