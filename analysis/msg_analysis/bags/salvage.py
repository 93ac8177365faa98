# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Makes a bag out of what a killed recorder, a full disk or a power cut left behind.

Whole MCAP files are copied byte for byte; the others are rewritten from their whole records, as MCAP.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.bags.files import (
    METADATA_FILE,
    ChannelCount,
    FileCount,
    FileInventory,
    bag_files,
    bag_information,
    channel_count,
    dump,
    stored_file,
    write_metadata,
)
from msg_analysis.bags.mcap_writing import RECORD_NAME, ROSBAG2_RECORD, McapWriter
from msg_analysis.bags.stored_file import CHUNK_SIZE, SQLITE_SUFFIX, ZSTD_SUFFIX, Batch, StoredFile
from msg_analysis.bags.writing import RECORDING_MARKER, exists_already, recording_pid
from msg_analysis.errors import BagError

LONGEST_LIST = 500  # characters of what is said of torn files
_MORE = "; ..."


@dataclass(frozen=True, slots=True)
class SalvageReport:
    """What was saved; sizes in bytes, of a file that is compressed as a whole (.zstd) unpacked."""

    kept_messages: int  # in the new bag
    kept_bytes: int  # of the whole records of all readable files
    # Behind the whole records of torn files, and all of unreadable ones; not exact for a torn .zstd file, of which
    # packed and unpacked bytes are compared.
    dropped_bytes: int
    lost_messages: int = 0  # in damaged chunks of files that still state how many they had; not those that are cut off
    damaged_chunks: int = 0  # in the whole part; their content was lost
    dropped_files: int = 0  # of which nothing can be read
    torn: str | None = None  # instead of the end of the torn files, of many only the first; None: all were whole

    def __add__(self, other: SalvageReport) -> SalvageReport:
        """Of two files together."""
        sums: list[Any] = [mine + its for mine, its in zip(astuple(self)[:-1], astuple(other)[:-1], strict=True)]
        return SalvageReport(*[*sums, _joined(self.torn, other.torn)])


def _joined(first: str | None, second: str | None) -> str | None:
    """Both texts; of many, only the beginning."""
    if first is None or second is None or first.endswith(_MORE):
        return first or second
    return f"{first}; {second}" if len(first) < LONGEST_LIST else first + _MORE


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
        entries, total = _read_all(files, parts=True)
        if not total.kept_messages:
            raise BagError(f"{torn}: no whole message is left in it: nothing can be salvaged")
        unfinished.mkdir(parents=True)
        readable = [entry for entry in entries if not entry.problem]
        for number, entry in enumerate(readable):
            copy = unfinished / f"{out.name}_{number}.mcap"
            if entry.whole:
                shutil.copyfile(entry.file.path, copy)
                entry.count.name = copy.name
            else:
                entry.count = _copy(entry.file.path, copy)
        counts = [entry.count for entry in readable]
        write_metadata(unfinished, _information((entry.file for entry in entries), counts))
        unfinished.rename(out)
    except OSError as error:
        raise BagError(f"{out}: cannot be written ({error.strerror}): choose another place") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return total


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
    entries, total = _read_all(bag_files(directory), parts=False)
    readable = [entry for entry in entries if not entry.problem]
    copies: dict[Path, Path] = {}  # of the files that are not whole
    try:
        for entry in readable:
            file = entry.file.path
            if not entry.whole:
                copies[file] = file.with_name(f".{file.name}.salvaged")
                entry.count = _copy(file, copies[file])
        for entry in readable:
            file, name = entry.file.path, entry.file.path.name
            if file in copies:  # the copy is MCAP, compressed by chunks
                name = name.removesuffix(ZSTD_SUFFIX).removesuffix(SQLITE_SUFFIX).removesuffix(".mcap") + ".mcap"
                copies[file].replace(file.with_name(name))
                if name != file.name:
                    file.unlink()
            entry.count.name = name
        information = _information((entry.file for entry in entries), [entry.count for entry in readable])
        write_metadata(directory, information)
        (directory / RECORDING_MARKER).unlink(missing_ok=True)
    except OSError as error:
        raise BagError(f"{directory}: cannot be written ({error.strerror}): nothing was lost, try again") from error
    finally:
        for copy in copies.values():
            copy.unlink(missing_ok=True)
    return total


def _refuse_living(bag: Path) -> None:
    pid = recording_pid(bag if bag.is_dir() else bag.parent)
    if pid is not None:
        raise BagError(f"{bag}: process {pid} is recording it: stop that first")


def _read_all(files: Sequence[Path], *, parts: bool) -> tuple[list[FileInventory], SalvageReport]:
    """Read all files: what each holds, and the report of all.

    With ``parts``, a file that cannot be read any further counts as torn there, otherwise as unreadable.
    """
    entries, total = [], SalvageReport(0, 0, 0)
    for file in files:
        entry = FileInventory(stored_file(file), FileCount(file.name))
        entries.append(entry)
        try:
            for _ in entry.watch():
                pass
        except BagError as error:
            if parts and entry.count.messages:
                entry.file.torn = str(error)
            else:
                entry.problem = str(error)
            if len(entries) == len(files) and all(entry.problem for entry in entries):
                raise
        total += _report(entry)
    return entries, total


def _report(entry: FileInventory) -> SalvageReport:
    source, size = entry.file, entry.file.path.stat().st_size
    if entry.problem:
        return SalvageReport(0, 0, size, dropped_files=1)
    dropped = 0 if source.torn is None else max(0, size - source.whole_bytes)
    lost, damaged = entry.lost_messages or 0, source.damaged_chunks
    return SalvageReport(entry.count.messages, source.whole_bytes, dropped, lost, damaged, torn=source.torn)


def _information(files: Iterable[StoredFile], counts: Sequence[FileCount]) -> dict[str, Any]:
    """What is said of the new bag, or of one of its files: that it was salvaged, and what is known of the torn one."""
    custom = {"complete": "false", "salvaged": "true"}
    for file in files:
        record = _run_record(file)
        if "run" in record:
            return bag_information(counts, {"run": str(record["run"]), **custom}, _distribution(record))
    return bag_information(counts, custom, "")


def _run_record(file: StoredFile) -> dict[str, Any]:
    """The run record that the recorder wrote into the file; empty where there is none."""
    for record in file.metadata:
        with contextlib.suppress(ValueError, KeyError, RecursionError):  # another's of that name
            if record.name == RECORD_NAME and isinstance(found := json.loads(record.metadata["record"]), dict):
                return found
    return {}


def _distribution(record: Mapping[str, Any]) -> str:
    """The ROS 2 that a run was recorded with; empty where its record does not say."""
    versions = record.get("versions")
    return str(versions.get("ros_distro", "")) if isinstance(versions, dict) else ""


def _readable(file: StoredFile) -> Iterator[Batch]:
    """Its messages up to where it cannot be read any further; some are known to be there."""
    with contextlib.suppress(BagError):
        yield from file.batches()


def _copy(file: Path, copy: Path) -> FileCount:
    """Write what is whole in one file to a new one."""
    source = stored_file(file)
    count = FileCount(copy.name)
    with copy.open("wb") as stream:
        batches = _readable(source)
        first = next(batches, None)  # reads the header
        writer = McapWriter(
            stream,
            chunk_size=CHUNK_SIZE,
            compression="zstd",
            profile=source.profile or "ros2",
            library=source.library or "mcap",
            directory=str(copy.parent),
        )
        channels = _Channels(writer, source, count)
        for batch in itertools.chain([first] if first else [], batches):
            channels.write(batch)
        channels.register_all()
        for record in source.metadata:
            writer.add_metadata(record.name, record.metadata)
        for item in source.attachments:
            writer.add_attachment(item)
        writer.add_metadata(ROSBAG2_RECORD, {"serialized_metadata": dump(_information([source], [count]))})
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    return count


class _Channels:
    """Copies messages; registers their channels and schemas in the new file when they first appear."""

    def __init__(self, writer: McapWriter, source: StoredFile, count: FileCount) -> None:
        self._writer, self._source, self._count = writer, source, count
        self._schemas: dict[int, int] = {0: 0}  # number in the source: number in the copy; 0 means none
        # Number in the copy, and the count, of every number in the source; a topic that takes an old number later
        # counts as the old one, as for other readers.
        self._channels: dict[int, tuple[int, ChannelCount]] = {}

    def register_all(self) -> None:
        for number in self._source.channels:
            self._register(number)

    def _register(self, number: int) -> tuple[int, ChannelCount]:
        if number in self._channels:
            return self._channels[number]
        channel = self._source.channels[number]
        schema = self._source.schemas.get(channel.schema_id)
        if schema is not None and schema.id not in self._schemas:
            self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        copied = self._schemas[schema.id] if schema else 0
        copy = self._writer.register_channel(channel.topic, channel.message_encoding, copied, channel.metadata)
        count = self._count.channels.setdefault(channel.topic, channel_count(channel, schema.name if schema else ""))
        self._channels[number] = copy, count
        return self._channels[number]

    def write(self, batch: Batch) -> None:
        # The channel of a message may have been in a chunk that is lost.
        known = np.flatnonzero(np.isin(batch.channel, list(self._source.channels)))
        if not len(known):
            return
        head = batch.head[known]
        numbers, first, counts = np.unique(head["channel"], return_index=True, return_counts=True)
        renumbered = np.zeros(2**16, dtype=np.uint16)
        for index in np.argsort(first).tolist():
            number = int(numbers[index])
            renumbered[number], count = self._register(number)
            count.messages += int(counts[index])
        head["channel"] = renumbered[head["channel"]]
        self._writer.add_messages(head, batch.data, batch.start[known], batch.size[known])
        file = self._count
        file.start = min(file.start, int(head["log_time"].min()))
        file.end = max(file.end, int(head["log_time"].max()))
