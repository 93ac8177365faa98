# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The messages of a bag, of any topics and types, in the order of time: what a player publishes.

Within a topic that is the order of the file; a message logged earlier than its predecessor on the topic takes the time
of that. Across topics it is the order of log times, then of the file. A bag is only nearly in that order, so messages
are held until nothing earlier can follow: an outline of each file, taken first, bounds the times behind each point.
Messages of latched topics that later files of a split bag repeat are left out.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from mcap.records import Channel, Schema

from msg_analysis.bags.files import bag_files, offered_profiles, stored_file, summary_of
from msg_analysis.bags.mcap_reading import McapFile
from msg_analysis.bags.mcap_writing import ENTRY, MESSAGE_INDEX
from msg_analysis.bags.stored_file import ros_topic, ros_type
from msg_analysis.errors import BagError

# Bytes of messages held to be put in order. A bag that needs more is played out of order rather than held in memory.
MOST_HELD = 256 * 2**20
# Messages of latched topics by which repetitions are recognised. What is repeated becomes one of the newest again.
MOST_LATCHED = 2**16
_LATCHED = ("transient_local", 1)  # as text, and as the number of older rosbag2


@dataclass(slots=True)
class BagTopic:
    """A topic of a bag."""

    name: str  # absolute
    type_name: str  # such as ``std_msgs/msg/String``; empty where the bag does not state it
    encoding: str  # of the messages; ``cdr`` in ROS 2
    type_hash: str  # empty where the bag does not state it
    latched: bool  # whether a publisher kept its messages for late subscribers
    messages: int = 0


@dataclass(slots=True)
class _Outline:
    """What is known of a file before it is played."""

    path: Path
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    lows: list[tuple[int, int]] = field(default_factory=list)  # (end of a piece [bytes], its earliest log time [ns])
    start: int | None = None  # earliest log time [ns]; None without messages
    end: int | None = None  # latest log time [ns]
    torn: str | None = None
    damaged_chunks: int = 0  # so far

    @property
    def damage(self) -> str | None:
        """What is wrong with it, as far as it was read."""
        damaged = f"damaged chunks that are left out: {self.damaged_chunks}" if self.damaged_chunks else None
        return "; ".join(filter(None, (self.torn, damaged))) or None


@dataclass(frozen=True, slots=True)
class Message:
    """A message of a bag."""

    time: int  # log time, at least that of its predecessor on the topic [ns]
    topic: str
    data: bytes  # as recorded


class Playback:
    """A bag in the order of time, a piece at a time; BagError: no bag, no messages, or a topic with two types."""

    def __init__(self, path: Path, most_held: int = MOST_HELD) -> None:
        self._most_held = most_held  # bytes
        self._outlines: list[_Outline] = []
        self._unreadable: list[BagError] = []
        for file in bag_files(Path(path)):
            try:
                self._outlines.append(_quick_outline(file) or _outline(file))
            except (BagError, OSError) as error:  # as for other readers, the rest of the bag counts
                self._unreadable.append(BagError(str(error)))
        if not self._outlines:
            raise self._unreadable[0]
        starts = [outline.start for outline in self._outlines if outline.start is not None]
        ends = [outline.end for outline in self._outlines if outline.end is not None]
        if not starts:
            raise BagError(f"{path}: has no messages: there is nothing to play")
        self.start, self.end = min(starts), max(ends)  # extreme log times [ns]
        self.topics: dict[str, BagTopic] = {}  # with messages, by name
        for outline in self._outlines:
            for number, channel in outline.channels.items():
                self._add(channel, outline.schemas.get(channel.schema_id), outline.counts.get(number, 0))

    @property
    def damage(self) -> list[str]:
        """A line per damaged file, some only after reading."""
        lines = [f"{outline.path}: {outline.damage}" for outline in self._outlines if outline.damage]
        return [f"{error}: left out" for error in self._unreadable] + lines

    def _add(self, channel: Channel, schema: Schema | None, messages: int) -> None:
        if not messages:
            return
        name, type_name = ros_topic(channel.topic), schema.name if schema else ""
        type_hash = channel.metadata.get("topic_type_hash", "")
        latched = any(
            isinstance(each, dict) and each.get("durability") in _LATCHED for each in offered_profiles(channel)
        )
        topic = self.topics.setdefault(name, BagTopic(name, type_name, channel.message_encoding, type_hash, latched))
        topic.latched |= latched
        topic.messages += messages
        topic.type_name = topic.type_name or type_name
        if type_name and type_name != topic.type_name:
            raise BagError(
                f"topic {name}: its messages are {topic.type_name} and {type_name}: expected one type of each topic"
            )

    def messages(self, topics: Collection[str], until: int = 2**63) -> Iterator[Message]:
        """The messages of some topics up to the time ``until`` [ns]; the rest of the bag is not read."""
        if until >= self.end:
            until = 2**63  # read all of it, to know what is damaged
        newest: dict[str, int] = {}
        pending: list[tuple[int, int, str, bytes]] = []  # time, position in the bag, topic, data
        position = held = 0
        repeated = _Repetitions() if len(self._outlines) > 1 else None
        for number_of_file, (outline, later) in enumerate(zip(self._outlines, self._starts_after(), strict=True)):
            lows = _Lows(outline.lows, later)
            file, low = stored_file(outline.path), 0
            names: dict[int, str | None] = {}
            for batch in file.batches():
                for number, channel in file.channels.items():
                    if number not in names:
                        name = ros_topic(channel.topic)
                        names[number] = name if name in topics else None
                places = zip(batch.start.tolist(), batch.size.tolist(), strict=True)
                for (number, sequence, time, published), (start, size) in zip(batch.head.tolist(), places, strict=True):
                    topic = names.get(number)
                    if topic is None:
                        continue
                    if repeated is not None and self.topics[topic].latched:
                        message = (topic, published, sequence, batch.data[start : start + size])
                        if repeated.earlier(message, number_of_file):
                            continue
                    newest[topic] = time = max(time, newest.get(topic, 0))
                    pending.append((time, position, topic, batch.data[start : start + size]))
                    position += 1
                    held += size
                pending.sort()
                low = lows.behind(batch.end)
                ready = bisect_right(pending, min(low, until), key=lambda entry: entry[0])
                if held > self._most_held:
                    ready = max(ready, len(pending) // 2)
                for time, _, topic, data in pending[:ready]:
                    held -= len(data)
                    yield Message(time, topic, data)
                del pending[:ready]
                if low > until:
                    break
            outline.damaged_chunks = max(outline.damaged_chunks, file.damaged_chunks)
            if low > until:
                return
        for time, _, topic, data in pending:
            if time <= until:
                yield Message(time, topic, data)

    def _starts_after(self) -> list[int]:
        """For each file, the earliest time [ns] in the files behind it."""
        starts = [2**63 if outline.start is None else outline.start for outline in reversed(self._outlines)]
        return [*accumulate(starts[:-1], min, initial=2**63)][::-1]


class _Repetitions:
    """Which messages of latched topics an earlier file has, with the same time of publication, number and bytes."""

    def __init__(self) -> None:
        self._files: OrderedDict[int, int] = OrderedDict()  # hash: last file with it; the newest ones at the end

    def earlier(self, message: tuple[str, int, int, bytes], file: int) -> bool:
        """Whether an earlier file has a message, and this one, by number, has it for the first time."""
        key = hash(message)
        before = self._files.get(key, file)
        self._files[key] = file
        self._files.move_to_end(key)
        if len(self._files) > MOST_LATCHED:
            self._files.popitem(last=False)
        return before < file


class _Lows:
    """Lower bound of the log times behind a point of a file; ``later``: that of the files behind it [ns]."""

    def __init__(self, lows: list[tuple[int, int]], later: int) -> None:
        self._ends = [end for end, _ in lows]
        self._from = [*accumulate((low for _, low in reversed(lows)), min, initial=later)][::-1]  # lowest, by piece
        self._next = 0

    def behind(self, offset: int) -> int:
        """Bound [ns] behind a piece that ends at this offset; call it for every piece that was read, in order."""
        while self._next < len(self._ends) and self._ends[self._next] < offset:
            self._next += 1  # a damaged piece, which was left out
        if self._next < len(self._ends) and self._ends[self._next] == offset:
            self._next += 1  # else a piece without messages
        return self._from[self._next]


def _quick_outline(path: Path) -> _Outline | None:
    """Outline by the summary alone: of a closed file with all messages in chunks that have an index; else None."""
    summary, _ = summary_of(path)
    statistics = summary.statistics if summary else None
    if summary is None or statistics is None or not statistics.message_count:
        return None
    outline, file, inside = _Outline(path), McapFile(path), 0
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        entries = index.message_index_length - MESSAGE_INDEX.size * len(index.message_index_offsets)
        inside += entries // ENTRY.size
        if entries:
            outline.lows.append((index.chunk_start_offset + index.chunk_length, index.message_start_time))
    for channel in summary.channels.values():
        file.add_channel(channel)
    for schema in summary.schemas.values():
        schema.name = ros_type(schema.name)
    outline.channels, outline.schemas = file.channels, summary.schemas
    outline.counts = dict(statistics.channel_message_counts)
    outline.start, outline.end = statistics.message_start_time, statistics.message_end_time
    whole = outline.counts.keys() <= outline.channels.keys() and inside == statistics.message_count
    return outline if whole else None


def _outline(path: Path) -> _Outline:
    """Outline by reading all of a file; BagError: not an MCAP file, empty, or one that cannot be read."""
    outline, file = _Outline(path), stored_file(path)
    counts: Counter[int] = Counter()
    for batch in file.batches():
        if len(batch.head):
            times = batch.head["log_time"]
            outline.lows.append((batch.end, int(times.min())))
            outline.end = max(outline.end or 0, int(times.max()))
            counts.update(batch.channel.tolist())
    outline.start = min((low for _, low in outline.lows), default=None)
    outline.counts = dict(counts)
    outline.channels, outline.schemas = file.channels, file.schemas
    outline.torn, outline.damaged_chunks = file.torn, file.damaged_chunks
    return outline
