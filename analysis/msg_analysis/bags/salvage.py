"""Makes a bag out of what a killed recorder, a full disk or a power cut left behind."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.records import Channel
from mcap.writer import CompressionType, Writer

from msg_analysis.bags.mcapfile import Batch, McapFile
from msg_analysis.bags.metadata import (
    METADATA_FILE,
    ChannelCount,
    FileCount,
    bag_information,
    dump,
    write_metadata,
)
from msg_analysis.bags.reader import bag_files
from msg_analysis.bags.writer import CHUNK_SIZE, RECORDING_MARKER, ROSBAG2_RECORD, recording_pid
from msg_analysis.errors import BagError

_CUSTOM = {"complete": "false", "salvaged": "true"}


@dataclass(frozen=True, slots=True)
class SalvageReport:
    """What was saved.

    Attributes
    ----------
    kept_messages : in the new file; how many were in the lost part cannot be known
    kept_bytes, dropped_bytes : of the torn file: its whole records, and what follows them
    damaged_chunks : chunks in the whole part whose content was lost
    torn : what was there instead of the end of the file; None where it ended well
    """

    kept_messages: int
    kept_bytes: int
    dropped_bytes: int
    damaged_chunks: int = 0
    torn: str | None = None

    def __add__(self, other: SalvageReport) -> SalvageReport:
        """Of two files."""
        return SalvageReport(
            self.kept_messages + other.kept_messages,
            self.kept_bytes + other.kept_bytes,
            self.dropped_bytes + other.dropped_bytes,
            self.damaged_chunks + other.damaged_chunks,
            "; ".join(filter(None, (self.torn, other.torn))) or None,
        )


def salvage(torn: str | Path, out: str | Path) -> SalvageReport:
    """Make a bag of a torn .mcap file, or of a directory with such files. The torn one is left as it is.

    Parameters
    ----------
    torn : str | Path
        file or directory
    out : str | Path
        directory of the new bag; must not exist

    Raises
    ------
    BagError : nothing can be read, or ``out`` exists or cannot be written
    """
    out = Path(out).absolute()
    files = bag_files(Path(torn))
    workshop = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        if out.exists():
            raise BagError(f"{out}: exists already: choose another name, or move it away first")
        workshop.mkdir(parents=True)
        report, counts = _copy_all(files, [workshop / f"{out.name}_{i}.mcap" for i in range(len(files))])
        write_metadata(workshop, bag_information(counts, _CUSTOM))
        workshop.rename(out)
    except OSError as error:
        raise BagError(f"{out}: cannot be written ({error.strerror}): choose another place") from error
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
    return report


def salvage_in_place(directory: str | Path) -> SalvageReport:
    """Make the directory of a recording that was cut short a bag.

    Each file is first copied beside itself and replaced only when all copies are written; then comes
    metadata.yaml. Where this fails, nothing is lost and it can be done again.

    Parameters
    ----------
    directory : str | Path
        with .mcap files and no metadata.yaml

    Raises
    ------
    BagError : it is a bag already, is still being recorded, or cannot be read or written
    """
    directory = Path(directory).absolute()
    if (directory / METADATA_FILE).exists():
        raise BagError(f"{directory}: has its {METADATA_FILE}: it is a bag already, nothing to salvage")
    pid = recording_pid(directory)
    if pid is not None:
        raise BagError(f"{directory}: process {pid} is recording it: stop that first")
    files = bag_files(directory)
    copies = [file.with_name(f".{file.name}.salvaged") for file in files]
    try:
        report, counts = _copy_all(files, copies)
        for file, copy, count in zip(files, copies, counts, strict=True):
            target = file.with_name(file.name.removesuffix(".zstd"))  # the copy is compressed by chunks
            copy.replace(target)
            if target != file:
                file.unlink()
            count.name = target.name
        write_metadata(directory, bag_information(counts, _CUSTOM))
        (directory / RECORDING_MARKER).unlink(missing_ok=True)
    except OSError as error:
        raise BagError(f"{directory}: cannot be written ({error.strerror}): nothing was lost, try again") from error
    finally:
        for copy in copies:
            copy.unlink(missing_ok=True)
    return report


def _copy_all(files: Sequence[Path], copies: Sequence[Path]) -> tuple[SalvageReport, list[FileCount]]:
    total = SalvageReport(0, 0, 0)
    counts: list[FileCount] = []
    for file, copy in zip(files, copies, strict=True):
        report, count = _copy(file, copy)
        total += report
        counts.append(count)
    return total, counts


def _copy(file: Path, copy: Path) -> tuple[SalvageReport, FileCount]:
    """Write what is whole in one file to a new one."""
    source = McapFile(file)
    count = FileCount(copy.name)
    with copy.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        batches = source.batches()
        first = next(batches, None)  # the header has been read now
        writer.start(profile=source.profile or "ros2", library=source.library or "mcap")
        channels = _Channels(writer, source, count)
        for batch in itertools.chain([first] if first else [], batches):
            channels.write(batch)
        channels.register_all()
        for record in source.metadata:
            writer.add_metadata(record.name, record.metadata)
        for item in source.attachments:
            writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
        writer.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": dump(bag_information([count], _CUSTOM))})
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    dropped = 0 if source.torn is None else max(0, file.stat().st_size - source.whole_bytes)
    report = SalvageReport(count.messages, source.whole_bytes, dropped, source.damaged_chunks, source.torn)
    return report, count


class _Channels:
    """Copies messages; registers their channels and schemas in the new file when they first appear."""

    def __init__(self, writer: Writer, source: McapFile, count: FileCount) -> None:
        self._writer, self._source, self._count = writer, source, count
        self._schemas: dict[int, int] = {0: 0}  # number in the source: number in the copy; 0 means none
        self._channels: dict[int, int] = {}

    def register_all(self) -> None:
        for number in self._source.channels:
            self._register(number)

    def _register(self, number: int) -> int:
        if number in self._channels:
            return self._channels[number]
        channel = self._source.channels[number]
        schema = self._source.schemas.get(channel.schema_id)
        if schema is None:
            copied = 0
        elif schema.id in self._schemas:
            copied = self._schemas[schema.id]
        else:
            copied = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._schemas[schema.id] = copied
        self._channels[number] = self._writer.register_channel(
            channel.topic, channel.message_encoding, copied, channel.metadata
        )
        self._count.channels.setdefault(channel.topic, _channel_count(channel, schema.name if schema else ""))
        return self._channels[number]

    def write(self, batch: Batch) -> None:
        file = self._count
        for number, sequence, log_time, publish_time, start, size in batch.table.tolist():
            if number not in self._source.channels:
                continue  # its channel was in a chunk that is lost
            data = batch.data[start : start + size]
            self._writer.add_message(self._register(number), log_time, data, publish_time, sequence)
            file.start, file.end = min(file.start, log_time), max(file.end, log_time)
            file.channels[self._source.channels[number].topic].messages += 1


def _channel_count(channel: Channel, type_name: str) -> ChannelCount:
    try:
        qos: Any = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "[]"))
    except yaml.YAMLError:
        qos = []
    type_hash = channel.metadata.get("topic_type_hash", "")
    return ChannelCount(channel.topic, type_name, type_hash, qos if isinstance(qos, list) else [])
