# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Writes bags that rosbag2, rosbags, Foxglove and PlotJuggler open: directories with MCAP files.

The files of a split bag follow each other in time, and each begins with what is in force of the latched topics.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.arithmetic.update_law import to_payload
from msg_analysis.bags.files import FileCount, bag_information, write_metadata
from msg_analysis.bags.mcap_writing import LatchedMessage, WrittenFile
from msg_analysis.bags.stored_file import DEFAULT_STORAGE, Storage
from msg_analysis.common.arrays import BLOCK_NUMBERS, IntArray, release
from msg_analysis.common.files import lock, require_utf8
from msg_analysis.errors import BagError
from msg_analysis.messages.acceptance import graph_message
from msg_analysis.messages.messages import StateCodec, encode_string
from msg_analysis.messages.topics import EXPERIMENT, GRAPH, STATE, TRUTH, Topic, network_topics
from msg_analysis.model.graph_path import HoldingPeriod
from msg_analysis.model.reception import LOST
from msg_analysis.model.run import Run

RECORDING_MARKER = ".recording"
# Files that wait for late messages. An agent so far behind that this is not enough is dead, and its messages, if it
# comes back, are in a later file.
MOST_OPEN = 3
AT_ONCE = 4096  # messages
# Topic, CDR bytes, time [ns], and of a holding period the time of the first state behind it [ns].
_Message = tuple[str, bytes, int, int | None]


class BagWriter:
    """A bag being written: with a locked marker instead of metadata.yaml. BagError, from every method: not writable."""

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
        self._open: list[WrittenFile] = []  # those that are not finished, in their order
        try:
            # It may be there already, empty: a runner that starts several runs at once reserves their names that way.
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()):
                raise FileExistsError
            self._marker = (self.directory / RECORDING_MARKER).open("w", encoding="utf-8")
        except FileExistsError as error:
            raise exists_already(directory) from error
        except OSError as error:
            raise BagError(f"{directory}: cannot be made ({error.strerror}): choose another place") from error
        with self._writing():
            lock(self._marker, fcntl.LOCK_EX, self.directory)  # the system releases it when this process ends
            json.dump({"pid": os.getpid()}, self._marker)
            self._marker.flush()
            self._begin_file()

    def write(self, topic: str, data: bytes, time_ns: int, until: int | None = None) -> None:
        """Append a message (CDR) of a latched topic; later files repeat it, up to the time ``until`` [ns] if any."""
        if topic not in self._latched or self._closed:
            raise self._refused("is closed" if self._closed else f"has no latched topic {topic}")
        with self._writing():
            message = LatchedMessage(time_ns, self._sequences[topic], topic, data, until)
            self._sequences[topic] += 1
            if self._storage.split_size is not None and time_ns > self._now:  # it waits for its time
                heapq.heappush(self._held, message)
            else:
                self._place(message)

    def write_many(
        self, topics: Sequence[str], of: IntArray, time_ns: IntArray, data: bytes, start: IntArray, size: IntArray
    ) -> None:
        """Append messages of topics that are not latched, (messages,): topic, time [ns], place and size in ``data``."""
        if self._closed:
            raise self._refused("is closed")
        done = 0
        with self._writing():
            while done < len(of):
                file = self._file_of(int(time_ns[done]))
                end = done + file.mcap.fitting(size[done : done + self._together(file, time_ns[done:])])
                piece = slice(done, end)
                if self._release(int(time_ns[piece].max())):
                    continue  # perhaps into a new file
                several = of[piece], time_ns[piece], data, start[piece], size[piece]
                self._passed(file, file.add_many(topics, *several, self._sequences))
                done = end

    def _together(self, file: WrittenFile, time_ns: IntArray) -> int:
        """How many of the messages with these times belong into the same file as the first."""
        before = self._open.index(file)
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
                return self._first_with(time_ns) or last
            last.bound, last.behind = last.count.end, set(self._streams)
        return self._first_with(time_ns) or self._begin_file(last.bound + 1)

    def _first_with(self, time_ns: int) -> WrittenFile | None:
        return next((file for file in self._open if file.bound is not None and time_ns <= file.bound), None)

    def _begin_file(self, begin: int = 0) -> WrittenFile:
        if len(self._open) == MOST_OPEN:
            self._finish_first()
        path = self.directory / f"{self.directory.name}_{len(self._counts)}.mcap"
        file = WrittenFile(path, self._counts, self._storage, begin)
        self._open.append(file)
        self._counts.append(file.count)
        self._in_force = [each for each in self._in_force if each.until is None or each.until >= begin]
        file.write_head(self._topics, self._record, self._custom, self._in_force)
        return file

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
        with self._writing():
            for file in self._open:
                file.mcap.flush()

    def close(self, complete: bool = True) -> None:
        """Finish the files, write metadata.yaml, remove the marker; ``complete``: the end of the run was seen."""
        if self._closed:
            return
        self._custom["complete"] = "true" if complete else "false"
        with self._writing():
            self._release(2**63)
            while self._open:
                self._finish_first()
            write_metadata(self.directory, bag_information(self._counts, self._custom))
            (self.directory / RECORDING_MARKER).unlink()
            self._marker.close()
        self._closed = True

    def _refused(self, reason: str) -> BagError:
        return BagError(f"{self.directory}: {reason}: nothing more can be written to it")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """After an OSError the bag is closed; what was written before can be read."""
        try:
            yield
        except OSError as error:
            self._closed = True
            for file in self._open:
                file.abandon()
            with contextlib.suppress(OSError):
                self._marker.close()
            raise BagError(
                f"{self.directory}: cannot be written ({error.strerror or error}): free some space or choose "
                "another place; what was written before can still be read"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
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


def write_trajectory(
    trajectory: Run, directory: str | Path, storage: Storage = DEFAULT_STORAGE, block_numbers: int = BLOCK_NUMBERS
) -> None:
    """Write a bag, whole or not at all; InputError: the directory exists, cannot be written, or is not UTF-8."""
    directory = Path(directory).absolute()
    require_utf8(directory)
    if directory.exists():
        raise exists_already(directory)
    record = trajectory.record.to_json()
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{directory.name}.", dir=directory.parent) as parent:
            unfinished = Path(parent) / directory.name  # its final name: that of its file derives from it
            noisy = trajectory.published is not None
            topics = network_topics(trajectory.record.experiment.agents, truth=noisy)
            with BagWriter(unfinished, topics, record=record, storage=storage) as bag:
                bag.write(f"/{EXPERIMENT.name}", encode_string(record), 0)
                _write(bag, [topic.name for topic in topics], _messages(trajectory, block_numbers))
            unfinished.rename(directory)
    except OSError as error:
        raise BagError(f"{directory}: cannot be written ({error.strerror}): choose another place") from error


def _write(bag: BagWriter, names: Sequence[str], messages: Iterator[_Message]) -> None:
    """Write many messages at once: a fraction of the time of writing each. Holding periods come a little early."""
    number = {name: index for index, name in enumerate(names)}
    while part := list(islice(messages, AT_ONCE)):
        for topic, content, stamp, until in part:
            if until is not None:
                bag.write(topic, content, stamp, until)
        states = [message for message in part if message[3] is None]
        if not states:
            continue
        topics, contents, times, _ = zip(*states, strict=True)
        size = np.array([len(content) for content in contents], dtype=np.int64)
        of = np.array([number[topic] for topic in topics], dtype=np.int64)
        time = np.array(times, dtype=np.int64)
        bag.write_many(names, of, time, b"".join(contents), np.cumsum(size) - size, size)


def _messages(trajectory: Run, block_numbers: int) -> Iterator[_Message]:
    """The messages in the order of time."""
    record, agents = trajectory.record, range(trajectory.record.experiment.agents)
    run, dt = record.run.bytes, record.experiment.step_length
    streams = [(STATE, trajectory.states)]
    if trajectory.published is not None:
        streams = [(TRUTH, trajectory.states), (STATE, trajectory.published)]
    names = [[f"/{topic.of(i)}" for i in agents] for topic, _ in streams]
    codecs = [[StateCodec(run, i + 1, states.shape[2], dt) for i in agents] for _, states in streams]
    heard = _heard(trajectory)
    holding_periods = _holding_periods(trajectory)
    holding = next(holding_periods, None)
    for steps, of, times in _in_order(trajectory, block_numbers):
        if trajectory.agent_modes is not None:
            graphs = trajectory.agent_modes[steps, of]
        else:
            graphs = np.where(steps > 0, trajectory.modes[steps - 1], -1)
        values = [states[steps, of] for _, states in streams]
        there = [np.asarray(~np.isnan(each).any(axis=1)).tolist() for each in values]
        cells = zip(steps.tolist(), of.tolist(), times.tolist(), graphs.tolist(), strict=True)
        for place, (k, i, now, graph) in enumerate(cells):
            while holding is not None and holding[2] <= now:
                yield holding
                holding = next(holding_periods, None)
            for topics, codec, is_there, value in zip(names, codecs, there, values, strict=True):
                if is_there[place]:
                    payload = to_payload(value[place])
                    yield topics[i], codec[i].wrap(k, graph + 1, payload, heard(k, i, graph), now), now, None
        trajectory.release()
    if holding is not None:
        yield holding
        yield from holding_periods


def _in_order(trajectory: Run, block_numbers: int) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Steps, agents and times (e,) of all states by time, those of one time by step and agent, a part at once."""
    count, m, made = len(trajectory.states), trajectory.states.shape[1], trajectory.made
    clock = StepClock(trajectory.record.experiment.step_length)
    rows = max(1, block_numbers // trajectory.states[:1].size)
    # Nothing of step k or a later one is earlier than later[k].
    later = np.empty(count + 1, dtype=np.int64)
    later[count] = np.iinfo(np.int64).max
    for first in range(0, count if made is not None else 0, rows):
        assert made is not None
        times = made[first : first + rows]
        later[first : first + len(times)] = np.where(times < 0, later[count], times).min(axis=1)
        release(made)
    later[:count] = np.minimum.accumulate(later[::-1])[::-1][:count]
    waiting = np.empty(0, dtype=np.int64)
    for first in range(0, count, rows):
        end = min(first + rows, count)
        cells = np.concatenate([waiting, np.arange(first * m, end * m)])
        steps, agents = np.divmod(cells, m)
        if made is None:
            yield steps, agents, np.repeat(clock.times(np.arange(first, end)), m)
            continue
        times = made[steps, agents]
        by = np.lexsort((cells, times))
        ready, behind = np.split(by, [int(np.searchsorted(times[by], later[end], side="left"))])
        waiting = cells[behind]
        yield steps[ready], agents[ready], times[ready]


def _heard(trajectory: Run) -> Callable[[int, int, int], list[int]]:
    """Of (k, agent and graph from 0) the steps used in the step to a state; empty: in lockstep, nothing was lost."""
    lost, values = trajectory.lost, trajectory.used
    if lost is None and values is None:
        return lambda _k, _i, _graph: []
    model, delay = trajectory.record.model, trajectory.record.experiment.noise.delay
    modes, agents = range(model.modes), range(model.agents)
    counts = [[len(model.neighbours(mode, i)) for i in agents] for mode in modes]

    def listed(k: int, i: int, graph: int) -> list[int]:
        if k == 0:
            return []
        neighbours = counts[graph][i]
        newest = max(0, k - 1 - delay)
        if values is not None:
            steps = values[k - 1, i, :neighbours].tolist()
            if trajectory.made is None and all(step == newest for step in steps):
                return []
            return [LOST if step < 0 else step for step in steps]
        if lost is None or not lost[k - 1, i].any():
            return []
        return [LOST if gone else newest for gone in lost[k - 1, i, :neighbours].tolist()]

    return listed


def _holding_periods(trajectory: Run) -> Iterator[_Message]:
    """The stretches of equal graph, without those whose graph is not known."""
    record, modes = trajectory.record, trajectory.modes
    time = StepClock(record.experiment.step_length).nanoseconds
    first = np.flatnonzero(np.diff(modes, prepend=-2))
    last = np.append(first[1:], len(modes)) - 1
    known = modes[first] >= 0
    for sequence, (start, end) in enumerate(zip(first[known].tolist(), last[known].tolist(), strict=True)):
        message = graph_message(record, HoldingPeriod(sequence, int(modes[start]), start, end))
        yield f"/{GRAPH.name}", message.encode(), message.stamp, time(end + 1)
