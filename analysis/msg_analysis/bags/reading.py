# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Reads a recorded run, whichever program recorded it, and counts what is there and what is missing."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Header, Metadata
from mcap.stream_reader import StreamReader

from msg_analysis.bags.files import FileInventory, bag_files, first_file, stored_file
from msg_analysis.bags.mcap_writing import RECORD_NAME
from msg_analysis.bags.states import Collector
from msg_analysis.bags.stored_file import RECORD_LIMIT, Batch, StoredFile
from msg_analysis.bags.writing import recording_pid
from msg_analysis.common.arrays import AnyArray, IntArray
from msg_analysis.common.resources import tell
from msg_analysis.errors import BagError, InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.links import with_logged
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.cdr import CdrError
from msg_analysis.messages.messages import (
    ACTIVE_GRAPH,
    AGENT_STATE,
    PROGRESS,
    STRING,
    ActiveGraph,
    Progress,
    decode_string,
)
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.run_record import RunRecord

# Topics are recognised by type and by the end of their name: the network may run in any namespace.
_STATE, _TRUTH, _GRAPH, _EXPERIMENT, _STOP = "state", "truth", "graph", "experiment", "stop"
_NUMBERS = {_STATE: 1, _TRUTH: 2, _GRAPH: 3, _EXPERIMENT: 4, _STOP: 5}
_TOPICS = {
    AGENT_STATE.full_name: re.compile(r"(?:^|/)agent_\d+/(state|truth)$"),
    ACTIVE_GRAPH.full_name: re.compile(r"(?:^|/)(graph)$"),
    STRING.full_name: re.compile(r"(?:^|/)(experiment)$"),
    PROGRESS.full_name: re.compile(r"(?:^|/)(stop)$"),
}
MOST_SEARCHED = 16 << 20  # bytes of messages in which the record of another recorder's bag is looked for
MOST_RECORDS = 100  # different run records that a bag may have: reading each takes milliseconds


def read_bag(path: str | Path, inventory: list[FileInventory] | None = None) -> Run:
    """The run in a bag of msg-agents, the twin or ``ros2 bag``; torn and damaged bags as far as possible.

    Parameters
    ----------
    path
        directory of a bag, or one of its files (.mcap, .db3)
    inventory
        gets what the files hold, even if no run can be made of it

    Raises
    ------
    BagError
        not a bag, a bag without the run record, or with several runs
    InputError
        the run record in it is not valid
    """
    path = Path(path)
    contents = _Contents(path)
    unreadable: list[BagError] = []
    files = bag_files(path)
    for number, file in enumerate(files):
        tell(f"reading {path.name}", number, len(files))
        entry = FileInventory(stored_file(file))
        if inventory is not None:
            inventory.append(entry)
        try:
            contents.read(entry.file, entry.file.batches() if inventory is None else entry.watch())
        except BagError as error:  # the recorder died just after it made the file, or its start is damaged
            entry.problem = str(error)
            unreadable.append(error)
    if len(unreadable) == len(files):
        raise unreadable[0]
    contents.refused[Refusal.UNREADABLE_FILE] += len(unreadable)
    return _trajectory(contents, _choose(contents))


def read_record(path: str | Path, *, most: int | None = None) -> RunRecord:
    """The run record alone; BagError or InputError: no bag, or no valid one in the first ``most`` bytes of messages."""
    path = Path(path)
    contents = _Contents(path)
    unreadable: list[BagError] = []
    files = bag_files(path)
    seen = 0
    for file in map(stored_file, files):
        try:
            for batch, kind in contents.network_topics(file, file.batches()):
                seen += len(batch.data)
                if most is not None and seen > most:
                    contents.note_copies(file)
                    return _choose(contents)
                contents.learn(batch, kind)
                for record in contents.records.values():
                    if isinstance(record, RunRecord):
                        return record
        except BagError as error:
            unreadable.append(error)
        contents.note_copies(file)
    if len(unreadable) == len(files):
        raise unreadable[0]
    return _choose(contents)


@dataclass(slots=True)
class _Contents:
    """What the files of a bag hold of the network's topics."""

    path: Path
    states: Collector = field(default_factory=Collector)
    truths: Collector = field(default_factory=Collector)
    # By their bytes: every file of a split bag may begin with those in force.
    graphs: dict[bytes, ActiveGraph] = field(default_factory=dict)
    stops: set[tuple[bytes, int]] = field(default_factory=set)  # run, and the step at which it ended early
    # Run records by text, in order, or why a text is not one: that matters only if none is (another program's topic).
    records: dict[str, RunRecord | InputError] = field(default_factory=dict)
    ours: bool = False  # whether there is any message on a topic of a network
    copies: dict[str, None] = field(default_factory=dict)  # the texts in the metadata of our files
    refused: Counter[str] = field(default_factory=Counter)

    def read(self, file: StoredFile, batches: Iterable[Batch]) -> None:
        """Take all of a file."""
        for batch, kind in self.network_topics(file, batches):
            self._add(batch, kind)
        self.note_copies(file)
        self.refused[Refusal.TORN_FILE] += file.torn is not None
        self.refused[Refusal.DAMAGED_CHUNK] += file.damaged_chunks

    def network_topics(self, file: StoredFile, batches: Iterable[Batch]) -> Iterator[tuple[Batch, AnyArray]]:
        """Each batch with the kinds of its messages, (messages,): ``_NUMBERS``; 0: not of a topic of the network."""
        kind_of = np.zeros(2**16, dtype=np.int8)  # by number of the channel
        known = 0
        size = file.path.stat().st_size
        for batch in batches:
            tell(f"reading {file.path.name}", min(batch.end, size), size)
            for number, channel in itertools.islice(file.channels.items(), known, None):
                schema = file.schemas.get(channel.schema_id)
                patterns = _TOPICS.values() if schema is None or not schema.name else [_TOPICS.get(schema.name)]
                for pattern in patterns:  # without a type, the name of the topic counts
                    if pattern and (found := pattern.search(channel.topic)):
                        kind_of[number] = _NUMBERS[found[1]]
            known = len(file.channels)
            kinds = kind_of[batch.channel]
            self.ours |= bool(kinds.any())
            yield batch, kinds

    def note_copies(self, file: StoredFile) -> None:
        """Keep the run records in the metadata of a file."""
        texts = (each.metadata.get("record") for each in file.metadata if each.name == RECORD_NAME)
        self.copies |= {text: None for text in texts if text is not None}

    def learn_copies(self) -> None:
        """Take the run records in metadata where the topic has none; else count those that differ from it."""
        # The topic is in chunks with a checksum, and no other program can publish on it in our bags; metadata has none.
        if any(isinstance(record, RunRecord) for record in self.records.values()):
            self.refused[Refusal.NOT_OF_RECORD] += len(self.copies.keys() - self.records.keys())
            return
        for text in itertools.islice(self.copies, MOST_RECORDS):
            self._learn(text)

    def _add(self, batch: Batch, kind: AnyArray) -> None:
        self.learn(batch, kind)  # first: states of a known run are put in their places at once
        for index in np.flatnonzero((kind == _NUMBERS[_GRAPH]) | (kind == _NUMBERS[_STOP])).tolist():
            data = batch.message(index)
            try:
                if kind[index] == _NUMBERS[_STOP]:
                    stop = Progress.decode(data)
                    self.stops.add((stop.run, stop.step))
                elif data not in self.graphs:
                    self.graphs[data] = ActiveGraph.decode(data)
            except CdrError:
                self.refused[Refusal.UNDECODABLE] += 1
        for name, collector in ((_STATE, self.states), (_TRUTH, self.truths)):
            chosen = np.flatnonzero(kind == _NUMBERS[name])
            if len(chosen):
                collector.add(batch, chosen)

    def learn(self, batch: Batch, kind: AnyArray) -> None:
        """Take the run records in a batch with messages of these kinds, (messages,)."""
        for index in np.flatnonzero(kind == _NUMBERS[_EXPERIMENT]).tolist():
            try:
                text = decode_string(batch.message(index))
            except CdrError:
                self.refused[Refusal.UNDECODABLE] += 1
                continue
            if text not in self.records and len(self.records) >= MOST_RECORDS:
                raise BagError(
                    f"{self.path}: more than {MOST_RECORDS} different messages on the topic `experiment`: expected the "
                    "one record of a run: record each run into a bag of its own"
                )
            self._learn(text)

    def _learn(self, text: str) -> None:
        if text in self.records:
            return
        try:
            self.records[text] = record = RunRecord.from_json(text, f"{self.path}: topic experiment")
        except InputError as error:
            self.records[text] = error
            return
        for collector, width in zip((self.states, self.truths), _widths(record.experiment), strict=True):
            collector.expect(record, width)


def _widths(experiment: Experiment) -> tuple[int, int]:
    """Lengths of the states on the topics `state` and `truth`."""
    return (experiment.run.replicas, experiment.width) if experiment.truth else (experiment.width, 0)


def _choose(contents: _Contents) -> RunRecord:
    """The run record of the one run that has states."""
    contents.learn_copies()
    path, damaged = contents.path, contents.refused[Refusal.DAMAGED_CHUNK]
    found = contents.records.values()
    if not found and damaged:
        raise BagError(
            f"{path}: {damaged} chunks are damaged (wrong checksums, or times that no clock shows), and no record of "
            "the run is in what is left: copy the bag again, or record the run again"
        )
    if not found:
        pid = recording_pid(path)
        if not pid and not contents.ours:
            raise BagError(
                f"{path}: not a run of msg-agents: expected its topics `experiment` and `agent_1/state`: for a bag of "
                f"other robots `msg-analysis map {path}` writes a first map, for `compare --law --map`"
            )
        hint = f" (process {pid} is still recording it)" if pid else ""
        raise BagError(
            f"{path}: the latched topic `experiment` is missing, so the run is not known{hint}: record that topic too, "
            "with durability transient_local (as `ros2 bag record -a` does)"
        )
    records: dict[bytes, RunRecord] = {}
    for each in found:
        if not isinstance(each, RunRecord):
            continue
        first = records.setdefault(each.run.bytes, each)
        if first is not each and first.to_json() != each.to_json():
            raise BagError(
                f"{path}: two records of run {each.run} contradict each other: one of them is damaged, or "
                "another program published it on the topic `experiment`: copy the bag again, or record the run again"
            )
    if not records:
        raise next(each for each in found if isinstance(each, InputError))
    with_states = [record for run, record in records.items() if contents.states.count(run)]
    candidates = with_states or list(records.values())
    if len(candidates) > 1:
        listed = "; ".join(
            f"{r.run} ({r.experiment.name}, {contents.states.count(r.run.bytes)} states)" for r in candidates
        )
        raise BagError(f"{path}: {len(candidates)} runs in one bag: {listed}: record each run into a bag of its own")
    return candidates[0]


def _trajectory(contents: _Contents, record: RunRecord) -> Run:
    planned, end = record.experiment.steps, _end(contents, record)
    if end is not None:
        record = record.ended(end)
    experiment = record.experiment
    graphs = _logged_graphs(contents, record) if experiment.links else list(experiment.graph_list)
    modes = _modes(contents, record.run.bytes, experiment.steps, planned, len(graphs))
    if experiment.links and _described(graphs) != _described(experiment.graph_list):
        record = dataclasses.replace(record, experiment=with_logged(experiment, graphs, modes), matrices=None)
        experiment = record.experiment
    published, widths = None, _widths(experiment)
    truth = contents.states.finish(record, widths[0])
    if experiment.truth:
        published, truth = truth, contents.truths.finish(record, widths[1])
    if experiment.run.pace == "lockstep":  # in real time agents may use older graphs
        differs = ((truth.modes[1:] != modes[:, None]) & (truth.modes[1:] >= 0)).any(axis=1) & (modes >= 0)
        contents.refused[Refusal.OTHER_GRAPH] += int(differs.sum())
        modes[differs] = -1
    parts = [truth] if published is None else [truth, published]
    for part in parts:
        contents.refused.update(part.refused)
    expected = len(parts) * (experiment.steps + 1) * experiment.agents
    received = sum(part.received for part in parts)
    completeness = Completeness(
        expected=expected,
        received=received,
        missing=expected - received,
        duplicates=sum(part.duplicates for part in parts),
        out_of_order=sum(part.out_of_order for part in parts),
        missing_modes=int((modes < 0).sum()),
        refused={reason: count for reason, count in sorted(contents.refused.items()) if count},
    )
    return Run(
        *(record, truth.states, modes, completeness, truth.modes),
        lost=truth.lost,
        used=truth.used,
        made=truth.made,
        wrong_stamp=min((part.wrong_stamp for part in parts if part.wrong_stamp), default=None),
        published=published.states if published else None,
    )


def _logged_graphs(contents: _Contents, record: RunRecord) -> list[Graph]:
    """The graphs by their numbers in the log, where links switch by themselves: it may have others than the record."""
    assert record.experiment.links is not None
    graphs, agents = list(record.experiment.graph_list), record.experiment.agents
    for found in contents.graphs.values():
        known = all(1 <= end <= agents for arc in found.arcs for end in arc[:2])
        if found.run == record.run.bytes and 1 <= found.mode <= record.experiment.steps and known:
            graphs += [record.experiment.links.logged("", [])] * (found.mode - len(graphs))
            graphs[found.mode - 1] = record.experiment.links.logged(found.name, found.arcs)
    return graphs


def _described(graphs: Sequence[Graph]) -> list[tuple[str, list[tuple[int, int, float]]]]:
    return [(graph.name, graph.arcs) for graph in graphs]


def _end(contents: _Contents, record: RunRecord) -> int | None:
    """The step at which a run ended before its planned one; None: it did not, or two messages contradict each other."""
    steps = sorted({step for run, step in contents.stops if run == record.run.bytes})
    if not steps or record.until is None:
        return None
    if len(steps) > 1 or not 1 <= steps[0] < record.experiment.steps:
        contents.refused[Refusal.CONTRADICTION if len(steps) > 1 else Refusal.OUT_OF_RANGE] += len(steps)
        return None
    return steps[0]


def _modes(contents: _Contents, run: bytes, steps: int, planned: int, graphs: int) -> IntArray:
    """(N,) graph of every step, from 0; -1: of no holding period, or two. They may go on up to the planned steps."""
    holding_periods: set[tuple[int, int, int, int]] = set()
    for graph in contents.graphs.values():
        if graph.run != run:
            contents.refused[Refusal.OTHER_RUN] += 1
        elif not (1 <= graph.mode <= graphs and graph.first_step <= graph.last_step < planned):
            contents.refused[Refusal.GRAPH_OUT_OF_RANGE] += 1
        else:
            holding_periods.add((graph.sequence, graph.mode, graph.first_step, graph.last_step))
    modes = np.full(steps, -1, dtype=np.int64)
    claims = np.zeros(steps, dtype=np.int64)
    for _, mode, first, last in holding_periods:
        modes[first : last + 1] = mode - 1
        claims[first : last + 1] += 1
    modes[claims != 1] = -1
    return modes


def record_document(path: Path) -> dict[str, Any]:
    """The document of the run record, checked if another recorded the bag; BagError: none is found; InputError."""
    try:
        document = json.loads(_head_record(path) or "null")
    except (ValueError, RecursionError):  # damaged: the topic has it, too
        document = None
    if isinstance(document, dict):
        return document
    found: dict[str, Any] = json.loads(read_record(path, most=MOST_SEARCHED).to_json())
    return found


def started(path: Path) -> datetime | None:
    """When the run of a bag was started, by the head of its first file alone; None where that does not say it."""
    try:
        found = datetime.fromisoformat(json.loads(_head_record(path) or "{}")["started"])
        return found if found.tzinfo else found.replace(tzinfo=UTC)
    except (BagError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _head_record(bag: Path) -> str | None:
    """The text that our recorder and the twin put before the first chunk of an MCAP file; None where there is none."""
    file = first_file(bag)
    if file is None or file.suffix != ".mcap":
        return None
    try:
        with file.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=RECORD_LIMIT).records:
                if not isinstance(record, Header | Metadata):
                    return None
                if isinstance(record, Metadata) and record.name == RECORD_NAME:
                    found: str | None = record.metadata.get("record")
                    return found
    except OSError as error:
        raise BagError(f"{file}: cannot be read ({error.strerror})") from error
    except Exception:  # the library raises many kinds of errors on damage
        return None
    return None
