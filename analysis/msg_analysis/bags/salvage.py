# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Makes a bag out of what a killed recorder, a full disk or a power cut left behind.

Whole MCAP files are copied byte for byte; the others are rewritten from their whole records, as MCAP.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.bags.files import (
    METADATA_FILE,
    FileInventory,
    bag_files,
    bag_information,
    dump,
    stored_file,
    write_metadata,
)
from msg_analysis.bags.mcap_writing import RECORD_NAME, ROSBAG2_RECORD, McapWriter
from msg_analysis.bags.stored_file import CHUNK_SIZE, SQLITE_SUFFIX, ZSTD_SUFFIX, Batch, StoredFile
from msg_analysis.bags.writing import RECORDING_MARKER, exists_already, recording_pid
from msg_analysis.errors import BagError

LONGEST_LIST = 500  # characters of what is said of torn files


@dataclass(frozen=True, slots=True)
class SalvageReport:
    """What was saved; sizes in bytes, of a file that is compressed as a whole (.zstd) unpacked."""

    kept_messages: int  # in the new bag
    kept_bytes: int  # of the whole records of all readable files
    # Behind the whole records of torn files, and all of unreadable ones; not exact for a torn .zstd file, of which
    # packed and unpacked bytes are compared.
    dropped_bytes: int
    lost_messages: int  # in damaged chunks of files that still state how many they had; not those that are cut off
    damaged_chunks: int  # in the whole part; their content was lost
    dropped_files: int  # of which nothing can be read
    torn: str | None  # instead of the end of the torn files, of many only the first; None: all were whole


def salvage(torn: str | Path, out: str | Path) -> SalvageReport:
    """Make a bag of a torn .mcap file, or of a directory with such files, which are left as they are.

    The new bag appears whole or not at all.

    Parameters
    ----------
    torn
        file or directory
    out
        directory of the new bag; must not exist

    Returns
    -------
    SalvageReport
        what was kept and what was lost

    Raises
    ------
    BagError
        no message can be read, the bag is still being recorded, or ``out`` exists or cannot be written
    """
    out = Path(out).absolute()
    _refuse_living(Path(torn))
    files = bag_files(Path(torn))
    unfinished = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        if out.exists():
            raise exists_already(out)
        entries = _read_all(files, parts=True)
        report = _report(entries)
        if not report.kept_messages:
            raise BagError(f"{torn}: no whole message is left in it: nothing can be salvaged")
        unfinished.mkdir(parents=True)
        for number, entry in enumerate(_readable(entries)):
            entry.count.name = f"{out.name}_{number}.mcap"
            copy = unfinished / entry.count.name
            if entry.whole:
                shutil.copyfile(entry.file.path, copy)
            else:
                _copy(entry, copy)
        write_metadata(unfinished, _information(entries))
        unfinished.rename(out)
    except OSError as error:
        raise BagError(f"{out}: cannot be written ({error.strerror}): choose another place") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return report


def salvage_in_place(directory: str | Path) -> SalvageReport:
    """Make a bag of the directory of an interrupted recording (no metadata.yaml yet); whole files stay as they are.

    Other files are replaced when all copies are written: if it fails, nothing is lost. BagError: a bag already, being
    recorded, or not readable or writable.
    """
    directory = Path(directory).absolute()
    if (directory / METADATA_FILE).exists():
        raise BagError(f"{directory}: has its {METADATA_FILE}: it is a bag already, nothing to salvage")
    _refuse_living(directory)
    # A file that cannot be read to its end stays as it is: of a disk, another attempt may read more.
    entries = _read_all(bag_files(directory), parts=False)
    report = _report(entries)
    copies: dict[Path, FileInventory] = {}  # of the files that are not whole
    try:
        for entry in _readable(entries):
            if not entry.whole:
                name = entry.count.name.removesuffix(ZSTD_SUFFIX).removesuffix(SQLITE_SUFFIX).removesuffix(".mcap")
                entry.count.name = f"{name}.mcap"  # whatever the file was, compressed by chunks
                copy = directory / f".{entry.file.path.name}.salvaged"
                copies[copy] = entry
                _copy(entry, copy)
        for copy, entry in copies.items():
            copy.replace(directory / entry.count.name)
            if entry.count.name != entry.file.path.name:
                entry.file.path.unlink()
        write_metadata(directory, _information(entries))
        (directory / RECORDING_MARKER).unlink(missing_ok=True)
    except OSError as error:
        raise BagError(f"{directory}: cannot be written ({error.strerror}): nothing was lost, try again") from error
    finally:
        for copy in copies:
            copy.unlink(missing_ok=True)
    return report


def _refuse_living(bag: Path) -> None:
    pid = recording_pid(bag if bag.is_dir() else bag.parent)
    if pid is not None:
        raise BagError(f"{bag}: process {pid} is recording it: stop that first")


def _read_all(files: Sequence[Path], *, parts: bool) -> list[FileInventory]:
    """What each file holds; with ``parts``, one that cannot be read any further is torn there, else unreadable."""
    entries = [FileInventory(stored_file(file)) for file in files]
    for entry in entries:
        try:
            for _ in entry.watch():
                pass
        except BagError as error:
            if parts and entry.count.messages:
                entry.file.torn = str(error)
            else:
                entry.problem = str(error)
    if not _readable(entries):
        raise BagError(entries[-1].problem)
    return entries


def _readable(entries: Sequence[FileInventory]) -> list[FileInventory]:
    return [entry for entry in entries if not entry.problem]


def _report(entries: Sequence[FileInventory]) -> SalvageReport:
    dropped = 0
    for entry in entries:
        size = entry.file.path.stat().st_size
        if entry.problem:
            dropped += size
        elif entry.file.torn:
            dropped += max(0, size - entry.file.whole_bytes)
    readable = _readable(entries)
    torn = "; ".join(entry.file.torn for entry in readable if entry.file.torn)
    end = torn.find("; ", LONGEST_LIST)
    return SalvageReport(
        kept_messages=sum(entry.count.messages for entry in readable),
        kept_bytes=sum(entry.file.whole_bytes for entry in readable),
        dropped_bytes=dropped,
        lost_messages=sum(entry.lost_messages or 0 for entry in readable),
        damaged_chunks=sum(entry.file.damaged_chunks for entry in readable),
        dropped_files=len(entries) - len(readable),
        torn=(torn if end < 0 else f"{torn[:end]}; ...") or None,
    )


def _information(entries: Sequence[FileInventory]) -> dict[str, Any]:
    """What is said of the new bag, or of one of its files: that it was salvaged, and what is known of the torn one."""
    record: dict[str, Any] = next((found for entry in entries if (found := _run_record(entry.file))), {})
    versions = record.get("versions")
    distribution = str(versions.get("ros_distro", "")) if isinstance(versions, dict) else ""
    custom = {"run": str(record["run"])} if record else {}
    counts = [entry.count for entry in _readable(entries)]
    return bag_information(counts, custom | {"complete": "false", "salvaged": "true"}, distribution)


def _run_record(file: StoredFile) -> dict[str, Any]:
    """The run record that the recorder wrote into the file; empty where there is none."""
    for record in file.metadata:
        with contextlib.suppress(ValueError, KeyError, RecursionError):  # another's of that name
            found = json.loads(record.metadata["record"]) if record.name == RECORD_NAME else None
            if isinstance(found, dict) and "run" in found:
                return found
    return {}


def _copy(entry: FileInventory, copy: Path) -> None:
    """Write what is whole in a file to a new one."""
    source = stored_file(entry.file.path)
    with copy.open("wb") as stream:
        writer = McapWriter(
            stream,
            chunk_size=CHUNK_SIZE,
            compression="zstd",
            profile=entry.file.profile or "ros2",
            library=entry.file.library or "mcap",
            directory=str(copy.parent),
        )
        channels = _Channels(writer, source)
        with contextlib.suppress(BagError):  # as far as it can be read: what is there was read before
            for batch in source.batches():
                channels.copy(batch)
        for number in source.channels:
            channels.number(number)
        for record in source.metadata:
            writer.add_metadata(record.name, record.metadata)
        for item in source.attachments:
            writer.add_attachment(item)
        writer.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": dump(_information([entry]))})
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())


class _Channels:
    """Copies messages; registers their channels and schemas in the new file when they first appear."""

    def __init__(self, writer: McapWriter, source: StoredFile) -> None:
        self._writer, self._source = writer, source
        # Numbers in the copy by those in the source. A topic that takes an old number later keeps the copy of the old
        # one, as for other readers.
        self._numbers: dict[int, int] = {}
        self._schemas: dict[int, int] = {}

    def number(self, number: int) -> int:
        """In the copy, of a channel of the source."""
        if number not in self._numbers:
            channel = self._source.channels[number]
            schema = self._source.schemas.get(channel.schema_id)
            if schema is not None and schema.id not in self._schemas:
                self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            copied = self._schemas[schema.id] if schema else 0  # 0: none
            self._numbers[number] = self._writer.register_channel(
                channel.topic, channel.message_encoding, copied, channel.metadata
            )
        return self._numbers[number]

    def copy(self, batch: Batch) -> None:
        # The channel of a message may have been in a chunk that is lost.
        known = np.flatnonzero(np.isin(batch.channel, list(self._source.channels)))
        head = batch.head[known]
        numbers, first = np.unique(head["channel"], return_index=True)
        renumbered = np.zeros(2**16, dtype=np.uint16)
        for number in numbers[np.argsort(first)].tolist():
            renumbered[number] = self.number(number)
        head["channel"] = renumbered[head["channel"]]
        self._writer.add_messages(head, batch.data, batch.start[known], batch.size[known])
