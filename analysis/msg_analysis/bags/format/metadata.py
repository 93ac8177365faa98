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

"""metadata.yaml of a bag, version 9 of rosbag2's format."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from msg_analysis.common.bounded_input import load_yaml, read_text
from msg_analysis.common.version import ros_distribution
from msg_analysis.errors import BagError

METADATA_FILE = "metadata.yaml"
_ROOT = "rosbag2_bagfile_information"
# That in C, where PyYAML has them: metadata of 1000 agents has 30,000 lines.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_HEAD = 4096  # bytes in which rosbag2 has the start of a bag
_STARTED = re.compile(rb"^  starting_time:\n +nanoseconds_since_epoch: (\d{1,19})\n", re.MULTILINE)
_NEVER = 2**63 - 1  # what rosbag2 writes as the start of a bag without messages


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

    @property
    def duration(self) -> int:
        """From the first to the last message [ns]."""
        return max(0, self.end - self.start)


def bag_information(
    files: Sequence[FileCount], custom: Mapping[str, str], distribution: str | None = None
) -> dict[str, Any]:
    """What metadata.yaml says of a bag with these files, in their order; ``custom`` holds our own entries.

    ``distribution``: the ROS 2 that it was recorded with; None: the one here. Empty if unknown, as in rosbag2.
    """
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
                "duration": {"nanoseconds": file.duration},
                "message_count": file.messages,
            }
            for file in files
        ],
        "custom_data": dict(custom),
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
