# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The files of a bag, its metadata.yaml, and what the files hold, counted while they are read."""

from __future__ import annotations

import copy
import functools
import io
import os
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import yaml
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex
from mcap.summary import Summary

from msg_analysis.bags.mcap_reading import CHUNK_CRC, McapFile, chunk_head
from msg_analysis.bags.stored_file import BAG_SUFFIXES, RECORD_LIMIT, SQLITE_SUFFIX, Batch, SqliteFile, StoredFile
from msg_analysis.common.files import load_yaml, read_text
from msg_analysis.common.resources import ros_distribution
from msg_analysis.errors import BagError
from msg_analysis.experiment.loading import no_bag_but

METADATA_FILE = "metadata.yaml"
_ROOT = "rosbag2_bagfile_information"
# That in C, where PyYAML has them: metadata of 1000 agents has 30,000 lines.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_HEAD = 4096  # bytes in which rosbag2 has the start of a bag
_STARTED = re.compile(rb"^  starting_time:\n +nanoseconds_since_epoch: (\d{1,19})\n", re.MULTILINE)
_NEVER = 2**63 - 1  # what rosbag2 writes as the start of a bag without messages
_FOOTER = struct.Struct("<9xQQI8x")  # starts of summary and summary offsets; CRC of all from the summary up to itself
_BEHIND_CRC = 12  # bytes of the CRC and the closing magic


@dataclass(slots=True)
class ChannelCount:
    """A topic of a file and how many messages it has."""

    topic: str
    type_name: str
    type_hash: str
    qos: list[dict[str, Any]]  # offered profiles, the same list as in the MCAP channel
    messages: int = 0


@dataclass(slots=True)
class FileCount:
    """A file of a bag and what is in it."""

    name: str  # without directory
    start: int = _NEVER  # log time of the first message [ns]
    end: int = 0  # log time of the last message [ns]
    channels: dict[str, ChannelCount] = field(default_factory=dict)  # by topic

    @property
    def messages(self) -> int:
        """Of all topics."""
        return sum(channel.messages for channel in self.channels.values())


def bag_information(
    files: Sequence[FileCount], custom: Mapping[str, str], distribution: str | None = None
) -> dict[str, Any]:
    """What metadata.yaml says of a bag with these files; ``custom`` holds our own entries."""
    topics = total_channels(files)
    start = min(file.start for file in files)
    return {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": max(0, max(file.end for file in files) - start)},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.messages for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.topic,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topic.qos,
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.messages,
            }
            for topic in topics.values()
        ],
        "compression_format": "",  # only of rosbag2's own compression; MCAP files state that of their chunks
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.start},
                "duration": {"nanoseconds": max(0, file.end - file.start)},
                "message_count": file.messages,
            }
            for file in files
        ],
        "custom_data": dict(custom),
        # Of the recorder: the one here, unless another is given. Empty if unknown, as in rosbag2.
        "ros_distro": ros_distribution() if distribution is None else distribution,
    }


def total_channels(files: Sequence[FileCount]) -> dict[str, ChannelCount]:
    """The topics of the files of a bag by name, each with all its messages."""
    topics: dict[str, ChannelCount] = {}
    for file in files:
        for name, channel in file.channels.items():
            total = topics.setdefault(name, ChannelCount(name, channel.type_name, channel.type_hash, channel.qos))
            total.messages += channel.messages
    return topics


def dump(document: Any) -> str:
    """Plain values, lists and dicts as YAML, keys in the order given."""
    return str(yaml.dump(document, Dumper=_DUMPER, sort_keys=False))


def write_metadata(directory: Path, information: Mapping[str, Any]) -> None:
    """Put metadata.yaml with :func:`bag_information` into a bag, whole or not at all."""
    temporary = directory / f".{METADATA_FILE}.tmp"
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(dump({_ROOT: dict(information)}))
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(directory / METADATA_FILE)


def read_metadata(directory: Path) -> dict[str, Any] | None:
    """Bag information of a directory; None without metadata.yaml, BagError where it is not that of a bag."""
    file = directory / METADATA_FILE
    try:
        document = load_yaml(read_text(file))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, yaml.YAMLError) as error:  # ValueError: not UTF-8, or !!int x
        raise BagError(f"{file}: cannot be read ({error}): move it away to read the .mcap files alone") from error
    information = document.get(_ROOT) if isinstance(document, dict) else None
    if not isinstance(information, dict):
        raise BagError(f"{file}: no {_ROOT} in it: expected the metadata of a ROS 2 bag")
    return information


def starting_time(directory: Path) -> int | None:
    """Log time of the first message of a bag [ns], by the head of metadata.yaml alone; None where it is not there."""
    try:
        with (directory / METADATA_FILE).open("rb") as stream:
            found = _STARTED.search(stream.read(_HEAD))
    except OSError:
        return None
    return int(found[1]) if found and int(found[1]) != _NEVER else None


def stored_file(path: Path) -> StoredFile:
    """A file of a bag, to be read; sqlite3 if its name says so, else MCAP."""
    return SqliteFile(path) if SQLITE_SUFFIX in path.suffixes else McapFile(path)


def bag_files(path: Path) -> list[Path]:
    """The files of a bag in their order; BagError: there are none, one is missing, or another storage."""
    if path.is_file():
        if instead := no_bag_but(path):
            raise BagError(f"{path}: {instead}")
        return [path]
    if not path.is_dir():
        raise BagError(f"{path}: not found: expected the directory of a bag, or an .mcap or .db3 file")
    information = read_metadata(path)
    if information is None:
        files = _named_as_files(path)
        if not files:
            if {entry.name for entry in path.iterdir()} <= {"log"}:  # a run makes its directory before anything else
                raise BagError(f"{path}: empty: its run ended before anything was recorded: delete it")
            raise BagError(f"{path}: not a bag: expected metadata.yaml, .mcap or .db3 files in this directory")
        return sorted(files, key=_file_number)
    _refuse_unknown(path, information)
    names = information.get("relative_file_paths")
    files = [path / str(name) for name in names] if isinstance(names, list) else []
    # Before version 4 of the format of metadata.yaml, the names begin with that of the bag.
    files = [file if file.is_file() else path / file.name for file in files]
    lost = [file.name for file in files if not file.is_file()]
    if lost or not files:
        raise BagError(
            f"{path}: {', '.join(lost) or 'every file'} of its {METADATA_FILE} is missing: copy the whole bag, or move "
            f"{METADATA_FILE} away to read the files that are there"
        )
    return files


def first_file(path: Path) -> Path | None:
    """The first file of a bag by the names alone; None where there is none."""
    return min(_named_as_files(path), key=_file_number, default=None)


def _named_as_files(path: Path) -> list[Path]:
    return [file for suffix in BAG_SUFFIXES for file in path.glob(f"*{suffix}")]


def _refuse_unknown(path: Path, information: dict[str, Any]) -> None:
    storage = information.get("storage_identifier")
    if storage not in ("mcap", "sqlite3", "", None):  # the latter of a reindexed bag: the names of its files tell
        raise BagError(
            f"{path}: its storage is {storage}, expected mcap or sqlite3: record with `ros2 bag record -s mcap`, or "
            "convert it"
        )
    mode = str(information.get("compression_mode") or "none").lower()
    compression = information.get("compression_format") or "zstd"
    if mode != "none" and compression != "zstd":
        raise BagError(
            f"{path}: its compression_format is {compression}, expected zstd: convert it with `ros2 bag convert`"
        )


def _file_number(file: Path) -> tuple[int, str]:
    """Order of the files of a split bag, which rosbag2 numbers: name_0.mcap, name_1.mcap, ..., name_10.mcap."""
    number = re.search(r"_(\d+)\.(?:mcap|db3)", file.name)
    return int(number[1]) if number else 0, file.name


@dataclass(slots=True)
class FileInventory:
    """One file: what it holds and what is wrong with it, complete once ``watch`` has run to its end."""

    file: StoredFile
    count: FileCount = field(init=False)
    summary: Summary | None = None  # None where the file has none that is correct
    stated_messages: int | None = None  # how many messages its summary says that it has
    problem: str | None = None  # why nothing of the file can be read
    # By number: a topic that takes an old number later counts as the old one, as for other readers.
    _channels: dict[int, ChannelCount] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Count from the start."""
        self.count = FileCount(self.file.path.name)

    def watch(self) -> Iterator[Batch]:
        """The batches of the file, counted as they pass."""
        for batch in self.file.batches():
            head = batch.head[np.isin(batch.channel, list(self.file.channels))]
            for number, messages in zip(*np.unique(head["channel"], return_counts=True), strict=True):
                self._channel(int(number)).messages += int(messages)
            times = head["log_time"]
            if len(times):
                self.count.start = min(self.count.start, int(times.min()))
                self.count.end = max(self.count.end, int(times.max()))
            yield batch
        for number in self.file.channels:
            self._channel(number)
        if self.file.torn is None and isinstance(self.file, McapFile):
            self.summary, self.stated_messages = summary_of(self.file.path)
            if self.stated_messages is None and self.file.stated is not None:
                self.stated_messages = self.file.stated.message_count

    def _channel(self, number: int) -> ChannelCount:
        if number not in self._channels:
            channel = self.file.channels[number]
            schema = self.file.schemas.get(channel.schema_id)
            type_hash, qos = channel.metadata.get("topic_type_hash", ""), offered_profiles(channel)
            new = ChannelCount(channel.topic, schema.name if schema else "", type_hash, qos)
            self._channels[number] = self.count.channels.setdefault(channel.topic, new)
        return self._channels[number]

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


def summary_of(file: Path) -> tuple[Summary | None, int | None]:
    """The summary of an MCAP file, None where it or its chunk indexes are wrong, and how many messages it states."""
    try:
        with file.open("rb") as stream:
            stream.seek(-_FOOTER.size, io.SEEK_END)
            start, _, crc = _FOOTER.unpack(stream.read())
            stream.seek(start)
            right = not crc or crc == zlib.crc32(stream.read()[:-_BEHIND_CRC])  # the library does not check it
            stream.seek(0)
            summary = SeekingReader(stream, record_size_limit=RECORD_LIMIT).get_summary() if right else None
            if summary is None:
                return None, None
            right = all(_is_there(stream, index) for index in summary.chunk_indexes)
            # With a correct CRC, the summary is right, and the head of a chunk is damaged.
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
