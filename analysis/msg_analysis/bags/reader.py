"""Reads a recorded run, whoever recorded it, and counts what is there before anything else."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from msg_analysis.bags.cdr import ActiveGraph, CdrError, decode_string
from msg_analysis.bags.inventory import Inventory
from msg_analysis.bags.mcapfile import Batch, McapFile
from msg_analysis.bags.metadata import METADATA_FILE, read_metadata
from msg_analysis.bags.schemas import ACTIVE_GRAPH, AGENT_STATE, STRING
from msg_analysis.bags.states import StateColumns, States
from msg_analysis.bags.writer import RECORD_NAME, recording_pid
from msg_analysis.errors import BagError, InputError
from msg_analysis.model.air import LOST
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import Wiring, build_model
from msg_analysis.model.trajectory import Completeness, Trajectory
from msg_analysis.types import BoolArray, IntArray

# Topics are told by type and by the end of their name: the network may run in any namespace.
_STATE, _TRUTH, _GRAPH, _EXPERIMENT = "state", "truth", "graph", "experiment"
_TOPICS = {
    AGENT_STATE.full_name: re.compile(r"(?:^|/)agent_\d+/(state|truth)$"),
    ACTIVE_GRAPH.full_name: re.compile(r"(?:^|/)(graph)$"),
    STRING.full_name: re.compile(r"(?:^|/)(experiment)$"),
}
_ZSTD_FRAME, _COMPRESSED = b"\x28\xb5\x2f\xfd", "compressed message"
_EACH_COMPRESSED = (
    "every message in it is compressed by itself, which cannot be read: convert it, or record with "
    "`--storage-preset-profile zstd_fast`"
)


def read_bag(path: str | Path, inventory: Inventory | None = None) -> Trajectory:
    """The run that a bag holds.

    Parameters
    ----------
    path : str | Path
        the directory of a bag, with metadata.yaml or without, or one of its .mcap files; torn files are read
        up to the tear
    inventory : Inventory | None
        is filled with what the files hold, also where no run can be made of it

    Returns
    -------
    Trajectory
        with the account of what is missing in ``completeness``

    Raises
    ------
    BagError : no bag, a bag without the run record, or with several runs
    InputError : the run record in it is not valid
    """
    path = Path(path)
    contents = _Contents()
    unreadable: list[BagError] = []
    files = bag_files(path)
    for file in files:
        entry = (inventory or Inventory()).add(McapFile(file))
        try:
            contents.read(entry.file, entry.watch() if inventory else entry.file.batches())
        except BagError as error:  # the recorder died when it had just made it, or it is damaged from the start
            entry.problem = str(error)
            unreadable.append(error)
    if len(unreadable) == len(files):
        raise unreadable[0]
    contents.refused["unreadable file"] += len(unreadable)
    record = _choose(contents, path)
    return _trajectory(contents, record)


def bag_files(path: Path) -> list[Path]:
    """The MCAP files of a bag in their order.

    Parameters
    ----------
    path : Path
        directory or file

    Raises
    ------
    BagError : there is none, one is missing, or the bag is of a kind that cannot be read
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"{path}: not found: expected the directory of a bag or an .mcap file")
    information = read_metadata(path)
    if information is None:
        files = [file for suffix in ("mcap", "mcap.zstd") for file in path.glob(f"*.{suffix}")]
        if not files:
            raise BagError(f"{path}: no bag: expected metadata.yaml or .mcap files in this directory")
        return sorted(files, key=_file_number)
    storage = information.get("storage_identifier")
    if storage != "mcap":
        raise BagError(
            f"{path}: its storage is {storage}, expected mcap: record with `ros2 bag record -s mcap`, or convert it"
        )
    if str(information.get("compression_mode", "")).lower() == "message":
        raise BagError(f"{path}: {_EACH_COMPRESSED}")
    files = [path / str(name) for name in information.get("relative_file_paths") or []]
    lost = [file.name for file in files if not file.is_file()]
    if lost or not files:
        raise BagError(
            f"{path}: {', '.join(lost) or 'every file'} of its {METADATA_FILE} is missing: copy the whole bag, or move "
            f"{METADATA_FILE} away to read the files that are there"
        )
    return files


def _file_number(file: Path) -> tuple[int, str]:
    """Rosbag2 numbers the files of a split bag: name_0.mcap, name_1.mcap, ..., name_10.mcap."""
    number = re.search(r"_(\d+)\.mcap", file.name)
    return int(number[1]) if number else 0, file.name


@dataclass(slots=True)
class _Contents:
    """What the files of a bag hold of our topics."""

    states: StateColumns = field(default_factory=StateColumns)
    truths: StateColumns = field(default_factory=StateColumns)
    graphs: list[ActiveGraph] = field(default_factory=list)
    experiments: dict[str, None] = field(default_factory=dict)  # texts, each once, in order
    records: dict[str, None] = field(default_factory=dict)  # the same from the metadata of our own files
    refused: Counter[str] = field(default_factory=Counter)

    def read(self, file: McapFile, batches: Iterable[Batch]) -> None:
        kinds: dict[int, str | None] = {}
        for batch in batches:
            for number, channel in file.channels.items():
                if number not in kinds:
                    schema = file.schemas.get(channel.schema_id)
                    pattern = _TOPICS.get(schema.name if schema else "")
                    found = pattern.search(channel.topic) if pattern else None
                    kinds[number] = found[1] if found else None
            self._add(batch, kinds)
        self.records.update(
            (record.metadata["record"], None)
            for record in file.metadata
            if record.name == RECORD_NAME and "record" in record.metadata
        )
        self.refused["torn file"] += file.torn is not None
        self.refused["damaged chunk"] += file.damaged_chunks

    def _add(self, batch: Batch, kinds: dict[int, str | None]) -> None:
        for wanted, columns in ((_STATE, self.states), (_TRUTH, self.truths)):
            states = np.isin(batch.channel, [number for number, kind in kinds.items() if kind == wanted])
            if states.any():
                columns.add(batch, np.flatnonzero(states))
        others = np.isin(batch.channel, [n for n, kind in kinds.items() if kind in (_GRAPH, _EXPERIMENT)])
        for index in np.flatnonzero(others).tolist():
            data = batch.message(index)
            try:
                if kinds[int(batch.channel[index])] == _GRAPH:
                    self.graphs.append(ActiveGraph.decode(data))
                else:
                    self.experiments[decode_string(data)] = None
            except CdrError:
                self.refused[_COMPRESSED if data.startswith(_ZSTD_FRAME) else "undecodable"] += 1


def _choose(contents: _Contents, path: Path) -> RunRecord:
    """The run record of the one run that has states."""
    texts = contents.experiments | contents.records
    if not texts and contents.refused[_COMPRESSED]:
        raise BagError(f"{path}: {_EACH_COMPRESSED}")
    if not texts:
        pid = recording_pid(path)
        hint = f" (process {pid} is still recording it)" if pid else ""
        raise BagError(
            f"{path}: recorded without the latched topic `experiment`, so nobody knows what run it is "
            f"of{hint}: record "
            "that topic too, with durability transient_local (as `ros2 bag record -a` does)"
        )
    records: dict[bytes, RunRecord] = {}
    errors: list[InputError] = []
    for text in texts:
        try:
            record = RunRecord.from_json(text, f"{path}: topic experiment")
            records.setdefault(record.run.bytes, record)
        except InputError as error:  # another program's topic of that name, or a record that we cannot use
            errors.append(error)
    if not records:
        raise errors[0]
    counts = contents.states.runs()
    with_states = [record for run, record in records.items() if counts.get(run)]
    candidates = with_states or list(records.values())
    if len(candidates) > 1:
        listed = "; ".join(f"{r.run} ({r.experiment.name}, {counts.get(r.run.bytes, 0)} states)" for r in candidates)
        raise BagError(f"{path}: {len(candidates)} runs in one bag: {listed}: record each run into a bag of its own")
    return candidates[0]


def _trajectory(contents: _Contents, record: RunRecord) -> Trajectory:
    experiment = record.experiment
    modes = _modes(contents, record.run.bytes, experiment.steps, len(experiment.graph_list))
    published = None
    if experiment.truth:
        published = _Collected(contents.states, record, experiment.run.replicas, contents.refused)
        truth = _Collected(contents.truths, record, experiment.width, contents.refused)
    else:
        truth = _Collected(contents.states, record, experiment.width, contents.refused)
    parts = [truth] if published is None else [truth, published]
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


class _Collected:
    """The states of a run that a bag holds on one kind of topic, each once, ordered by step.

    Attributes
    ----------
    states : (N + 1, m, width); NaN where a state is missing
    modes : (N + 1, m) from 0; -1 where missing
    lost, used, made : see ``Trajectory``
    received, duplicates, out_of_order : see ``Completeness``
    """

    def __init__(self, columns: StateColumns, record: RunRecord, width: int, refused: Counter[str]) -> None:
        experiment = record.experiment
        agents, steps = experiment.agents, experiment.steps
        run = record.run.bytes
        refused["undecodable"] += columns.undecodable
        counts = columns.runs()
        refused["other run"] += sum(counts.values()) - counts.get(run, 0)
        realtime = experiment.run.pace == "realtime"
        links = _Links(build_model(experiment), steps) if experiment.noise.loss or realtime else None
        taken = columns.take(run, width, links.most if links else 0)
        refused["wrong length"] += counts.get(run, 0) - len(taken.step)

        good = np.ones(len(taken.step), dtype=np.bool_)
        for reason, bad in (
            ("unknown agent", (taken.agent < 1) | (taken.agent > agents)),
            ("step out of range", taken.step > steps),
            ("unknown mode", taken.mode > len(experiment.graph_list)),
            ("not finite", ~np.isfinite(taken.state).all(axis=1)),
            ("stamped before the start", realtime & (taken.stamp < 0)),
        ):
            refused[reason] += int((good & bad).sum())
            good &= ~bad
        index = np.flatnonzero(good)
        if links:
            fits = links.fit(taken, index, realtime=realtime)
            refused["heard what it cannot have"] += int((~fits).sum())
            index = index[fits]
        cell = taken.step[index] * agents + taken.agent[index] - 1
        cells, first, owner = np.unique(cell, return_index=True, return_inverse=True)
        kept = index[first]  # of several copies, the first in the bag
        again = np.delete(np.arange(len(cell)), first)
        copy, original = index[again], kept[owner[again]]
        differs = (taken.state[copy] != taken.state[original]).any(axis=1)
        differs |= (taken.heard[copy] != taken.heard[original]).any(axis=1)
        if realtime:
            differs |= taken.stamp[copy] != taken.stamp[original]
        refused["contradicts an earlier copy"] += int(differs.sum())
        # One of them is forged, and nobody knows which: the state counts as missing.
        certain = np.ones(len(cells), dtype=np.bool_)
        certain[owner[again[differs]]] = False
        cells, kept = cells[certain], kept[certain]

        states = np.full(((steps + 1) * agents, width), np.nan)
        states[cells] = taken.state[kept]
        modes = np.full((steps + 1) * agents, -1, dtype=np.int64)
        modes[cells] = taken.mode[kept] - 1
        self.states, self.modes = states.reshape(steps + 1, agents, width), modes.reshape(steps + 1, agents)
        self.lost: BoolArray | None = None
        self.used: IntArray | None = None
        self.made: IntArray | None = None
        if links and realtime:
            listed = np.arange(links.most) < taken.heard_count[kept, None]
            used = np.full(((steps + 1) * agents, links.most), -1, dtype=np.int64)
            used[cells] = np.where(listed & (taken.heard[kept] != LOST), taken.heard[kept].astype(np.int64), -1)
            made = np.full((steps + 1) * agents, -1, dtype=np.int64)
            made[cells] = taken.stamp[kept]
            self.used, self.made = used.reshape(steps + 1, agents, links.most)[1:], made.reshape(steps + 1, agents)
        elif links:
            lost = np.zeros(((steps + 1) * agents, links.most), dtype=np.bool_)
            lost[cells] = taken.heard[kept] == LOST
            self.lost = lost.reshape(steps + 1, agents, links.most)[1:]
        self.received, self.duplicates = len(cells), len(again)
        self.out_of_order = _out_of_order(taken, kept)


class _Links:
    """What ``heard`` can be where it says something.

    Attributes
    ----------
    most : largest number of neighbours
    """

    def __init__(self, model: Wiring, steps: int) -> None:
        self._last = np.uint64(steps)
        self.most = model.most_neighbours
        self._neighbours = np.zeros((model.modes + 1, model.agents), dtype=np.int64)  # no graph led to step 0
        for mode in range(model.modes):
            self._neighbours[mode + 1] = [len(model.neighbours(mode, i)) for i in range(model.agents)]

    def fit(self, states: States, index: IntArray, *, realtime: bool) -> BoolArray:
        """Whether what they heard is, for each neighbour under their graph, a step that can be, or ``LOST``.

        In lockstep that is the step before, and nothing at all says the same of all neighbours.
        """
        heard, count = states.heard[index], states.heard_count[index]
        neighbours = self._neighbours[states.mode[index], states.agent[index] - 1]
        if realtime:
            possible = heard <= self._last
        else:
            possible = heard == (states.step[index].astype(np.uint64) - np.uint64(1))[:, None]
        known = (heard == LOST) | possible | (np.arange(self.most) >= count[:, None])
        fits = (count == neighbours) & known.all(axis=1)
        return np.asarray(fits if realtime else fits | (count == 0))


def _out_of_order(states: States, index: IntArray) -> int:
    """How many of these states came after a later one of the same agent."""
    agent, step = states.agent[index], states.step[index]
    order = np.lexsort((states.position[index], agent))
    height = (agent * (step.max(initial=0) + 1) + step)[order]  # rises from agent to agent
    return int((height < np.maximum.accumulate(height)).sum())


def _modes(contents: _Contents, run: bytes, steps: int, graphs: int) -> IntArray:
    """(N,) graph of every step from the sojourns; -1 where none or more than one claims it."""
    sojourns: set[tuple[int, int, int, int]] = set()
    for graph in contents.graphs:
        if graph.run != run:
            contents.refused["other run"] += 1
        elif not (1 <= graph.mode <= graphs and graph.first_step <= graph.last_step < steps):
            contents.refused["graph out of range"] += 1
        else:
            sojourns.add((graph.sequence, graph.mode, graph.first_step, graph.last_step))
    modes = np.full(steps, -1, dtype=np.int64)
    claims = np.zeros(steps, dtype=np.int64)
    for _, mode, first, last in sorted(sojourns):
        modes[first : last + 1] = mode - 1
        claims[first : last + 1] += 1
    modes[claims != 1] = -1
    return modes
