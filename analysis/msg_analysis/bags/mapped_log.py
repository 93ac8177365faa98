# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Reads a bag, or a table (CSV, Parquet, NPZ), by a map: what there is of every agent, and a log to be compared."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.bags.files import bag_files, stored_file
from msg_analysis.bags.log_map import EVERY, GraphSource, LogMap, Source
from msg_analysis.bags.message_fields import STAMP, Definitions, FieldError, FieldReader, is_stamped
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import require_pyarrow, tell
from msg_analysis.common.text import amount, counted, listed
from msg_analysis.errors import BagError, InputError, NotAvailableError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.graph_files import GraphError
from msg_analysis.experiment.traces import read_trace
from msg_analysis.experiment.values import LARGEST_NUMBER
from msg_analysis.model.log import HIDDEN, Log

TABLES = (".csv", ".parquet", ".npz")
MOST_BACK = 5.0  # median intervals that a stamp may lie before an earlier one; more is a jump of the clock
LONGEST_CELL = 2**20
LARGEST_TABLE = 2**29  # bytes of its columns
LARGEST_CSV = 2**26  # bytes of the file, of which each cell becomes a text


@dataclass(slots=True, eq=False)
class Series:
    """What a source gives, in the order of the log."""

    what: str  # topic or column
    times: list[IntArray] = field(default_factory=list)  # [ns]
    values: list[AnyArray] = field(default_factory=list)  # (b, R), or (b,) of graphs
    short: int = 0  # messages that do not have the field
    logged: list[IntArray] = field(default_factory=list)  # when they were recorded [ns]; none of a table

    @property
    def count(self) -> int:
        """Of its values."""
        return sum(map(len, self.times))

    def sort(self, first: int) -> None:
        """Put what came from the piece ``first`` on into the order in which it was recorded."""
        if len(self.times) > first:
            order = np.argsort(np.concatenate(self.logged[first:]), kind="stable")
            for pieces in (self.times, self.logged, self.values):
                pieces[first:] = [np.concatenate(pieces[first:])[order]]

    def joined(self) -> tuple[IntArray, AnyArray]:
        """(K,) times and (K, R) values, or (K,) of graphs."""
        return np.concatenate(self.times), np.concatenate(self.values)


@dataclass(slots=True, eq=False)
class Contents:
    """What a log holds of the agents and of the graphs; None: given otherwise."""

    agents: list[Series]
    graph: Series | None
    notes: list[str] = field(default_factory=list)


def is_table(path: Path) -> bool:
    """Whether a path is that of a table, by its name."""
    return path.suffix.lower() in TABLES


def read_contents(path: Path, mapped: LogMap, several: Sequence[Source]) -> Contents:
    """What a bag or table has of the agents. InputError: a topic, field or column is missing, or no value is in it."""
    graph = mapped.graph if mapped.graph and mapped.graph.field else None
    topics = [each.topic for each in several] + [graph.topic for _ in (0,) if graph]
    with_topic = [topic for topic in topics if topic is not None]
    if is_table(path):
        if with_topic:
            raise InputError(f"topic: {with_topic[0]}: {path} is a table: expected columns as `field`: remove it")
        return _of_table(read_table(path), path, mapped, [each.all_fields for each in several], graph)
    if len(with_topic) < len(topics):
        raise InputError(f"topic: missing: {path} is a bag: expected a topic for every agent and for the graph")
    wanted = [(str(each.topic), each.all_fields) for each in several]
    if graph:
        wanted.append((str(graph.topic), [str(graph.field)]))
    series, notes = _of_bag(path, wanted, mapped.time, len(several))
    return Contents(series[: len(several)], series[-1] if graph else None, notes)


def _of_bag(path: Path, wanted: list[tuple[str, list[str]]], time: str, agents: int) -> tuple[list[Series], list[str]]:
    if time not in ("header", "log"):
        raise InputError(f"time: {time!r}: {path} is a bag: expected 'header' or 'log'")
    series = [Series(topic) for topic, _ in wanted]
    by_topic: dict[str, list[int]] = {}
    for place, (topic, _) in enumerate(wanted):
        by_topic.setdefault(topic, []).append(place)
    notes: dict[str, None] = {}
    topics: set[str] = set()
    definitions = Definitions()
    for path_ in bag_files(path):
        file = stored_file(path_)
        readers: dict[int, list[tuple[int, FieldReader, bool]]] = {}
        known, size, before = 0, path_.stat().st_size, [len(each.times) for each in series]
        for batch in file.batches():
            tell(f"reading {path_.name}", min(batch.end, size), size)
            for number in list(file.channels)[known:]:
                channel = file.channels[number]
                topics.add(channel.topic)
                for place in by_topic.get(channel.topic, ()):
                    schema = file.schemas.get(channel.schema_id)
                    if schema is None:
                        raise BagError(f"{path}: topic {channel.topic}: has no type: record it again")
                    try:
                        fields = wanted[place][1]
                        types = definitions.of(schema)
                        stamped = time == "header" and is_stamped(types, schema.name)
                        if time == "header" and not stamped:
                            if place < agents:
                                raise FieldError(f"time: header: {schema.name} has no header: expected `time: log`")
                            notes[f"The messages on {channel.topic} have no header: the times of the log count."] = None
                        reader = FieldReader(schema.name, types, [*fields, *(STAMP if stamped else ())])
                    except NotAvailableError:
                        raise
                    except InputError as error:
                        raise InputError(f"{path}: topic {channel.topic}: {error}") from None
                    readers.setdefault(number, []).append((place, reader, stamped))
            known = len(file.channels)
            for number, several in readers.items():
                chosen = np.flatnonzero(batch.channel == number)
                for place, reader, stamped in several if len(chosen) else ():
                    _add(series[place], reader, batch, chosen, stamped, wanted[place][1], graph=place >= agents)
        if file.unpacked_messages:  # rosbag2 compresses them in several threads, and writes each when it is done
            for each, first in zip(series, before, strict=True):
                each.sort(first)
        if file.torn is not None or file.damaged_chunks:
            notes[f"{path_.name} is torn or damaged: what is left is used."] = None
    empty = [each for each in series if not each.count]
    if empty:
        near = listed(sorted(topics), 20) or "none"
        reason = "no message has the field" if empty[0].short else f"no message: the bag has {near}"
        raise InputError(f"{path}: topic {empty[0].what}: {reason}: correct the map (`msg-analysis map {path}`)")
    return series, list(notes)


def _add(
    series: Series, reader: FieldReader, batch: Any, chosen: IntArray, stamped: bool, fields: list[str], *, graph: bool
) -> None:
    arrays, kept = reader.read(batch, chosen)
    series.short += len(chosen) - len(kept)
    if not len(kept):
        return
    logged = batch.head["log_time"][kept].astype(np.int64)
    series.times.append(arrays[STAMP[0]] * SECOND + arrays[STAMP[1]] if stamped else logged)
    series.logged.append(logged)
    if graph:
        series.values.append(arrays[fields[0]])
        return
    try:
        series.values.append(np.column_stack([arrays[name] for name in fields]).astype(float))
    except ValueError:
        raise InputError(f"topic {series.what}: field {fields[0]}: expected a number, and it is a text") from None


def read_table(path: Path) -> dict[str, AnyArray]:
    """Columns of a CSV, Parquet or NPZ file; InputError: it cannot be read."""
    try:
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as packed:
                _require_size(path, sum(each.file_size for each in packed.infolist()), LARGEST_TABLE)
            with np.load(path, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        if path.suffix.lower() == ".parquet":
            require_pyarrow(str(path))
            import pyarrow.parquet

            about = pyarrow.parquet.read_metadata(path)
            _require_size(path, 8 * about.num_rows * about.num_columns, LARGEST_TABLE)
            table = pyarrow.parquet.read_table(path)
            return {name: table.column(name).to_numpy() for name in table.column_names}
        _require_size(path, path.stat().st_size, LARGEST_CSV)
        csv.field_size_limit(LONGEST_CELL)
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.reader(stream)
            names = [name.strip() for name in next(rows, [])]
            cells = [row for row in rows if row]
        if any(len(row) != len(names) for row in cells):
            raise InputError(f"{path}: expected {len(names)} values in every line, as in the first one")
        return {name: np.array([row[place].strip() for row in cells]) for place, name in enumerate(names)}
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: expected a table with a row for each time") from None
    except Exception as error:  # the readers raise many kinds of errors on damage
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason})") from None


def _require_size(path: Path, size: int, most: int) -> None:
    if size > most:
        raise InputError(f"{path}: {amount(size)}: expected at most {amount(most)}: split it, or use fewer samples")


def _column(columns: Mapping[str, AnyArray], path: Path, name: str) -> AnyArray:
    if name not in columns:
        raise InputError(f"{path}: column {name}: missing: expected one of {listed(list(columns), 20)}")
    return columns[name]


def _numbers(columns: Mapping[str, AnyArray], path: Path, name: str) -> FloatArray:
    values = _column(columns, path, name)
    if values.ndim != 1:
        raise InputError(f"{path}: column {name}: shape {values.shape}: expected one number for each row")
    try:
        return np.asarray(np.where(values == "", "nan", values) if values.dtype.kind in "US" else values, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{path}: column {name}: expected numbers, empty where there is none") from None


def _of_table(
    columns: dict[str, AnyArray], path: Path, mapped: LogMap, fields: list[list[str]], graph: GraphSource | None
) -> Contents:
    name = "time" if mapped.time == "header" else mapped.time
    times = _numbers(columns, path, name)
    if not len(times) or not np.isfinite(times).all():
        raise InputError(f"{path}: column {name}: expected a finite number in every row [s]")
    if np.abs(times).max() > 2**62 / SECOND:
        raise InputError(f"{path}: column {name}: expected seconds below 4e9: divide it by the unit")
    stamps = np.rint(times * SECOND).astype(np.int64)
    agents = []
    for each in fields:
        values = np.column_stack([_numbers(columns, path, one) for one in each])
        agents.append(Series(listed(each), [stamps], [values]))
    found = None
    if graph:
        found = Series(str(graph.field), [stamps], [_column(columns, path, str(graph.field)).astype(object)])
    return Contents(agents, found)


def aligned(contents: Contents, mapped: LogMap, notes: list[str]) -> tuple[IntArray, FloatArray]:
    """(N,) times [ns] at which an agent has a value, and (N, m, R) states in units of the law; NaN: none."""
    columns, stamps = [], []
    for number, series in enumerate(contents.agents, start=1):
        times, values = _cleaned(series, number, mapped.period, notes)
        stamps.append(times)
        columns.append(values)
    every = np.unique(np.concatenate(stamps))
    states = np.full((len(every), len(columns), columns[0].shape[1]), np.nan)
    for i, (times, values) in enumerate(zip(stamps, columns, strict=True)):
        states[np.searchsorted(every, times), i] = values / mapped.units.state
    return every, states


def read_log(path: Path, mapped: LogMap, law: Experiment, directory: Path | None = None) -> Log:
    """The log in a bag or table. InputError: it does not fit the map or the law; ``directory``: base of the trace."""
    contents = read_contents(path, mapped, mapped.sources(law.agents, law.names))
    notes = list(contents.notes)
    every, states = aligned(contents, mapped, notes)
    origin = int(every[0])
    unit = SECOND * mapped.units.time
    graph: Any = mapped.graph.fixed if mapped.graph else None
    if mapped.graph and mapped.graph.hidden:
        if any(each.name == HIDDEN for each in law.graph_list):
            raise InputError(f"{law.source}: graphs.{HIDDEN}: expected another name with `graph: {HIDDEN}`: rename it")
        graph = HIDDEN
    if mapped.graph and mapped.graph.file:
        moments, names = _traced(mapped.graph, law, directory or Path())
        graph = ((moments * SECOND - origin) / unit, names)
    elif contents.graph:
        since, told = contents.graph.joined()
        order = np.argsort(since, kind="stable")
        graph = ((since[order] - origin) / unit, _names(told[order], law, contents.graph.what))
    noise = mapped.measurement_noise
    if not isinstance(noise, str):
        noise = (np.asarray(noise, dtype=float) / mapped.units.state).tolist()
    return Log.from_arrays(
        (every - origin) / unit,
        states,
        law=law,
        graph=graph,
        measurement_noise=noise,  # type: ignore[arg-type]
        sampled_law=mapped.law,
        notes=notes,
    )


def positions(bag: Path, mapped: LogMap) -> tuple[float, list[tuple[float, str, list[float]]]]:
    """The first time [s], and of each sample its time after it, the agent and the place, in the order of time.

    InputError: the map does not fit the bag, or has not two or three coordinates.
    """
    names, several = [str(key) for key in mapped.agents], list(mapped.agents.values())
    if EVERY in mapped.agents:
        raise InputError(f"agents.{EVERY}: how many are there? expected agents by number or name: list them")
    if len(several[0].all_fields) not in (2, 3):
        raise InputError("agents: expected `fields`, two or three coordinates of every agent")
    contents = read_contents(bag, mapped, several)
    cleaned = [_cleaned(series, k, mapped.period, []) for k, series in enumerate(contents.agents, start=1)]
    first = min(int(times[0]) for times, _ in cleaned)
    unit, scale = SECOND * mapped.units.time, mapped.units.state
    rows = [
        ((time - first) / unit, name, place)
        for name, (times, values) in zip(names, cleaned, strict=True)
        for time, place in zip(times.tolist(), (values / scale).tolist(), strict=True)
    ]
    return first / SECOND, sorted(rows, key=lambda row: row[0])


def usable(values: FloatArray) -> BoolArray:
    """(K,) whether all of (K, R) are numbers whose squares are, too."""
    return np.asarray((np.abs(values) <= LARGEST_NUMBER).all(axis=1))


def _cleaned(series: Series, number: int, period: float | None, notes: list[str]) -> tuple[IntArray, FloatArray]:
    """Ascending times and values, without duplicates and NaN; InputError: the clock jumps back."""
    times, values = series.joined()
    finite = usable(values)
    steps = np.diff(times)
    usual = float(np.median(np.abs(steps))) if len(steps) else 0.0
    back = np.flatnonzero(steps < -max(MOST_BACK * usual, 1.0))
    if len(back):
        raise InputError(
            f"{series.what}: the clock jumps back by {-steps[back[0]] / SECOND:.6g} s after {int(back[0]) + 1} values: "
            "expected one clock: split the log there, or use the other `time` (header, log)"
        )
    order = np.argsort(times, kind="stable")
    order = order[finite[order]]
    times, values = times[order], values[order]
    once = np.append(True, np.diff(times) > 0) if len(times) else np.ones(0, bool)
    for count, what in (
        (int((~finite).sum()), "that are not finite"),
        (int((~once).sum()), "with the time of another one"),
    ):
        if count:
            notes.append(f"Agent {number}: {counted(count, 'value')} {what} not used.")
    times, values = times[once], values[once]
    if period is not None and len(times):
        bins = (times - times[0]) // round(period * SECOND)
        first = np.append(True, np.diff(bins) > 0)
        times, values = times[first], values[first]
    if not len(times):
        raise InputError(f"{series.what}: no finite value of agent {number}: correct the map")
    return times, values


def _names(values: AnyArray, law: Experiment, what: str) -> list[str]:
    """Names of graphs, from names or numbers from 1."""
    names = [graph.name for graph in law.graph_list]
    known = {
        **{name: name for name in names},
        **{str(k): name for k, name in enumerate(names, 1) if str(k) not in names},
    }
    found = [known.get(str(value).strip()) for value in values.tolist()]
    if None in found:
        wrong = values[found.index(None)]
        raise InputError(
            f"{what}: graph {str(wrong)[:60]!r}: expected one of {listed(names)}, or a number from 1 to {len(names)}"
        )
    return [str(name) for name in found]


def _traced(graph: GraphSource, law: Experiment, directory: Path) -> tuple[FloatArray, list[str]]:
    """Times [s] and names of the graphs in a trace; InputError: not readable, or a graph that the law does not have."""
    file = directory / str(graph.file)
    try:
        trace = read_trace(
            "graph.file", file, hold=graph.hold, radius=graph.radius, directed=not (graph.undirected or False)
        )
    except GraphError as error:
        raise InputError(str(error)) from error
    if not trace.graphs:
        names = _names(np.array([trace.nodes[which] for which in trace.which], dtype=object), law, str(file))
        return trace.first + np.array(trace.starts), names
    named = {each.name: each.adjacency for each in law.graph_list}
    labels = {name: i for i, name in enumerate(law.names or [])}
    labels |= {str(i + 1): i for i in range(law.agents)}
    unknown = [node for node in trace.nodes if node not in labels]
    if unknown:
        raise InputError(f"{file}: agent {unknown[0]}: expected agents of the law by number or name")
    found = []
    for links in trace.graphs:
        adjacency = np.zeros((law.agents, law.agents))
        for a, b, weight in links:
            i, j = labels[trace.nodes[a]], labels[trace.nodes[b]]
            adjacency[j, i] = weight
            if not trace.directed:
                adjacency[i, j] = weight
        name = next((name for name, each in named.items() if np.allclose(each, adjacency)), None)
        if name is None:
            pairs = listed([f"{trace.nodes[a]}-{trace.nodes[b]}" for a, b, _ in links]) or "none"
            raise InputError(f"{file}: links {pairs}: no graph of the law has these: add it to `graphs`")
        found.append(name)
    return trace.first + np.array(trace.starts), [found[which] for which in trace.which]
