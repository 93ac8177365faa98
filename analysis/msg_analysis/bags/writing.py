# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Writing bags: of a network that runs, and of a whole run.

Writes a bag that rosbag2, rosbags, Foxglove and PlotJuggler open: a directory with MCAP files.

While it is written, the directory has a locked marker instead of metadata.yaml. The files of a split bag follow each
other in time, and each begins with what is in force of the latched topics.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import heapq
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from msg_analysis.bags.files import ChannelCount, FileCount, bag_information, dump, write_metadata
from msg_analysis.bags.mcap_chunks import DEFAULT_STORAGE, MESSAGE_HEAD, Storage
from msg_analysis.bags.mcap_writing import McapWriter
from msg_analysis.common.arrays import IntArray
from msg_analysis.common.files import require_utf8
from msg_analysis.errors import BagError
from msg_analysis.messages.topics import Qos, Topic

RECORD_NAME = "msg_agents"  # of the MCAP metadata record with the run record
ROSBAG2_RECORD = "rosbag2"


@dataclass(frozen=True, slots=True, order=True)
class LatchedMessage:
    """A message that later files repeat at their heads; in the order of time, then of its topic's messages."""

    time: int  # [ns]
    sequence: int  # among the messages of its topic, from 0
    topic: str
    data: bytes
    until: int | None  # last time [ns] at which it is in force; None: always


class WrittenFile:
    """A new file; OSError, from every method: exists, or cannot be written.

    A split bag knows where the file ends only when it is full: messages up to ``bound`` still belong into it then.
    """

    def __init__(self, path: Path, earlier: Sequence[FileCount], storage: Storage, *, begin: int = 0) -> None:
        self.count = FileCount(path.name)
        self.begin = begin  # first time that belongs into it [ns]
        self.bound: int | None = None  # last one [ns]; None: not full
        self.behind: set[str] = set()  # topics of which messages up to the bound may still come
        self._earlier, self._storage, self._directory = list(earlier), storage, str(path.parent)
        self._numbers: dict[str, int] = {}  # of the channels
        self._stream: BinaryIO = path.open("xb")

    def write_head(
        self,
        topics: Sequence[Topic],
        record: str | None,
        custom: Mapping[str, str],
        latched: Iterable[LatchedMessage] = (),
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
            self._add_channel(topic, schemas[kind])
        for message in latched:
            self.repeat(message)
        self.mcap.flush()
        # The head is not counted: it may be larger than the limit, and every file has it.
        self._limit = None if storage.split_size is None else self._stream.tell() + storage.split_size

    def _add_channel(self, topic: Topic, schema: int) -> None:
        offered = topic.qos.offered()
        self.count.channels[topic.name] = ChannelCount(topic.name, topic.type.full_name, topic.type.type_hash, offered)
        metadata = {"offered_qos_profiles": _offered(topic.qos), "topic_type_hash": topic.type.type_hash}
        self._numbers[topic.name] = self.mcap.register_channel(topic.name, "cdr", schema, metadata)

    @property
    def full(self) -> bool:
        """Whether it has as many bytes as a file of a split bag should have."""
        return self._limit is not None and self._stream.tell() >= self._limit

    def add(self, topic: str, data: bytes, time_ns: int, sequence: int) -> None:
        """Append a message."""
        self.mcap.add_message(self._numbers[topic], time_ns, data, sequence)
        self._counted(topic, 1, time_ns, time_ns)

    def repeat(self, message: LatchedMessage) -> None:
        """Append a message again that another file has: logged at the beginning of this one, published when it was."""
        self.mcap.add_message(
            self._numbers[message.topic], self.begin, message.data, message.sequence, published_ns=message.time
        )
        self._counted(message.topic, 1, self.begin, self.begin)

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
        count = self.count
        count.channels[topic].messages += messages
        if end > count.end:
            count.end = end
        if begin < count.start:
            count.start = begin

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


RECORDING_MARKER = ".recording"
# Files that wait for late messages. An agent so far behind that this is not enough is dead, and its messages, if it
# comes back, are in a later file.
MOST_OPEN = 3


class BagWriter:
    """A bag being written: its directory, new or empty, has ``.recording`` (locked) and no metadata.yaml.

    The run record (JSON) is kept in every file. A full file is closed, and on the disk, when all topics have passed its
    end. BagError, here and in the methods: cannot be written; what was written before stays readable.
    """

    def __init__(
        self, directory: Path, topics: Sequence[Topic], *, record: str | None = None, storage: Storage = DEFAULT_STORAGE
    ) -> None:
        self.directory = Path(directory).absolute()
        require_utf8(self.directory)
        self._topics, self._record, self._storage = tuple(topics), record, storage
        self._latched = {topic.name for topic in topics if topic.qos.latched}
        self._streams = {topic.name for topic in topics} - self._latched
        self._sequences = dict.fromkeys((topic.name for topic in topics), 0)  # messages of each topic so far
        self._counts: list[FileCount] = []  # of all files
        self._now = 0  # latest time [ns] of what is in the files
        self._held: list[LatchedMessage] = []  # a heap; what is ahead of that, of a split bag
        self._in_force: list[LatchedMessage] = []  # what the next file begins with
        self._custom: dict[str, str] = {}
        if record is not None:
            self._custom["run"] = str(json.loads(record).get("run", ""))
        self._closed = False
        try:
            # It may be there already, empty: a runner that starts several runs at once reserves their names that way.
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise FileExistsError
            self._open = [self._new_file()]  # those that are not finished, in their order
            self._marker = (self.directory / RECORDING_MARKER).open("w", encoding="utf-8")
        except FileExistsError as error:
            raise exists_already(directory) from error
        except OSError as error:
            raise BagError(f"{directory}: cannot be made ({error.strerror}): choose another place") from error
        try:
            fcntl.flock(self._marker, fcntl.LOCK_EX)  # the system releases it when this process ends
            json.dump({"pid": os.getpid()}, self._marker)
            self._marker.flush()
            self._open[0].write_head(self._topics, record, self._custom)
        except OSError as error:
            raise self._failed(error) from error

    def _new_file(self, begin: int = 0) -> WrittenFile:
        path = self.directory / f"{self.directory.name}_{len(self._counts)}.mcap"
        file = WrittenFile(path, self._counts, self._storage, begin=begin)
        self._counts.append(file.count)
        return file

    def write(self, topic: str, data: bytes, time_ns: int, until: int | None = None) -> None:
        """Append a message (CDR with encapsulation header) to a topic, by absolute name, at a simulated time [ns].

        Files that begin later repeat it if the topic is latched, up to the time ``until`` [ns] (None: always). A split
        bag keeps a latched message that is ahead of its time until then.
        """
        if topic not in self._sequences or self._closed:
            raise self._refused("is closed" if self._closed else f"has no topic {topic}")
        try:
            if topic in self._latched:
                message = LatchedMessage(time_ns, self._sequences[topic], topic, data, until)
                self._sequences[topic] += 1
                if self._storage.split_size is not None and time_ns > self._now:
                    heapq.heappush(self._held, message)
                else:
                    self._place(message)
                return
            self._release(time_ns)
            file = self._file_of(time_ns)
            file.add(topic, data, time_ns, self._sequences[topic])
            self._sequences[topic] += 1
            self._passed(file, (topic,))
        except OSError as error:
            raise self._failed(error) from error

    def write_many(
        self, topics: Sequence[str], of: IntArray, time_ns: IntArray, data: bytes, start: IntArray, size: IntArray
    ) -> None:
        """Append messages of topics that are not latched.

        Of each, (messages,): index of its topic, time [ns], place and size of its bytes. The same as ``write`` for
        each, in a fraction of the time.
        """
        if self._closed:
            raise self._refused("is closed")
        done = 0
        try:
            while done < len(of):
                file = self._file_of(int(time_ns[done]))
                end = done + file.mcap.fitting(size[done : done + self._together(file, time_ns[done:])])
                piece = slice(done, end)
                if self._release(int(time_ns[piece].max())):
                    continue  # perhaps into a new file
                present = file.add_many(
                    topics, of[piece], time_ns[piece], data, start[piece], size[piece], self._sequences
                )
                self._passed(file, present)
                done = end
        except OSError as error:
            raise self._failed(error) from error

    def _together(self, file: WrittenFile, time_ns: IntArray) -> int:
        """How many of the messages with these times belong into the same file as the first."""
        before = self._open.index(file)
        if not before and file.bound is None:
            return len(time_ns)
        others = np.zeros(len(time_ns), dtype=np.bool_)
        if file.bound is not None:
            others |= time_ns > file.bound
        if before:
            bound = self._open[before - 1].bound
            assert bound is not None  # only the last file has none
            others |= time_ns <= bound
        return int(np.argmax(others)) if others.any() else len(others)

    def _file_of(self, time_ns: int) -> WrittenFile:
        """The file of a message with this time; a new one if the last one is full."""
        last = self._open[-1]
        if last.bound is None:
            if not last.full:
                return last if len(self._open) == 1 else self._first_with(time_ns) or last
            last.bound, last.behind = last.count.end, set(self._streams)
        return self._first_with(time_ns) or self._begin_file(last.bound + 1)

    def _first_with(self, time_ns: int) -> WrittenFile | None:
        return next((file for file in self._open if file.bound is not None and time_ns <= file.bound), None)

    def _begin_file(self, begin: int) -> WrittenFile:
        if len(self._open) == MOST_OPEN:
            self._finish_first()
        self._open.append(self._new_file(begin))
        self._in_force = [each for each in self._in_force if each.until is None or each.until >= begin]
        self._open[-1].write_head(self._topics, self._record, self._custom, self._in_force)
        return self._open[-1]

    def _finish_first(self) -> None:
        self._open[0].finish()
        del self._open[0]

    def _passed(self, file: WrittenFile, topics: Iterable[str]) -> None:
        """Finish the files before this one that no topic has messages for any more, now that these are here."""
        if file is self._open[0]:
            return
        for earlier in self._open[: self._open.index(file)]:
            earlier.behind.difference_update(topics)
        while self._open[0].bound is not None and not self._open[0].behind:
            self._finish_first()

    def _release(self, now: int) -> bool:
        """Write what was held for this time [ns]; whether there was something."""
        self._now = max(self._now, now)
        some = False
        while self._held and self._held[0].time <= now:
            self._place(heapq.heappop(self._held))
            some = True
        return some

    def _place(self, message: LatchedMessage) -> None:
        file = self._file_of(message.time)
        file.add(message.topic, message.data, message.time, message.sequence)
        if self._storage.split_size is None:
            return
        self._in_force.append(message)
        for later in self._open[self._open.index(file) + 1 :]:  # it is late: their heads are written
            if message.until is None or message.until >= later.begin:
                later.repeat(message)

    @property
    def messages(self) -> int:
        """Written so far, without repetitions."""
        return sum(self._sequences.values())

    def flush(self) -> None:
        """Hand everything so far to the operating system, so that it survives the end of this process."""
        try:
            for file in self._open:
                file.mcap.flush()
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
            self._release(2**63)
            while self._open:
                self._finish_first()
            write_metadata(self.directory, bag_information(self._counts, self._custom))
            (self.directory / RECORDING_MARKER).unlink()
            self._marker.close()
        except OSError as error:
            raise self._failed(error) from error
        self._closed = True

    def _refused(self, reason: str) -> BagError:
        return BagError(f"{self.directory}: {reason}: nothing more can be written to it")

    def _failed(self, error: OSError) -> BagError:
        self._closed = True
        for file in self._open:
            file.abandon()
        with contextlib.suppress(OSError):
            self._marker.close()
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
