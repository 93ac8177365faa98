# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Recorded topologies: tables that say which agents were linked, or where they were, and when."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain, groupby, pairwise
from operator import itemgetter
from pathlib import Path

import numpy as np

from msg_analysis.common.text import counted, listed
from msg_analysis.errors import InputError
from msg_analysis.experiment.graph_files import ForeignGraph, GraphError, file_content, node_name
from msg_analysis.experiment.problems import show
from msg_analysis.experiment.spec import SwitchingSpec
from msg_analysis.experiment.values import LARGEST_NUMBER

MOST_AGENTS = 20_000  # one matrix of them takes 3 GB
MOST_LINKS = 1_500_000  # in all graphs together, which take 0.6 GB
MOST_ROWS = 1_300_000  # of contacts or intervals, which are read in 10 s
ROUNDING = 1e-9  # of times: what differs by less, relative to its size, is the same time

COLUMNS: Mapping[str, Sequence[str]] = {
    "intervals": ("start", "end", "source", "target"),
    "contacts": ("time", "source", "target"),
    "schedule": ("time", "graph"),
    "positions": ("time", "agent", "x", "y"),
}
"""Kinds of traces, and the columns that a table has which is one."""

OPTIONAL = {"intervals": "weight", "contacts": "weight", "positions": "z"}
_WANTED = "expected the columns " + " or ".join(",".join(columns) for columns in COLUMNS.values())
_CORRECT = "correct the line"

Link = tuple[int, int, float]
"""Source, target (which listens to it) and weight; agents by their place in ``Trace.nodes``."""

_Interval = tuple[float, float, Link]
_Row = tuple[str, Sequence[float], Sequence[str]]
"""Where it stands, its time, or start and end, after the first one, and its other cells in the order of the columns."""

Rows = tuple[str, float, Iterator[_Row]]
"""The kind of trace, its first time, and its rows in the order of time."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Which graph was there when. A stretch of time lasts until the next one begins, the last one until ``end``.

    Attributes
    ----------
    nodes
        the agents as the file has them, in the order in which they appear; of a schedule, its graphs
    graphs
        the links of every graph that differs from the others, in the order in which they appear; none of a schedule
    starts
        (p,) where the stretches begin [units of simulated time], ascending from 0
    which
        (p,) graph of every stretch, from 0
    end
        where the last stretch ends; inf: the file does not say it
    first
        the time of the file that is time 0
    directed
        whether only its target hears a link
    """

    nodes: Sequence[str]
    graphs: Sequence[Sequence[Link]]
    starts: Sequence[float]
    which: Sequence[int]
    end: float
    first: float
    directed: bool


def read_trace(
    key: str,
    file: Path,
    *,
    hold: float | None = None,
    radius: float | None = None,
    directed: bool = True,
    given: Rows | None = None,
) -> Trace:
    """The trace in a CSV file. GraphError: its mistake.

    Parameters
    ----------
    key, file
        in the experiment, for messages; where it is
    hold
        how long a contact or a position is valid, or the last graph of a schedule lasts [units of simulated time]
    radius
        distance up to which agents with positions are linked
    directed
        whether only the target of a contact or interval hears the other
    given
        what is in it, if it is no CSV file
    """
    kind, first, rows = given or _rows(key, file)
    if kind == "contacts" and hold is None:
        raise GraphError("switching.hold", "missing", "expected with contacts", "add how long one is valid")
    if kind == "intervals" and hold is not None:
        raise GraphError("switching.hold", hold, "expected none with intervals, which have an end", "remove it")
    if kind == "positions" and radius is None:
        raise GraphError("switching.radius", "missing", "expected with positions", "add how near linked agents are")
    if kind != "positions" and radius is not None:
        raise GraphError("switching.radius", radius, f"expected with positions, and this is {kind}", "remove it")
    if kind == "schedule":
        return _schedule(key, rows, hold, first)
    nodes: dict[str, int] = {}
    if radius is not None:
        moments = _near(key, rows, nodes, radius, hold)
    else:
        moments = _moments(
            _joined(key, _intervals(key, rows, nodes, hold), directed=directed, refreshed=hold is not None)
        )
    return _trace(key, nodes, moments, first, directed=directed and radius is None)


def resolved(
    switching: SwitchingSpec, graphs: Collection[str], directory: Path
) -> tuple[SwitchingSpec, dict[str, ForeignGraph], list[str]]:
    """The section with the schedule of its trace, the graphs of the trace by name, and notes. GraphError: a mistake.

    ``graphs``: names of those in the experiment; ``directory``: base of the path.
    """
    key, directed = "switching.trace", not switching.undirected
    file = directory / (switching.trace or "")
    if switching.map is None and (file.suffix in (".mcap", ".db3") or (file / "metadata.yaml").exists()):
        wanted = "expected with a bag: the file that says where its positions are"
        raise GraphError("switching.map", "missing", wanted, "add it: `msg-analysis map` makes one")
    bag = _bag_rows(file, directory / switching.map) if switching.map else None
    trace = read_trace(key, file, hold=switching.hold, radius=switching.radius, directed=directed, given=bag)
    if switching.schedule is not None or bool(graphs) == bool(trace.graphs):
        wanted = "none with a trace of links" if trace.graphs else "the graphs that the trace names"
        raise GraphError("graphs", listed(list(graphs)) or "missing", f"expected {wanted}", "correct one of the two")
    for name in ("end",) if trace.graphs else ("end", "undirected", "weight"):
        if (value := getattr(switching, name)) is not None:
            raise GraphError(f"switching.{name}", value, "expected without this trace", "remove it")
    names, nodes, weight = trace.nodes, trace.nodes, switching.weight or 1.0
    found: dict[str, ForeignGraph] = {}
    if trace.graphs:
        names = [f"g{number}" for number in range(1, len(trace.graphs) + 1)]
        for name, links in zip(names, trace.graphs, strict=True):
            arcs = [(nodes[a], nodes[b], weight * each) for a, b, each in links]
            found[name] = ForeignGraph(() if found else nodes, arcs, trace.directed)  # all nodes are known by the first
    changes = dict.fromkeys(("trace", "map", "hold", "radius", "undirected", "weight")) | {
        "schedule": [(start, names[graph]) for start, graph in zip(trace.starts, trace.which, strict=True)],
        "end": None if math.isinf(trace.end) else trace.end,
    }
    looks = f", which looks like {unit} since 1970" if (unit := _unit_of(trace.first)) else ""
    notes = [f"{key}: time 0 of the run is {trace.first:.12g} in the file{looks}"] if trace.first else []
    return switching.model_copy(update=changes), found, notes


def _unit_of(first: float) -> str | None:
    """The unit that the first time of a file seems to have, if it counts from 1970; None: seconds, or unknown."""
    sizes = {"milliseconds": 1e12, "microseconds": 1e15, "nanoseconds": 1e18}
    return next((unit for unit, size in sizes.items() if 1.0 <= first / size < 4.0), None)


def _bag_rows(bag: Path, mapped: Path) -> Rows:
    """The positions in a bag, by a map. GraphError: there are none, or the map does not fit."""
    from msg_analysis.bags.log_map import load_map  # here, since bags are read by another chapter
    from msg_analysis.bags.mapped_log import positions

    try:
        first, found = positions(bag, load_map(mapped))
    except InputError as error:
        raise GraphError("switching.map", str(error), "expected a map that fits the bag", "correct it") from error
    return "positions", first, ((str(bag), [time], (agent, *map(repr, place))) for time, agent, place in found)


def _rows(key: str, file: Path) -> Rows:
    """The kind of trace, its first time, and its rows in the order of time."""
    try:
        content = file_content(key, file)
        separator = max((",", ";", "\t"), key=content.decode("utf-8-sig").partition("\n")[0].count)
        text = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline="")  # StringIO has 4 bytes a character
        table = csv.reader(text, delimiter=separator, skipinitialspace=True)
        names = [name.strip().lower() for name in next(table, [])]
        found = next((kind for kind, columns in COLUMNS.items() if set(columns) <= set(names)), None)
    except (UnicodeDecodeError, csv.Error) as error:
        raise GraphError(key, str(file), f"expected a CSV file in UTF-8 ({error})", "export it again") from error
    if not found:
        raise GraphError(key, f"{file}, line 1: {show(','.join(names))}", _WANTED, "correct the header")
    wanted = [*COLUMNS[found], *([OPTIONAL[found]] if OPTIONAL.get(found) in names else [])]
    if found in ("contacts", "intervals") and (count := content.count(b"\n")) > MOST_ROWS:
        room = f"expected at most {MOST_ROWS}"
        raise GraphError(key, f"{file}: {count} lines", room, "split it, or give intervals instead of contacts")
    if twice := next((name for name in wanted if names.count(name) > 1), None):
        raise GraphError(key, f"{file}, line 1: {twice} twice", "expected it once", "remove one")
    pick, times = itemgetter(*map(names.index, wanted)), 2 if found == "intervals" else 1

    def cells() -> Iterator[tuple[str, Sequence[Decimal], Sequence[str]]]:
        before, known, now = Decimal("-Infinity"), [""], [Decimal()]
        try:
            for row in table:
                if not any(row):
                    continue
                place = f"{file}, line {table.line_num}"
                try:
                    values = pick(row)
                except IndexError:
                    shown = f"{place}: {show(separator.join(row))}"
                    raise GraphError(key, shown, f"expected {len(names)} values as in the header", _CORRECT) from None
                if values[:times] != known:  # many contacts have the same time
                    known = values[:times]
                    now = [_number(key, place, column, text) for column, text in zip(wanted, known, strict=False)]
                if now[0] < before:
                    expected = f"expected at least {before}, the one before"
                    raise GraphError(key, f"{place}: {wanted[0]} {now[0]}", expected, "sort the file by it")
                before = now[0]
                yield place, now, values[times:]
        except csv.Error as error:
            raise GraphError(key, f"{file}, line {table.line_num}", f"expected CSV ({error})", _CORRECT) from error

    rows = cells()
    head = next(rows, None)
    if head is None:
        raise GraphError(key, str(file), "expected rows below the header", "record something")
    first = head[1][0]  # subtracted as it is written: a double of seconds since 1970 has a rounding of its own
    return (
        found,
        float(first),
        ((place, [float(time - first) for time in now], others) for place, now, others in chain([head], rows)),
    )


def _number(key: str, place: str, column: str, text: str) -> Decimal:
    try:
        value = Decimal(text)
        if abs(value) <= LARGEST_NUMBER:
            return value
    except InvalidOperation:
        pass
    raise GraphError(key, f"{place}: {column} {show(text)}", "expected a finite number", _CORRECT)


def _agent(key: str, text: str, nodes: dict[str, int]) -> int:
    if (found := nodes.get(text)) is not None:  # a million rows have few different ones
        return found
    if len(nodes) >= MOST_AGENTS:
        raise GraphError(key, f"more than {MOST_AGENTS} agents", "expected fewer", "correct the columns, or split it")
    return nodes.setdefault(node_name(key, text, _CORRECT), len(nodes))


def _same(one: float, other: float) -> bool:
    """Whether times differ by rounding only."""
    return abs(one - other) <= ROUNDING * max(1.0, abs(one))


def _schedule(key: str, rows: Iterable[_Row], hold: float | None, first: float) -> Trace:
    nodes: dict[str, int] = {}
    starts: list[float] = []
    which: list[int] = []
    for place, (time,), (graph, *_) in rows:
        if starts and _same(time, starts[-1]):
            raise GraphError(key, f"{place}: a time twice", "expected one graph at a time", _CORRECT)
        starts.append(time)
        which.append(nodes.setdefault(graph.strip(), len(nodes)))
    end = math.inf if hold is None else starts[-1] + hold
    return Trace(list(nodes), (), starts, which, end, first, directed=False)


def _intervals(
    key: str, rows: Iterable[_Row], nodes: dict[str, int], hold: float | None
) -> Iterator[tuple[str, _Interval]]:
    """When each row says that a link was there."""
    for place, (begin, *others), cells in rows:
        end = begin + hold if hold is not None else others[0]
        if hold is not None and _same(begin, end):
            wanted = f"expected times in the unit of switching.hold, {hold:g}"
            raise GraphError(key, f"{place}: {begin:g} after the first", wanted, "divide them, if they are nanoseconds")
        if end <= begin or _same(begin, end):
            raise GraphError(key, place, "expected the end of an interval after its start", _CORRECT)
        a, b = _agent(key, cells[0], nodes), _agent(key, cells[1], nodes)
        weight = float(_number(key, place, "weight", cells[2])) if cells[2:] else 1.0
        if a == b or weight <= 0.0:
            shown, wanted = (
                (show(cells[0]), "two different agents") if a == b else (f"weight {weight:g}", "a number > 0")
            )
            raise GraphError(key, f"{place}: {shown}", f"expected {wanted}", _CORRECT)
        yield place, (begin, end, (a, b, weight))


def _joined(
    key: str, intervals: Iterable[tuple[str, _Interval]], *, directed: bool, refreshed: bool
) -> Iterator[_Interval]:
    """The same, no two of a link that touch; ``refreshed``: a later one takes over from an earlier one."""
    open_: dict[tuple[int, int], _Interval] = {}
    for place, (begin, end, (a, b, weight)) in intervals:
        pair = (a, b) if directed or a < b else (b, a)
        now = (begin, end, (*pair, weight))
        if pair in open_:
            since, until, link = open_[pair]
            if not refreshed and begin < until and not _same(begin, until):
                wanted = f"expected no start {until - begin:.6g} before the same link has ended"
                raise GraphError(key, place, wanted, "correct one of the two")
            if begin > until and not _same(begin, until):
                yield since, until, link
            elif link[2] == weight:
                now = (since, max(end, until), link)
            elif not _same(since, begin):
                yield since, begin, link
        open_[pair] = now
    yield from open_.values()


def _moments(intervals: Iterable[_Interval]) -> Iterator[tuple[float, frozenset[Link]]]:
    """From each time on, the links that are there; the last one is the end."""
    begins, ends, links = zip(*intervals, strict=True)
    times = [*ends, *begins]
    there: set[Link] = set()
    order = np.argsort(times, kind="stable").tolist()  # at one time, links go before others come
    count = len(ends)
    for number, place in enumerate(order):
        (there.discard if place < count else there.add)(links[place % count])
        if number + 1 == len(order) or not _same(times[place], times[order[number + 1]]):
            yield times[place], frozenset(there)


def _near(
    key: str, rows: Iterable[_Row], nodes: dict[str, int], radius: float, hold: float | None
) -> Iterator[tuple[float, frozenset[Link]]]:
    """The same of agents with places, which are linked while they are within the radius."""
    from scipy.spatial import KDTree  # here, since every process of a run would wait for it

    places: dict[int, tuple[float, Sequence[float]]] = {}  # until when it is valid, and where
    time = 0.0

    def links() -> frozenset[Link]:
        agents = sorted(places)
        if len(agents) < 2:
            return frozenset()
        tree = KDTree([places[agent][1] for agent in agents])
        if len(agents) ** 2 > MOST_LINKS:
            _check_size(key, int(tree.count_neighbors(tree, radius) - len(agents)) // 2, 1)
        return frozenset((agents[a], agents[b], 1.0) for a, b in tree.query_pairs(radius))

    def forget(until: float) -> Iterator[tuple[float, frozenset[Link]]]:
        for end in sorted({end for end, _ in places.values() if end < until}):
            for agent in [agent for agent, (valid, _) in places.items() if valid <= end]:
                del places[agent]
            yield end, links()

    for (time,), group in groupby(rows, key=itemgetter(1)):
        yield from forget(time)
        for place, _, (name, *cells) in group:
            agent = _agent(key, name, nodes)
            where = [float(_number(key, place, column, cell)) for column, cell in zip("xyz", cells, strict=False)]
            places[agent] = (time + hold if hold else math.inf, where)
        yield time, links()
    yield from forget(time + (hold or 0.0))
    yield time + (hold or 0.0), frozenset()


def _check_size(key: str, links: int, graphs: int) -> None:
    """GraphError: more links than fit in memory."""
    if links > MOST_LINKS:
        wanted = f"expected at most {MOST_LINKS} in all graphs together"
        raise GraphError(key, f"{links} links in {counted(graphs, 'graph')}", wanted, "lower `radius`, or split it")


def _trace(
    key: str,
    nodes: Mapping[str, int],
    moments: Iterable[tuple[float, frozenset[Link]]],
    first: float,
    *,
    directed: bool,
) -> Trace:
    numbers: dict[frozenset[Link], int] = {}
    starts: list[float] = []
    which: list[int] = []
    end, count = 0.0, 0
    for (time, links), (end, _) in pairwise(moments):
        count += len(links) if links not in numbers else 0
        _check_size(key, count, len(numbers) + 1)
        number = numbers.setdefault(links, len(numbers))
        if not _same(time, end) and which[-1:] != [number]:
            starts.append(time)
            which.append(number)
    return Trace(list(nodes), [sorted(links) for links in numbers], starts, which, end, first, directed)
