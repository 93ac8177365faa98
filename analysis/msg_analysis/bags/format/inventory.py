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

"""What the files of a bag hold, counted while they are read, whatever the messages are and however a file ends.

Also the check of a file's summary, which the library reads without looking at its checksum.
"""

from __future__ import annotations

import copy
import functools
import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import yaml
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex
from mcap.summary import Summary

from msg_analysis.bags.format.mcap_chunks import CHUNK_CRC, RECORD_LIMIT, chunk_head
from msg_analysis.bags.format.mcap_file import McapFile
from msg_analysis.bags.format.metadata import ChannelCount, FileCount
from msg_analysis.bags.format.stored_file import Batch, StoredFile
from msg_analysis.common.bounded_input import load_yaml

_FOOTER = struct.Struct("<9xQQI8x")  # starts of summary and summary offsets; CRC of all from the summary up to itself
_BEHIND_CRC = 12  # bytes of the CRC and the closing magic


@dataclass(slots=True)
class FileInventory:
    """One file: what it holds and what is wrong with it, complete once ``watch`` has run to its end."""

    file: StoredFile
    count: FileCount
    summary: Summary | None = None  # None where the file has none that is correct
    stated_messages: int | None = None  # how many messages its summary says that it has
    problem: str | None = None  # why nothing of the file can be read

    def watch(self) -> Iterator[Batch]:
        """The batches of the file, counted as they pass."""
        for batch in self.file.batches():
            numbers, counts = np.unique(batch.channel, return_counts=True)
            known = [number in self.file.channels for number in numbers.tolist()]
            for number, messages in zip(numbers[known].tolist(), counts[known].tolist(), strict=True):
                self._channel(number).messages += messages
            times = batch.table[np.isin(batch.channel, numbers[known]), 2]
            if len(times):
                self.count.start = min(self.count.start, int(times.min()))
                self.count.end = max(self.count.end, int(times.max()))
            yield batch
        for number in self.file.channels:
            self._channel(number)
        if self.file.torn is None and isinstance(self.file, McapFile):
            self.summary, self.stated_messages = summary_of(self.file.path)

    def _channel(self, number: int) -> ChannelCount:
        channel = self.file.channels[number]
        if channel.topic not in self.count.channels:
            schema = self.file.schemas.get(channel.schema_id)
            self.count.channels[channel.topic] = channel_count(channel, schema.name if schema else "")
        return self.count.channels[channel.topic]

    @property
    def whole(self) -> bool:
        """Whether other programs can read it as it is: MCAP, not torn, not damaged, with a correct summary."""
        file = self.file
        if not isinstance(file, McapFile) or file.unpacked_messages:
            return False
        sound = self.summary is not None and self.lost_messages == 0
        return sound and not file.damaged_chunks and not file.false_indexes

    @property
    def lost_messages(self) -> int | None:
        """How many messages fewer were read than its summary states; None where that is not known."""
        return None if self.stated_messages is None else max(0, self.stated_messages - self.count.messages)

    @property
    def compression(self) -> str | None:
        """Compression of its chunks: "none", "zstd", "lz4", or several; None without a summary or chunks."""
        kinds = {index.compression or "none" for index in self.summary.chunk_indexes} if self.summary else set()
        return ", ".join(sorted(kinds)) or None


@dataclass(slots=True)
class Inventory:
    """All files of a bag, in their order."""

    files: list[FileInventory] = field(default_factory=list)

    def add(self, file: StoredFile) -> FileInventory:
        """Add a file that has not been read yet."""
        self.files.append(FileInventory(file, FileCount(file.path.name)))
        return self.files[-1]


def summary_of(file: Path) -> tuple[Summary | None, int | None]:
    """The summary at the end of an MCAP file, and the number of messages that it states.

    No summary where it or its chunk indexes are wrong. The number is known also where the CRC shows that the summary is
    right: then the head of a chunk is damaged.
    """
    try:
        with file.open("rb") as stream:
            stream.seek(-_FOOTER.size, io.SEEK_END)
            start, _, crc = _FOOTER.unpack(stream.read())
            stream.seek(start)
            if crc and crc != zlib.crc32(stream.read()[:-_BEHIND_CRC]):  # the library does not check it
                return None, None
            stream.seek(0)
            summary = SeekingReader(stream, record_size_limit=RECORD_LIMIT).get_summary()
            if summary is None:
                return None, None
            right = all(_is_there(stream, index) for index in summary.chunk_indexes)
            stated = summary.statistics.message_count if summary.statistics and (right or crc) else None
            return summary if right else None, stated
    except Exception:  # the library raises many kinds of errors on damage
        return None, None


def _is_there(stream: BinaryIO, index: ChunkIndex) -> bool:
    """Whether the chunk that an index describes stands where the index says, with the same head."""
    head = chunk_head(index)
    stream.seek(index.chunk_start_offset)
    found = bytearray(stream.read(len(head)))
    found[CHUNK_CRC] = head[CHUNK_CRC]
    return found == head and len(head) + index.compressed_size == index.chunk_length


def channel_count(channel: Channel, type_name: str) -> ChannelCount:
    """A topic without messages yet, from an MCAP channel; ``type_name`` is ``package/msg/Name``."""
    type_hash = channel.metadata.get("topic_type_hash", "")
    return ChannelCount(channel.topic, type_name, type_hash, offered_profiles(channel))


def offered_profiles(channel: Channel) -> list[Any]:
    """The QoS profiles that the publishers of a channel offered, as rosbag2 writes them; empty if not readable."""
    return copy.deepcopy(_profiles(channel.metadata.get("offered_qos_profiles", "")))


@functools.lru_cache(maxsize=16)
def _profiles(text: str) -> list[Any]:
    """All agents have the same text."""
    try:
        profiles = load_yaml(text)
    except (ValueError, yaml.YAMLError):
        return []
    return profiles if isinstance(profiles, list) else []
