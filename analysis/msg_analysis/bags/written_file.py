# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One MCAP file of a bag while it is written, with all that is needed to read it without the other files."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from msg_analysis.bags.format.mcap_chunks import MESSAGE_HEAD
from msg_analysis.bags.format.mcap_writer import McapWriter
from msg_analysis.bags.format.metadata import ChannelCount, FileCount, bag_information, dump
from msg_analysis.bags.format.storage_options import Storage
from msg_analysis.types import IntArray
from msg_analysis.wire.topics import Qos, Topic

# As in rosbag2: small enough that a killed recorder loses little, large enough that the readers' work per chunk does
# not matter. With a third of it, reading takes a fifth longer.
CHUNK_SIZE = 768 * 1024
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
            chunk_size=min(CHUNK_SIZE, storage.split_size or CHUNK_SIZE),
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
