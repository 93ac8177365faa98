"""Reads a recorded run, whichever program recorded it, and counts what is there and what is missing.

The run record comes from the topic `experiment`, or from the metadata of files that this software wrote.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from msg_analysis.bags.format.inventory import Inventory
from msg_analysis.bags.format.mcap_file import Batch, McapFile
from msg_analysis.bags.format.metadata import METADATA_FILE, read_metadata
from msg_analysis.bags.trajectory_builder import Collector
from msg_analysis.bags.writer import RECORD_NAME, recording_pid
from msg_analysis.common.long_work import tell
from msg_analysis.errors import BagError, InputError
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.run.trajectory import Completeness, Trajectory
from msg_analysis.types import AnyArray, IntArray
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.messages import ActiveGraph, decode_string
from msg_analysis.wire.refusals import Refusal
from msg_analysis.wire.schemas import ACTIVE_GRAPH, AGENT_STATE, STRING

# Topics are recognised by type and by the end of their name: the network may run in any namespace.
_STATE, _TRUTH, _GRAPH, _EXPERIMENT = "state", "truth", "graph", "experiment"
_NUMBERS = {None: 0, _STATE: 1, _TRUTH: 2, _GRAPH: 3, _EXPERIMENT: 4}
_TOPICS = {
    AGENT_STATE.full_name: re.compile(r"(?:^|/)agent_\d+/(state|truth)$"),
    ACTIVE_GRAPH.full_name: re.compile(r"(?:^|/)(graph)$"),
    STRING.full_name: re.compile(r"(?:^|/)(experiment)$"),
}
MOST_RECORDS = 100  # different run records that a bag may have: reading each takes milliseconds
_ZSTD_FRAME = b"\x28\xb5\x2f\xfd"
_EACH_COMPRESSED = (
    "every message in it is compressed by itself, which cannot be read: convert it, or record with "
    "`--storage-preset-profile zstd_fast`"
)


def read_bag(path: str | Path, inventory: Inventory | None = None) -> Trajectory:
    """The run of a bag: of a directory or of one of its .mcap files; torn files are read up to the tear.

    ``inventory`` is filled with what the files hold, even if no run can be made of it. BagError: no bag, no run record,
    or several runs; InputError: the run record is not valid.
    """
    path = Path(path)
    contents = _Contents(path)
    unreadable: list[BagError] = []
    files = bag_files(path)
    for number, file in enumerate(files):
        tell(f"reading {path.name}", number, len(files))
        entry = (inventory or Inventory()).add(McapFile(file))
        try:
            contents.read(entry.file, entry.watch() if inventory else entry.file.batches())
        except BagError as error:  # the recorder died just after it made the file, or its start is damaged
            entry.problem = str(error)
            unreadable.append(error)
    if len(unreadable) == len(files):
        raise unreadable[0]
    contents.refused[Refusal.UNREADABLE_FILE] += len(unreadable)
    return _trajectory(contents, _choose(contents))


def bag_files(path: Path) -> list[Path]:
    """The MCAP files of a bag in their order; BagError: there are none, one is missing, or another storage."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"{path}: not found: expected the directory of a bag or an .mcap file")
    information = read_metadata(path)
    if information is None:
        files = [file for suffix in ("mcap", "mcap.zstd") for file in path.glob(f"*.{suffix}")]
        if not files:
            if {entry.name for entry in path.iterdir()} <= {"log"}:  # a run makes its directory before anything else
                raise BagError(f"{path}: empty: its run ended before anything was recorded: delete it")
            raise BagError(f"{path}: not a bag: expected metadata.yaml or .mcap files in this directory")
        return sorted(files, key=_file_number)
    storage = information.get("storage_identifier")
    if storage != "mcap":
        raise BagError(
            f"{path}: its storage is {storage}, expected mcap: record with `ros2 bag record -s mcap`, or convert it"
        )
    if str(information.get("compression_mode", "")).lower() == "message":
        raise BagError(f"{path}: {_EACH_COMPRESSED}")
    names = information.get("relative_file_paths")
    files = [path / str(name) for name in names] if isinstance(names, list) else []
    lost = [file.name for file in files if not file.is_file()]
    if lost or not files:
        raise BagError(
            f"{path}: {', '.join(lost) or 'every file'} of its {METADATA_FILE} is missing: copy the whole bag, or move "
            f"{METADATA_FILE} away to read the files that are there"
        )
    return files


def _file_number(file: Path) -> tuple[int, str]:
    """Order of the files of a split bag, which rosbag2 numbers: name_0.mcap, name_1.mcap, ..., name_10.mcap."""
    number = re.search(r"_(\d+)\.mcap", file.name)
    return int(number[1]) if number else 0, file.name


@dataclass(slots=True)
class _Contents:
    """What the files of a bag hold of the network's topics."""

    path: Path
    states: Collector = field(default_factory=Collector)
    truths: Collector = field(default_factory=Collector)
    graphs: list[ActiveGraph] = field(default_factory=list)
    # Run records by text, in order, or why a text is not one: from the topic, and from the metadata of our files.
    experiments: dict[str, RunRecord | InputError] = field(default_factory=dict)
    metadata: dict[str, None] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)

    def read(self, file: McapFile, batches: Iterable[Batch]) -> None:
        kind_of = np.zeros(2**16, dtype=np.int8)  # by number of the channel; 0: not a topic of the network
        known = 0
        size = file.path.stat().st_size
        for batch in batches:
            tell(f"reading {file.path.name}", min(batch.end, size), size)
            for number, channel in itertools.islice(file.channels.items(), known, None):
                schema = file.schemas.get(channel.schema_id)
                pattern = _TOPICS.get(schema.name if schema else "")
                found = pattern.search(channel.topic) if pattern else None
                kind_of[number] = _NUMBERS[found[1] if found else None]
            known = len(file.channels)
            self._add(batch, kind_of[batch.channel])
        for record in file.metadata:
            if record.name == RECORD_NAME and "record" in record.metadata and len(self.metadata) < MOST_RECORDS:
                self.metadata[record.metadata["record"]] = None
        self.refused[Refusal.TORN_FILE] += file.torn is not None
        self.refused[Refusal.DAMAGED_CHUNK] += file.damaged_chunks

    def _add(self, batch: Batch, kind: AnyArray) -> None:
        # Records first: states of a known run are put in their places at once.
        for index in np.flatnonzero(kind >= _NUMBERS[_GRAPH]).tolist():
            data = batch.message(index)
            try:
                if kind[index] == _NUMBERS[_GRAPH]:
                    self.graphs.append(ActiveGraph.decode(data))
                else:
                    self._learn(decode_string(data))
            except CdrError:
                self.refused[Refusal.COMPRESSED if data.startswith(_ZSTD_FRAME) else Refusal.UNDECODABLE] += 1
        for name, collector in ((_STATE, self.states), (_TRUTH, self.truths)):
            chosen = np.flatnonzero(kind == _NUMBERS[name])
            if len(chosen):
                collector.add(batch, chosen)

    def _learn(self, text: str) -> None:
        if text in self.experiments:
            return
        if len(self.experiments) >= MOST_RECORDS:
            raise BagError(
                f"{self.path}: more than {MOST_RECORDS} different messages on the topic `experiment`: expected the one "
                "record of a run: record each run into a bag of its own"
            )
        self.experiments[text] = record = self.parsed(text)
        if isinstance(record, RunRecord):
            for collector, width in zip((self.states, self.truths), _widths(record), strict=True):
                collector.expect(record, width)

    def parsed(self, text: str) -> RunRecord | InputError:
        """A run record, or why the text is not one: that matters only if no text is (another program's topic)."""
        try:
            return RunRecord.from_json(text, f"{self.path}: topic experiment")
        except InputError as error:
            return error


def _widths(record: RunRecord) -> tuple[int, int]:
    """Lengths of the states on the topics `state` and `truth`."""
    experiment = record.experiment
    return (experiment.run.replicas, experiment.width) if experiment.truth else (experiment.width, 0)


def _choose(contents: _Contents) -> RunRecord:
    """The run record of the one run that has states."""
    path = contents.path
    later = (text for text in contents.metadata if text not in contents.experiments)
    found = [*contents.experiments.values(), *map(contents.parsed, later)]
    if not found and contents.refused[Refusal.COMPRESSED]:
        raise BagError(f"{path}: {_EACH_COMPRESSED}")
    if not found and contents.refused[Refusal.DAMAGED_CHUNK]:
        raise BagError(
            f"{path}: {contents.refused[Refusal.DAMAGED_CHUNK]} chunks are damaged (wrong checksums, or times that no "
            "clock shows), and no record of the run is in what is left: copy the bag again, or record the run again"
        )
    if not found:
        pid = recording_pid(path)
        hint = f" (process {pid} is still recording it)" if pid else ""
        raise BagError(
            f"{path}: the latched topic `experiment` is missing, so the run is not known{hint}: record that topic too, "
            "with durability transient_local (as `ros2 bag record -a` does)"
        )
    errors = [each for each in found if isinstance(each, InputError)]
    records: dict[bytes, RunRecord] = {}
    for each in found:
        if not isinstance(each, RunRecord):
            continue
        first = records.setdefault(each.run.bytes, each)
        if first is not each and first.to_json() != each.to_json():
            raise BagError(
                f"{path}: two records of run {each.run} contradict each other, and one of them is forged: another "
                "program published on the topic `experiment`; record the run again"
            )
    if not records:
        raise errors[0]
    with_states = [record for run, record in records.items() if contents.states.count(run)]
    candidates = with_states or list(records.values())
    if len(candidates) > 1:
        listed = "; ".join(
            f"{r.run} ({r.experiment.name}, {contents.states.count(r.run.bytes)} states)" for r in candidates
        )
        raise BagError(f"{path}: {len(candidates)} runs in one bag: {listed}: record each run into a bag of its own")
    return candidates[0]


def _trajectory(contents: _Contents, record: RunRecord) -> Trajectory:
    experiment = record.experiment
    modes = _modes(contents, record.run.bytes, experiment.steps, len(experiment.graph_list))
    published, widths = None, _widths(record)
    if experiment.truth:
        published = contents.states.finish(record, widths[0])
        truth = contents.truths.finish(record, widths[1])
    else:
        truth = contents.states.finish(record, widths[0])
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
    return Trajectory(
        record,
        truth.states,
        modes,
        completeness,
        truth.modes,
        published=published.states if published else None,
        lost=truth.lost,
        used=truth.used,
        made=truth.made,
    )


def _modes(contents: _Contents, run: bytes, steps: int, graphs: int) -> IntArray:
    """(N,) graph of every step from the sojourns, from 0; -1 where none or more than one covers it."""
    sojourns: set[tuple[int, int, int, int]] = set()
    for graph in contents.graphs:
        if graph.run != run:
            contents.refused[Refusal.OTHER_RUN] += 1
        elif not (1 <= graph.mode <= graphs and graph.first_step <= graph.last_step < steps):
            contents.refused[Refusal.GRAPH_OUT_OF_RANGE] += 1
        else:
            sojourns.add((graph.sequence, graph.mode, graph.first_step, graph.last_step))
    modes = np.full(steps, -1, dtype=np.int64)
    claims = np.zeros(steps, dtype=np.int64)
    for _, mode, first, last in sorted(sojourns):
        modes[first : last + 1] = mode - 1
        claims[first : last + 1] += 1
    modes[claims != 1] = -1
    return modes
