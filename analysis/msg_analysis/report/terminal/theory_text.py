"""Transients and facts as terminal tables. Every function takes the document that ``--json`` prints."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.report.terminal.tables import fact_table, number_table, number_text

_ROWS = 40
_LAWS = {"continuous": "continuous time", "emulated": "steps of the run", "discrete": "discrete time"}


def print_transient(document: dict[str, Any], console: Console) -> None:
    """Print the system error over time with the law of the graph; settling time and rates."""
    key = "system_second_moment" if document["unreduced"] else "system_error"
    title = f"Transient from the start of the run, {_LAWS[document['law']]}"
    columns = [key.replace("_", " ")]
    few = len(document["modes"]) <= 6
    if few:
        columns += [f"in {name}" for name in document["modes"]]
    table = number_table(console, title, "time", *columns)
    rows = list(zip(document["times"], document[key], document["graph_law"], strict=True))
    for time, error, law in rows[:_ROWS]:
        table.add_row(number_text(time), number_text(error), *map(number_text, law if few else []))
    if len(rows) > _ROWS:
        table.caption = f"{len(rows) - _ROWS} more times: use --json or --csv"
    console.print(table)
    settling, rates = document["settling"], document["rates"]
    share = f"{100 * settling['fraction']:g} %"
    facts = fact_table(console, "In the end")
    facts.add_row("system error in the steady state", number_text(document["steady_system_error"]))
    facts.add_row(f"within {share} of it after, from this start", number_text(settling["from_start"]))
    facts.add_row(f"within {share} of it after, from zero", number_text(settling["from_zero"]))
    facts.add_row("decay rate of means", number_text(rates["mean"]))
    facts.add_row("decay rate of second moments", number_text(rates["second_moment"]))
    facts.add_row("decay rate of the law of the graph", number_text(rates["graph"]))
    console.print(facts)


def print_facts(document: dict[str, Any], console: Console) -> None:
    """Print the lemmas, the bounds, the indices of the graphs, and the closed form of two graphs."""
    if document["facts"]:
        _print_lemmas(document["facts"], console)
    bounds = document["bounds"]
    if bounds["lower"] is None and bounds["upper"] is None:
        console.print(Text(f"No bounds of the system error: {bounds['note']}", style="dim"))
    else:
        console.print(Text("Bounds of the system error, whatever the rates", style="bold"))
        console.print(
            Text(f"  {number_text(bounds['lower'])} <= E <= {number_text(bounds['upper'])}   ({bounds['note']})")
        )
    _print_graphs(document, console)
    for law, form in (document["two_topology"] or {}).items():
        _print_form(law, form, console)
    for note in document["notes"]:
        console.print(Text(note, style="yellow"))


def _print_lemmas(facts: list[dict[str, Any]], console: Console) -> None:
    table = number_table(console, "Eigenvalues of the paper's matrices", "matrix")
    table.add_column("lemma, corrected", overflow="fold")
    for heading in ("at it", "others", ""):
        table.add_column(heading, justify="right")
    for fact in facts:
        holds = Text("holds", style="green") if fact["holds"] else Text("does not hold", style="bold red")
        table.add_row(fact["name"], fact["statement"], str(fact["multiplicity"]), number_text(fact["others"]), holds)
    console.print(table)


def _print_graphs(document: dict[str, Any], console: Console) -> None:
    shown = [entry for entry in document["graphs"] if entry]
    if not shown:
        return
    table = number_table(console, "Undirected connected graphs", "graph")
    table.add_column("Kirchhoff index", justify="right")
    table.add_column("information centrality of agents 1, 2, ...", overflow="fold")
    for entry in shown:
        centrality = entry["information_centrality"]
        values = ", ".join(map(number_text, centrality[:12])) + (", ..." if len(centrality) > 12 else "")
        table.add_row(Text(entry["name"]), number_text(entry["kirchhoff_index"]), values)
    console.print(table)


def _print_form(law: str, form: dict[str, Any], console: Console) -> None:
    title = f"Two graphs in closed form, {_LAWS[law]}, beta = {number_text(form['rate'])}"
    table = number_table(console, title, "", "static", "switching adds", "error", "fastest adds")
    keys = ("static", "switching", "error", "fast")
    table.add_row("system", *(number_text(form["system"][key]) for key in keys), end_section=True)
    rows = [
        # Rounding errors, for agents for which nothing changes.
        [0.0 if abs(value) < 1e-14 * abs(row[0]) else value for value in row]
        for row in zip(*(form["nodes"][key] for key in keys), strict=True)
    ]
    for agent, row in enumerate(rows[:_ROWS], start=1):
        table.add_row(f"agent {agent}", *map(number_text, row))
    if len(rows) > _ROWS:
        table.caption = f"{len(rows) - _ROWS} more agents: use --json"
    console.print(table)
