"""Results as terminal tables. Every function takes the document that ``--json`` prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.number_words import percent
from msg_analysis.model.experiment.memory import amount
from msg_analysis.report.terminal.tables import (
    ROWS,
    fact_table,
    interval_text,
    note_cut,
    number_table,
    number_text,
    p_text,
    z_text,
)
from msg_analysis.report.terminal.verdict_text import print_bags, print_blame, print_order

_LAWS = {
    "continuous": "continuous time",
    "emulated": "steps of the run",
    "discrete": "discrete time",
    "static": "graphs held for ever",
}
_VERDICTS = {
    "agrees": ("The run agrees with the prediction.", "bold green"),
    "disagrees": ("The run disagrees with the prediction.", "bold red"),
    "incomplete": ("No verdict: the data are incomplete.", "bold yellow"),
    "unpredicted": ("No verdict: there is no prediction. What was to be tested passed.", "bold"),
}

TIMES = {
    "lateness_ms": "late by [ms]",
    "jitter_ms": "period off by [ms]",
    "staleness_ms": "age of the values used [ms]",
    "staleness_steps": "age of the values used [steps]",
}
QUANTILES = ("p50", "p95", "p99", "max")
LAWS = {"pattern": "logged pattern", "sequential": "sequential", "continuous": "continuous time"}
SUPPORT = {True: "supported", False: "not supported", None: "not decided"}

_METHODS = {
    "exhaustive": "trying every set",
    "greedy": "greedy choice",
    "swap": "greedy choice and exchanges",
}


def print_prediction(document: dict[str, Any], console: Console) -> None:
    """Print the steady errors of every predicted law, and the share of time of every graph."""
    laws = {
        "steps in turn" if document[key].get("law") == "sequential" else title: document[key]
        for key, title in _LAWS.items()
        if document.get(key) is not None
    }
    errors = number_table(console, "Mean-square error in the steady state", "", *laws)
    errors.add_row("system", *(number_text(law["system_error"]) for law in laws.values()), end_section=True)
    for agent in range(min(document["agents"], ROWS)):
        errors.add_row(f"agent {agent + 1}", *(number_text(law["node_errors"][agent]) for law in laws.values()))
    note_cut(errors, document["agents"], "agents")
    errors.add_section()
    errors.add_row("certainty", *(number_text(law["system_certainty"]) for law in laws.values()))
    console.print(errors)
    modes = number_table(console, "Graphs", "graph", "share of time")
    for name, share in zip(document["modes"], document["stationary"], strict=True):
        modes.add_row(Text(name), number_text(share))
    console.print(modes)
    for key, title in _LAWS.items():
        if key in document and document[key] is None:
            console.print(f"{title}: not finite, or not defined with this noise", style="dim")


def print_comparison(document: dict[str, Any], console: Console) -> None:
    """Print verdict, errors measured and predicted, tests and what is missing; a run's ``strangers``, if any."""
    verdict, style = _VERDICTS[document["verdict"]]
    console.print(verdict_line(verdict, document), style=style)
    count = document["completeness"]
    console.print(
        f"{count['received']} of {count['expected']} states in {document['steps']} steps "
        f"({number_text(document['simulated_time'])} units of time): {count['missing']} missing, "
        f"{count['duplicates']} twice, {count['out_of_order']} out of order"
    )
    for line in gaps(count):
        console.print(Text(line))
    if document.get("unpredicted"):
        console.print(Text(f"Unpredicted: {document['unpredicted']}."))
    if document.get("transient"):
        console.print(f"The first {document['transient']} steps, a transient, are left out of the errors.")
    print_blame(document, console)
    print_bags(document, console)
    _print_errors(document, console)
    _print_tests(document, console)
    print_order(document, console)
    loss = document.get("loss") or {}
    if loss.get("lost") is not None:
        console.print(f"{loss['lost']} messages lost, {loss['expected']:.6g} expected")
    _print_timing(document, console)
    _print_strangers(document.get("strangers") or [], console)
    interval = document["batch_means"]["interval"]
    console.print(f"95 % interval of batch means, free of the model: {interval_text(interval)}", style="dim")
    continuous = document["continuous"]["system_error"]
    if continuous is not None and not document.get("laws"):
        console.print(f"System error in continuous time, for reference: {number_text(continuous)}", style="dim")


def gaps(count: dict[str, Any]) -> list[str]:
    """Where the gaps of a log are, and what was refused, of ``completeness`` of a comparison; empty for a whole log."""
    lines = []
    if count["missing"]:
        first, last = count.get("stretch") or (None, None)
        if first is None:
            lines.append("No step has the states of all agents.")
        elif first == 0:
            lines.append(f"All states are there up to step {last}.")
        else:
            lines.append(
                f"The longest stretch without a gap is that of steps {first} to {last}; numbers need one from step 0."
            )
    if count.get("refused"):
        reasons = ", ".join(f"{number} x {reason}" for reason, number in count["refused"].items())
        lines.append(f"Refused: {reasons}")
    return lines


def _print_strangers(strangers: Sequence[dict[str, Any]], console: Console) -> None:
    if not strangers:
        return
    console.print(Text("Messages that the nodes refused", style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("node", "topic", "reason"):
        table.add_column(heading, overflow="fold")
    table.add_column("number", justify="right")
    for entry in strangers[:ROWS]:
        table.add_row(*(Text(str(entry[key])) for key in ("node", "topic", "reason", "count")))
    note_cut(table, len(strangers), "kinds")
    console.print(table)


def _print_errors(document: dict[str, Any], console: Console) -> None:
    columns = ("measured", "95 % interval", "predicted", "z")
    table = number_table(console, "Mean-square error over the run", "", *columns)

    def row(label: str, entry: dict[str, Any] | None, end_section: bool = False) -> None:
        entry = entry or {}
        measured, predicted = number_text(entry.get("measured")), number_text(entry.get("predicted"))
        table.add_row(
            label,
            measured,
            interval_text(entry.get("interval")),
            predicted,
            z_text(entry.get("z")),
            end_section=end_section,
        )

    given = document.get("given_path")
    row("system", document["system_error"], end_section=not given)
    if given:
        row("system, corrected for the path of the graphs", given["system_error"], end_section=True)
    nodes = document["node_errors"] or []
    for agent, entry in enumerate(nodes[:ROWS], start=1):
        row(f"agent {agent}", entry)
    note_cut(table, len(nodes), "agents")
    console.print(table)


def verdict_line(verdict: str, document: dict[str, Any]) -> str:
    """The verdict on one run or several; in real time with missed deadlines, which are not a disagreement."""
    if document.get("bags"):
        verdict = verdict.replace("The run agrees", "The runs agree").replace("The run disagrees", "The runs disagree")
    deadlines = (document.get("timing") or {}).get("deadlines")
    if not deadlines or not deadlines["missed"]:
        return verdict
    share = percent(deadlines["share"])
    return f"{verdict.removesuffix('.')}; {share} of the deadlines were missed."


def _print_timing(document: dict[str, Any], console: Console) -> None:
    """How well a run in real time kept its time, and which laws it supports."""
    timing, laws = document.get("timing"), document.get("laws")
    if not timing or not laws:
        return
    table = number_table(console, "Timing", "", "half below", "95 % below", "99 % below", "largest")
    for key, title in TIMES.items():
        values = timing[key]
        table.add_row(Text(title), *(f"{values[q]:.3g}" if values[q] is not None else "-" for q in QUANTILES))
    console.print(table)
    facts = fact_table(console, "Real time")
    for title, text in timing_facts(timing):
        facts.add_row(title, text)
    console.print(facts)
    table = number_table(console, "Laws", "system error", "predicted", "z", "")
    for key, title in LAWS.items():
        law = laws[key]
        error = law["system_error"]
        table.add_row(title, number_text(error["predicted"]), z_text(error["z"]), Text(SUPPORT[law["supported"]]))
    console.print(table)
    console.print(Text(laws["why"]))


def timing_facts(timing: dict[str, Any]) -> list[tuple[str, str]]:
    """Counts of a run in real time, ``timing`` of a comparison: what was counted, and the numbers."""
    deadlines, uses, graphs = timing["deadlines"], timing["ideal_uses"], timing["outdated_graph"]
    facts = [
        ("period", f"{number_text(timing['period_ms'])} ms"),
        ("deadlines missed", f"{deadlines['missed']} of {deadlines['steps']} ({percent(deadlines['share'])})"),
        ("values used as with ideal timers", f"{uses['ideal']} of {uses['uses']} ({percent(uses['share'])})"),
        ("steps with an outdated graph", f"{graphs['steps']} of {deadlines['steps']} ({percent(graphs['share'])})"),
    ]
    if timing["never_heard"]:
        facts.append(("uses of neighbours not heard of yet", str(timing["never_heard"])))
    return facts


def _print_tests(document: dict[str, Any], console: Console) -> None:
    tests = document.get("tests") or []
    if not tests:
        return
    title = f"Tests, together at level {number_text(document.get('level'))}"
    table = number_table(console, title, "test", "p", "p adjusted", "")
    # Rejected tests first: with many agents the table is cut.
    shown = [test for test in tests if test["rejected"]] + [test for test in tests if not test["rejected"]]
    for test in shown[:ROWS]:
        table.add_row(Text(str(test["name"])), p_text(test["p"]), p_text(test["p_adjusted"]), _mark(test))
    note_cut(table, len(shown), "tests")
    console.print(table)


def print_experiment(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``msg_analysis.report.documents.info.describe_experiment``."""
    run = document["run"]
    facts = fact_table(console, document["name"])
    facts.add_row("problem", f"{document['problem']} of {document['agents']} agents in {document['time']} time")
    if document["leaders"]:
        leaders = document["leaders"]
        text = f"{_names(leaders['agents'])}, gain {leaders['gain']}, reference {leaders['reference']}"
        facts.add_row("leaders", text)
    add_protocol(facts, document.get("protocol"))
    facts.add_row("noise", ", ".join(f"{key} {_short(value)}" for key, value in document["noise"].items()))
    facts.add_row("steps", f"{run['steps']} of {number_text(run['dt'])}, {number_text(run['duration'])} units of time")
    facts.add_row("stability limit of a step", number_text(document["stability_limit"]))
    facts.add_row("copies (replicas)", str(run["replicas"]))
    facts.add_row("seed", str(run["seed"]))
    facts.add_row("start", f"{_short(run['start'])}, first graph {document['switching']['initial']}")
    facts.add_row("pace", f"{run['pace']}, processes {run['processes']}")
    facts.add_row("predicted system error", number_text(document["predicted_system_error"]))
    memory = document["memory"]
    facts.add_row("memory", f"states {amount(memory['states'])}, graphs {amount(memory['matrices'])}")
    facts.add_row("can be run by this version", "yes" if not document["unavailable"] else "no")
    console.print(facts)
    columns = ("connectivity", "share", "held for", "dt below")
    graphs = number_table(console, "Graphs", "graph", *columns)
    graphs.add_column("links", overflow="fold")
    for graph in document["graphs"]:
        graphs.add_row(
            Text(graph["name"]),
            number_text(graph["algebraic_connectivity"]),
            number_text(graph["stationary"]),
            number_text(graph["mean_holding_time"]),
            number_text(graph["stability_limit"]),
            _links(graph),
        )
    console.print(graphs)
    switching = document["switching"]
    title = "Rates from graph to graph" if document["time"] == "continuous" else "Probabilities from graph to graph"
    names = [graph["name"] for graph in document["graphs"]]
    if 1 < len(names) <= ROWS:
        chain = number_table(console, title, "from / to", *names)
        for name, row in zip(names, switching["matrix"], strict=True):
            chain.add_row(Text(name), *map(number_text, row))
        console.print(chain)
    for line in document["unavailable"]:
        console.print(Text(line, style="yellow"))


def add_protocol(facts: Table, protocol: dict[str, Any] | None) -> None:
    """Add rows for the protocol of a document of ``report.info``; none for the built-in law (None)."""
    if protocol is None:
        return
    kind = "linear" if protocol["linear"] else "not linear, no prediction"
    facts.add_row("protocol", Text(f"{protocol['name']} of {protocol['package']} {protocol['version']}, {kind}"))
    for name, value in protocol["parameters"].items():
        facts.add_row("", Text(f"{name}: {_short(value)}"))
    if protocol["absent"]:
        facts.add_row("", Text(protocol["absent"], style="yellow"))


def print_leaders(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``Selection.to_json()``: the best sets of leaders, and how good the first is."""
    gain = "held at the reference" if document["gain"] == "inf" else f"gain {document['gain']:g}"
    law = _LAWS[document["law"]]
    what = "Single leaders" if document["count"] == 1 else f"Sets of {document['count']} leaders"
    title = f"{what}, {gain}, {law}"
    centrality = "joint centrality" if document["gain"] == "inf" else "certainty"
    table = number_table(console, title, "agents", "system error", centrality)
    for entry in document["sets"][:ROWS]:
        row = (_names(entry["agents"]), number_text(entry["system_error"]), number_text(entry["joint_centrality"]))
        table.add_row(*row)
    note_cut(table, len(document["sets"]), "sets")
    console.print(table)
    facts = fact_table(console, f"Found by {_METHODS[document['method']]}")
    facts.add_row("system errors computed", str(document["evaluations"]))
    bound, gap = document["bound"]["system_error"], document["bound"]["gap"]
    if gap is not None and gap < 1e-8:
        facts.add_row("guarantee", "the best set there is")
    elif bound is not None:
        above = "" if gap is None else f": this one is at most {100 * gap:.3g} % above the best"
        facts.add_row("guarantee", f"no set has less than {number_text(bound)}{above}")
    else:
        facts.add_row("guarantee", f"none: {document['note']}")
    console.print(facts)


def _mark(test: dict[str, Any]) -> Text:
    if test["p"] is None:
        return Text("not done", style="dim")
    return Text("rejected", style="bold red") if test["rejected"] else Text("passed", style="green")


def _short(value: Any) -> str:
    """A number or word as it is, a list by its entries, a matrix by its size, a mapping entry by entry."""
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_short(item)}" for key, item in value.items())
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return f"matrix {len(value)} x {len(value[0])}"
        return f"[{_names(value)}]"
    return str(value)


def _names(values: Sequence[Any], longest: int = 12) -> str:
    shown = ", ".join(str(value) for value in values[:longest])
    return shown + (f", and {len(values) - longest} more" if len(values) > longest else "")


def _links(graph: dict[str, Any]) -> str:
    """``1-2, 2-3 (0.5)`` for edges, ``1>2`` for arcs (2 hears 1)."""
    sign, links = ("-", graph["edges"]) if graph["edges"] is not None else (">", graph["arcs"])
    return _names([f"{i}{sign}{j}" + (f" ({weight:g})" if weight != 1 else "") for i, j, weight in links]) or "none"
