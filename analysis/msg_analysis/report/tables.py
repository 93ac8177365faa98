# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Tables for terminals: bags, runs, sweeps."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text import (
    agent_name,
    agent_text,
    amount,
    counted,
    duration_text,
    half_width_text,
    listed,
    number_text,
    p_text,
    z_text,
)
from msg_analysis.runs import RunEntry
from msg_analysis.sweeps.grid import SweepGrid
from msg_analysis.sweeps.points import FAILED, JobResults
from msg_analysis.sweeps.results import Picture, SweepVerdict, value_text
from msg_analysis.sweeps.results import Row as SweepRow

Row = TypeVar("Row")

MARGIN = 3  # of every column: padding, and the line of the box
LEAST_NAME = 12  # characters for names, however narrow the terminal is
_NUMBER = re.compile(r"[-+0-9.e%±<>∞… ]*(inf|nan)?")
ROWS = 30
"""Most rows of a table; --json has them all."""


def number_table(console: Console, title: str, first: str, *numbers: str) -> Table:
    """Print the heading, and make a table with one column of names and further ones of numbers."""
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(Text(first))
    for number in numbers:
        table.add_column(Text(number), justify="right")
    return table


def print_table(console: Console, table: Table) -> None:
    """Print a ``number_table``: a narrow terminal folds words and headings, but never numbers; a pipe nothing."""
    cells = [[str(column.header), *map(str, column.cells)] for column in table.columns]
    widest = _width(cells)
    if widest <= console.width or not console.is_terminal:
        print_wide(console, table, widest)
        return
    for column, (head, *texts) in zip(table.columns[1:], cells[1:], strict=True):
        parts = [part for cell in texts for part in ([cell] if _NUMBER.fullmatch(cell) else cell.split(" "))]
        column.min_width = max(map(cell_len, [*head.split(" "), *parts]), default=0)
        if all(map(_NUMBER.fullmatch, texts)):
            column.width = column.min_width
    least = 1 + sum(MARGIN + (column.min_width or 0) for column in table.columns[1:])
    print_wide(console, table, least + MARGIN + (table.columns[0].min_width or LEAST_NAME))


def print_rows(
    console: Console,
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    what: str = "",
    where: str = "--json",
) -> None:
    """Print a heading and a ``number_table`` of plain texts: all rows, or the first ones where they are called so."""
    table = number_table(console, title, *heads)
    for row in first_rows(table, rows, what, where) if what else rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    print_table(console, table)


def print_errors(
    console: Console,
    title: str,
    heads: Sequence[str],
    system: Sequence[str],
    agents: Iterable[Sequence[str]],
    names: Sequence[str] | None,
    last: Sequence[str] = (),
) -> None:
    """Print numbers of the system, then those of each agent; ``last``: a row below."""
    table = number_table(console, title, "", *heads)
    table.add_row("system", *system, end_section=True)
    for agent, cells in enumerate(first_rows(table, agents, "agents"), start=1):
        table.add_row(Text(agent_text(agent, names)), *cells)
    if last:
        table.add_section()
        table.add_row(*last)
    print_table(console, table)


def _width(columns: Iterable[Sequence[str]]) -> int:
    return 1 + sum(MARGIN + max(map(cell_len, cells)) for cells in columns)


def table_width(columns: Mapping[str, Sequence[str]]) -> int:
    """Width of a ``number_table`` with these headings and cells, if nothing is folded."""
    return _width([head, *cells] for head, cells in columns.items())


def that_fit(
    console: Console, columns: Mapping[str, Sequence[str]], optional: Sequence[str]
) -> dict[str, Sequence[str]]:
    """The columns without empty ones and, on a terminal that is too narrow, without optional ones, first ones first."""
    kept = {head: cells for head, cells in columns.items() if set(cells) != {"-"}}
    for head in optional if console.is_terminal else ():
        if table_width(kept) > console.width:
            kept.pop(head, None)
    return kept


def print_wide(console: Console, table: Table, least: int) -> None:
    """Print a table with at least this width, wider than the terminal if need be."""
    width = console.width
    console.width = max(width, least)
    console.print(table)
    console.width = width


def fact_table(console: Console, title: str) -> Table:
    """Print the heading, and make a table of names and values."""
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def first_rows(table: Table, rows: Iterable[Row], what: str, where: str = "--json") -> list[Row]:
    """The first ``ROWS`` rows for a table; a caption says how many (``what``) are left out, and where they are."""
    shown = list(rows)
    if len(shown) > ROWS:
        table.caption = f"{len(shown) - ROWS} more {what}: use {where}"
    return shown[:ROWS]


def interval_text(interval: Sequence[float | None] | None) -> str:
    """Low .. high; "-" if either is not known."""
    if not interval or None in interval:
        return "-"
    return f"{number_text(interval[0])} .. {number_text(interval[1])}"


def print_experiment(document: dict[str, Any], console: Console) -> None:
    """Print an experiment: a document of ``info.describe_experiment``."""
    run, names = document["run"], document.get("names")
    facts = fact_table(console, document["name"])
    facts.add_row("problem", f"{document['problem']} of {document['agents']} agents in {document['time']} time")
    if names:
        facts.add_row("agents", Text(listed(names)))
    if leaders := document["leaders"]:
        named = listed([agent_name(agent, names) for agent in leaders["agents"]])
        facts.add_row("leaders", Text(f"{named}, gain {leaders['gain']}, reference {leaders['reference']}"))
    _add_protocol(facts, document.get("protocol"))
    facts.add_row("noise", Text(_noise(document["noise"], names)))
    facts.add_row("steps", f"{run['steps']} of {number_text(run['dt'])}, {number_text(run['duration'])} units of time")
    facts.add_row("stability limit of dt", number_text(document["stability_limit"]))
    facts.add_row("replicas", str(run["replicas"]))
    facts.add_row("seed", str(run["seed"]))
    schedule, sojourn = (document["switching"].get(key) for key in ("schedule", "sojourn"))
    links = document["switching"].get("links")
    drawn = links or "activation" in document["switching"]
    first = document["graphs"][0]["name"] if schedule else document["switching"]["initial"]
    facts.add_row("start", _short(run["start"]) + ("" if drawn else f", first graph {first}"))
    if schedule:
        end = "with the run" if schedule["end"] is None else f"at {number_text(schedule['end'])}"
        then = ", then again" if schedule["repeat"] else ""
        facts.add_row("schedule", f"{counted(schedule['stretches'], 'graph')}, ends {end}{then}")
    if sojourn:
        shapes = ", ".join(f"{name} of shape {erlang['shape']}" for name, erlang in sojourn.items())
        facts.add_row("holding times", Text(f"Erlang: {shapes}"))
    facts.add_row("pace", f"{run['pace']}, processes {run['processes']}")
    facts.add_row("predicted system error", number_text(document["predicted_system_error"]))
    facts.add_row("prediction", _prediction(document["prediction"]))
    memory = document["memory"]
    facts.add_row("memory", f"states {amount(memory['states'])}, graphs {amount(memory['matrices'])}")
    facts.add_row("can be run", "yes" if not document["unavailable"] else "no")
    console.print(facts)
    graphs = number_table(console, "Graphs", "graph", "connectivity", "share", "held for", "dt limit")
    graphs.add_column("links", overflow="fold")
    keys = ("algebraic_connectivity", "stationary", "mean_holding_time", "stability_limit")
    for graph in first_rows(graphs, document["graphs"], "graphs"):
        graphs.add_row(Text(graph["name"]), *(number_text(graph[key]) for key in keys), Text(_links(graph, names)))
    console.print(graphs)
    if links:
        switching = [
            ((">" if link["directed"] else "-").join(agent_name(agent, names) for agent in link["agents"]), *numbers)
            for link in links
            for numbers in [[number_text(link[key]) for key in ("share", "up", "down")]]
        ]
        print_rows(
            console, "Links that switch by themselves", ["link", "share of time", "up", "down"], switching, "links"
        )
    title = "Switching rates" if document["time"] == "continuous" else "Switching probabilities"
    modes = [graph["name"] for graph in document["graphs"]]
    if 1 < len(modes) <= ROWS and not schedule:
        chain = number_table(console, title, "from / to", *modes)
        for name, row in zip(modes, document["switching"]["matrix"], strict=True):
            chain.add_row(Text(name), *map(number_text, row))
        console.print(chain)
    for line in document["unavailable"]:
        console.print(Text(line, style="yellow"))
    if document["predicted_system_error"]:
        console.print(f"Required length and detectable faults: msg-analysis plan {document['name']}", style="dim")


def gaps(count: dict[str, Any]) -> list[str]:
    """Gaps of a log and rejected messages, of ``completeness`` of a comparison; empty for a whole log."""
    lines = []
    if count["missing"]:
        first, last = count.get("stretch") or (None, None)
        if first is None:
            lines.append("No step has the states of all agents.")
        elif first == 0:
            lines.append(f"All steps up to step {last} are complete.")
        else:
            lines.append(
                f"The longest part without gaps is steps {first} to {last}; errors are computed only from step 0 on."
            )
    if count.get("refused"):
        reasons = ", ".join(f"{number} x {reason}" for reason, number in count["refused"].items())
        lines.append(f"Rejected messages: {reasons}")
    return lines


def _add_protocol(facts: Table, protocol: dict[str, Any] | None) -> None:
    if protocol is None:  # the built-in law
        return
    kind = "linear" if protocol["linear"] else "not linear, no prediction"
    facts.add_row("protocol", Text(f"{protocol['name']} of {protocol['package']} {protocol['version']}, {kind}"))
    for name, value in protocol["parameters"].items():
        facts.add_row("", Text(f"{name}: {_short(value)}"))
    if protocol["absent"]:
        facts.add_row("", Text(protocol["absent"], style="yellow"))


def _short(value: Any) -> str:
    """A number or word as it is, a list by its entries, a matrix by its size, a mapping entry by entry."""
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_short(item)}" for key, item in value.items())
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return f"matrix {len(value)} x {len(value[0])}"
        return f"[{listed(value)}]"
    return str(value)


def _noise(noise: dict[str, Any], names: Sequence[str] | None) -> str:
    """Every key with its value; what belongs to losses only where there are some."""
    shown = {key: _short(value) for key, value in noise.items() if noise["loss"] or key not in ("on_loss", "burst")}
    if isinstance(noise["loss"], dict):
        links = [
            (i, sign, j, p) for key, sign in (("edges", "-"), ("arcs", ">")) for i, j, p in noise["loss"].get(key, [])
        ]
        special = [f"{agent_name(i, names)}{sign}{agent_name(j, names)}: {p:g}" for i, sign, j, p in links]
        shown["loss"] = f"{noise['loss']['default']:g} ({listed(special)})"
    return ", ".join(f"{key} {value}" for key, value in shown.items())


def _prediction(found: dict[str, Any]) -> str:
    """How the steady errors are known, and why not exactly."""
    time = "" if found["seconds"] is None else f", to 1 % in about {duration_text(found['seconds'])}"
    return str(found["method"]) + time + (f": {found['why']}" if found["why"] else "")


def _links(graph: dict[str, Any], names: Sequence[str] | None) -> str:
    """``1-2, 2-3 (0.5)`` for edges, ``1>2`` for arcs (2 hears 1)."""
    sign, links = ("-", graph["edges"]) if graph["edges"] is not None else (">", graph["arcs"])
    ends = [(agent_name(i, names), agent_name(j, names), weight) for i, j, weight in links]
    return listed([f"{i}{sign}{j}" + (f" ({weight:g})" if weight != 1 else "") for i, j, weight in ends]) or "none"


_TOPICS = 12  # most topics listed; --json has all


def print_bag(document: dict[str, Any], console: Console) -> None:
    """Print what a bag holds: a document of ``describe_bag``."""
    facts = fact_table(console, document["bag"])
    if document["recording"]:
        facts.add_row("recording", f"process {document['recording']} is still writing it")
    _add_run(facts, document)
    topics = document["topics"]
    for topic in topics[:_TOPICS]:
        facts.add_row("topic", Text(f"{topic['name']}, {counted(topic['messages'], 'message')}, {topic['type']}"))
    if len(topics) > _TOPICS:
        more = sum(topic["messages"] for topic in topics[_TOPICS:])
        facts.add_row("topic", f"and {len(topics) - _TOPICS} more with {counted(more, 'message')}")
    for file in document["files"]:
        facts.add_row("file", Text(f"{file['name']}, {amount(file['size'])}{_state_of(file)}"))
    for name, version in document["versions"].items():
        facts.add_row(Text(name), Text(str(version)))
    console.print(facts)


def _add_run(facts: Table, document: dict[str, Any]) -> None:
    if document["problem"]:
        facts.add_row("not a run", Text(document["problem"], style="yellow"))
        return
    count = document["completeness"]
    facts.add_row("run", document["run"])
    facts.add_row("experiment", f"{document['experiment']}, seed {document['seed']}")
    _add_protocol(facts, document.get("protocol"))
    facts.add_row("agents, replicas", f"{document['agents']}, {document['replicas']}")
    facts.add_row("steps", f"{document['steps']}, {number_text(document['simulated_time'])} units of time")
    state = "complete" if count["complete"] else "incomplete"
    facts.add_row("states", f"{state}: {count['received']} of {count['expected']}, {count['missing']} missing")
    for line in gaps(count | {"refused": {}}):
        facts.add_row("", line)
    facts.add_row("duplicates, out of order", f"{count['duplicates']}, {count['out_of_order']}")
    facts.add_row("steps without a graph", str(count["missing_modes"]))
    for reason, number in count["refused"].items():
        facts.add_row("rejected", Text(f"{number}: {reason}"))


def _state_of(file: dict[str, Any]) -> str:
    """Text behind the size of a file: messages, compression, damage; "" for a file that is not part of the bag."""
    if "messages" not in file:
        return ""
    words = [counted(file["messages"], "message")]
    if file["compression"]:
        words.append("not compressed" if file["compression"] == "none" else str(file["compression"]))
    if file["torn"]:
        words.append(f"torn: {file['torn']}")
    if file["damaged_chunks"]:
        lost = f", {counted(file['lost_messages'], 'message')} lost" if file["lost_messages"] else ""
        words.append(f"{counted(file['damaged_chunks'], 'damaged chunk')}{lost}")
    if file["problem"]:
        words.append(file["problem"])
    return ": " + ", ".join(words)


def print_salvage(document: dict[str, Any], console: Console) -> None:
    """Print what was saved of a torn bag and what was dropped: a document of ``describe_salvage``."""
    facts = fact_table(console, document["bag"])
    facts.add_row("kept", counted(document["kept_messages"], "message"))
    dropped, size = [], document["dropped_bytes"]
    if size:
        dropped.append(f"{amount(size)} after the last complete record")
    if document["damaged_chunks"]:
        known = f" with {counted(document['lost_messages'], 'message')}" if document["lost_messages"] else ""
        dropped.append(f"{counted(document['damaged_chunks'], 'damaged chunk')}{known}")
    if document["dropped_files"]:
        dropped.append(counted(document["dropped_files"], "unreadable file"))
    facts.add_row("dropped", ", ".join(dropped) or "nothing")
    if document["torn"]:
        facts.add_row("torn", Text(document["torn"]))
    _add_run(facts, document)
    console.print(facts)


_STYLES = {"agrees": "green", "disagrees": "bold red", "late": "yellow", "incomplete": "yellow"}
_OPTIONAL = ("predicted", "z", "± (95 %)", "date (UTC)", "experiment")  # of runs, as in ``that_fit``


def print_runs(runs: Sequence[RunEntry], folder: Path, total: int, console: Console) -> None:
    """Print the runs, one line each, of ``total`` in the folder; names, which other commands take, are never cut."""
    if not runs:
        console.print(Text(f"{folder}: no run" if not total else f"{folder}: none of {counted(total, 'run')}"))
        return
    heads = ["run", "experiment", "date (UTC)", "seed", "verdict", "system error", "± (95 %)", "predicted", "z"]
    rows = [
        [
            Path(run.folder).name,
            run.name or "-",
            f"{run.date:%Y-%m-%d %H:%M}",
            "-" if run.seed is None else str(run.seed),
            (run.verdict or run.status) + ("" if run.prediction is None else f"; prediction {run.prediction}"),
            number_text(run.measured),
            half_width_text((run.low, run.high)),
            number_text(run.predicted),
            z_text(run.z),
        ]
        for run in runs
    ]
    columns = dict(zip(heads, zip(*rows, strict=True), strict=True))
    if all(Path(run.folder).name.startswith(f"{run.name}_{run.date:%Y%m%d_%H%M}") for run in runs):
        del columns["experiment"], columns["date (UTC)"]  # the names of the folders have them
    shown = that_fit(console, columns, _OPTIONAL)
    table = number_table(console, f"Runs in {folder}", *shown)
    for run, cells in zip(runs, zip(*shown.values(), strict=True), strict=True):
        styles = {"verdict": _STYLES.get(run.verdict or "", "dim" if run.verdict is None else "")}
        table.add_row(*(Text(cell, styles.get(head, "")) for head, cell in zip(shown, cells, strict=True)))
    print_wide(console, table, table_width(shown))
    counts = Counter(run.verdict or run.status for run in runs)
    number = f"{counted(len(runs), 'run')}{f' of {total}' if len(runs) < total else ''}"
    console.print(Text(f"{number}: {', '.join(f'{count} {word}' for word, count in counts.most_common())}"))
    for run in runs:
        if run.status == "damaged" and run.problem:
            console.print(Text(f"damaged: {run.problem}", style="yellow"))


def describe_sweep(
    sweep: SweepGrid, done: JobResults, judgement: SweepVerdict, rows: Sequence[SweepRow]
) -> dict[str, Any]:
    """The document of ``msg-analysis sweep --json``, without the names of the files; ``rows`` of ``rows_of``."""
    failed = sum(outcome.status == FAILED for outcome in done.outcomes)
    return {
        "sweep": sweep.name,
        "experiment": sweep.experiment,
        "kind": sweep.kind,
        "keys": list(sweep.keys),
        "level": sweep.spec.level,
        "verdict": judgement.verdict,
        "done": len(rows) - failed,
        "failed": failed,
        "kept": done.reused,
        "points": list(rows),
    }


def print_sweep(sweep: SweepGrid, document: dict[str, Any], picture: Picture, console: Console) -> None:
    """Print a table of what the figure shows, what failed, and the verdict; ``document`` of ``describe_sweep``."""
    heads = ["measured", "predicted"] if picture.measured else [picture.y, "in continuous time"]
    if picture.intervals:
        heads.insert(1, "± (95 %)")
    several = len(picture.series) > 1
    heads = [*([""] if several else []), picture.x, *heads]
    rows = []
    for label, place in ((series.label, place) for series in picture.series for place in series.places):
        numbers = [number_text(place.value), number_text(place.predicted if picture.measured else place.reference)]
        if picture.intervals:
            numbers.insert(1, half_width_text((place.low, place.high)))
        rows.append([*([label] if several else []), value_text(place.x), *numbers])
    print_rows(console, f"{sweep.name}: {picture.y}", heads, rows, "rows")
    for row in [row for row in document["points"] if row["status"] == FAILED][:ROWS]:
        console.print(Text(f"point {row['point']}: no result: {row['reason']}"))
    for row in [row for row in document["points"] if row.get("verdict") == "disagrees"][:ROWS]:
        why = row.get("causes") or row.get("least")
        console.print(
            Text(f"point {row['point']} disagrees with its prediction (p = {p_text(row['p_adjusted'])}): {why}")
        )
    console.print(Text(summary(document)))


def summary(document: dict[str, Any]) -> str:
    """How many points, and what came of them; ``document`` of ``describe_sweep``."""
    count = len(document["points"])
    what = {"predict": "predictions", "simulate": "runs simulated", "network": "networks run"}[document["kind"]]
    text = f"{count} {what}"
    if document["kept"]:
        text += f", {document['kept']} of them from an earlier sweep"
    if document["failed"]:
        text += f"; {document['failed']} without a result"
    tested = [row["p_adjusted"] for row in document["points"] if row.get("p_adjusted") is not None]
    if tested:
        apart = sum(row.get("verdict") == "disagrees" for row in document["points"])
        text += f". {apart or 'None'} of {len(tested)} {'disagree' if apart > 1 else 'disagrees'} with its prediction"
        text += f" (Holm over all points, level {document['level']:g}; smallest p {min(tested):.3g})"
    return text + "."
