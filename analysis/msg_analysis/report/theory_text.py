# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Predictions, leaders, transients, facts, plans and spectra as terminal tables, from the documents of ``--json``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.common.text import (
    agent_name,
    agent_text,
    counted,
    duration_text,
    listed,
    number_text,
    p_text,
    percent,
    z_text,
)
from msg_analysis.report.tables import fact_table, interval_text, number_table, print_errors, print_rows, print_table
from msg_analysis.theory.prediction import LAW_NAMES

_METHODS = {"exhaustive": "exhaustive search", "greedy": "greedy selection", "swap": "greedy selection with exchanges"}


def print_prediction(document: dict[str, Any], console: Console) -> None:
    """Print the steady errors of every predicted law, and the share of time of every graph."""
    steps = document.get("emulated") or document["discrete"]
    if steps.get("method") == "sampled":
        _print_sampled(document, steps, console)
        return
    laws = {
        LAW_NAMES["sequential"] if document[key].get("law") == "sequential" else LAW_NAMES[key]: document[key]
        for key in LAW_NAMES
        if document.get(key) is not None
    }
    system, certainty = (
        [number_text(law[key]) for law in laws.values()] for key in ("system_error", "system_certainty")
    )
    agents = (list(map(number_text, row)) for row in zip(*(law["node_errors"] for law in laws.values()), strict=True))
    scheduled = "largest" in steps
    title = (
        "Mean-square error over the given sequence of graphs" if scheduled else "Mean-square error in the steady state"
    )
    print_errors(console, title, list(laws), system, agents, document.get("names"), ["certainty", *certainty])
    shares = [(name, number_text(share)) for name, share in zip(document["modes"], document["stationary"], strict=True)]
    print_rows(console, "Graphs", ["graph", "share of time"], shares, "graphs")
    if scheduled:
        worst = f"largest system error: {number_text(steps['largest'])} at time {number_text(steps['largest_time'])}"
        console.print(worst.capitalize())
        if found := document.get("outages"):
            _print_outages(found, console)
        return
    for key, title in LAW_NAMES.items():
        if key in document and document[key] is None:
            why, apart = "not defined with this noise", document.get("disconnected")
            if key == "static" and apart and document.get("continuous"):
                do = "does" if len(apart) == 1 else "do"
                why = f"infinite, since {listed(apart)} alone {do} not connect all agents"
            console.print(Text(f"{title.capitalize()}: {why}"), style="dim")
    if LAW_NAMES["sequential"] in laws:
        console.print("Sequential steps: in real time, if no step is late and every message arrives at once.")
    for line in tails_words(document):
        console.print(Text(line, style="yellow"))


def _print_outages(found: dict[str, Any], console: Console) -> None:
    """What the longest outages cost."""
    rows = [
        (*(number_text(each[key]) for key in ("start", "end")), str(each["parts"]), number_text(each["adds"]))
        for each in found["longest"]
    ]
    if rows:
        print_rows(console, "Longest outages", ("from", "to", "parts", "adds to the mean error"), rows)
        without = f"without {'this' if len(rows) == 1 else 'these'}: {number_text(found['error_without'])}"
        console.print(f"{counted(found['count'], 'outage')}; mean system error {without}")


def _print_sampled(document: dict[str, Any], law: dict[str, Any], console: Console) -> None:
    """Print sampled errors with their intervals."""
    rows = [("system", number_text(law["system_error"]), interval_text(law["interval"]))]
    for agent, (error, interval) in enumerate(zip(law["node_errors"], law["node_intervals"], strict=True), start=1):
        if error is not None:
            rows.append((agent_text(agent, document["names"]), number_text(error), interval_text(interval)))
    title = f"Mean-square error in the steady state, {LAW_NAMES['emulated']}, sampled"
    print_rows(console, title, ["", "error", "95 % interval"], rows, "agents")
    shares = [(name, number_text(share)) for name, share in zip(document["modes"], document["stationary"], strict=True)]
    print_rows(console, "Graphs", ["graph", "share of time"], shares)
    console.print(
        f"{law['paths']} samples in {number_text(law['seconds'], 2)} s: --precision and --within say how many"
    )


def tails_words(document: dict[str, Any]) -> list[str]:
    """What follows from the fourth moments of a prediction, in sentences; empty where they are finite."""
    fourth = document["fourth_moment"]
    if fourth["finite"]:
        return []
    what = "Whether the fourth moments of the states are finite is not known"
    if fourth["finite"] is False:
        grow = number_text(fourth["lower"], 3)
        least = "" if fourth["radius"] is not None else "at least "
        what = f"The fourth moments of the states are infinite: they grow {least}{grow} times per step"
    return [
        f"{what}. Then most runs measure less than these errors, which rare large values make, and a run's errors over "
        "all paths of the graphs have no standard error. A smaller run.dt helps."
    ]


def _named(entry: dict[str, Any], document: dict[str, Any]) -> str:
    return listed([agent_name(agent, document.get("names")) for agent in entry["agents"]])


def print_leaders(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``Selection.to_json()``: the best sets of leaders, and how good the first is."""
    gain = "held at the reference" if document["gain"] == "inf" else f"gain {document['gain']:g}"
    law = LAW_NAMES[document["law"]]
    what = "Single leaders" if document["count"] == 1 else f"Sets of {document['count']} leaders"
    heads = ["agents", "system error", "joint centrality" if document["gain"] == "inf" else "certainty"]
    rows = [
        (_named(entry, document), number_text(entry["system_error"]), number_text(entry["joint_centrality"]))
        for entry in document["sets"]
    ]
    print_rows(console, f"{what}, {gain}, {law}", heads, rows, "sets")
    facts = fact_table(console, f"Method: {_METHODS[document['method']]}")
    facts.add_row("system errors computed", str(document["evaluations"]))
    bound, gap = document["bound"]["system_error"], document["bound"]["gap"]
    if gap is not None and gap < 1e-8:
        facts.add_row("guarantee", "no better set exists")
    elif bound is not None:
        above = "" if gap is None else f": this one is at most {100 * gap:.3g} % above the best"
        facts.add_row("guarantee", f"every set has at least {number_text(bound)}{above}")
    else:
        facts.add_row("guarantee", f"none: {document['note']}")
    if present := document["present"]:
        facts.add_row(Text(f"leaders now: {_named(present, document)}"), number_text(present["system_error"]))
    console.print(facts)


def print_transient(document: dict[str, Any], console: Console) -> None:
    """Print the system error over time with the law of the graph; settling time and rates."""
    key = "system_second_moment" if document["unreduced"] else "system_error"
    title = f"Transient from the start of the run, {LAW_NAMES[document['law']]}"
    few = len(document["modes"]) <= 6
    heads = ["time", key.replace("_", " "), *(f"P({name})" for name in document["modes"] if few)]
    found = zip(document["times"], document[key], document["graph_law"], strict=True)
    rows = [list(map(number_text, (time, error, *(law if few else ())))) for time, error, law in found]
    print_rows(console, title, heads, rows, "times", "--json or --csv")
    settling, rates = document["settling"], document["rates"]
    if settling is None:  # of a given sequence of graphs
        return
    share = f"{100 * settling['fraction']:g} %"
    facts = fact_table(console, "Steady state and rates")
    facts.add_row("system error in the steady state", number_text(document["steady_system_error"]))
    facts.add_row(f"settling time ({share}), from this start", number_text(settling["from_start"]))
    facts.add_row(f"settling time ({share}), from zero", number_text(settling["from_zero"]))
    for key, what in {"mean": "means", "second_moment": "second moments", "graph": "graph probabilities"}.items():
        facts.add_row(f"decay rate of {what}", number_text(rates[key]))
    console.print(facts)
    for note in document["notes"]:
        console.print(Text(f"Note: {note}", style="yellow"))


def print_facts(document: dict[str, Any], console: Console) -> None:
    """Print the lemmas, the bounds, the indices of the graphs, and the closed form of two graphs."""
    if document["facts"]:
        _print_lemmas(document["facts"], console)
    bounds = document["bounds"]
    if bounds["lower"] is None and bounds["upper"] is None:
        console.print(Text(f"No bounds of the system error: {bounds['note']}", style="dim"))
    else:
        lower, upper = number_text(bounds["lower"]), number_text(bounds["upper"])
        console.print(Text("Bounds of the system error for all switching rates", style="bold"))
        console.print(Text(f"  {lower} <= E <= {upper}   ({bounds['note']})"))
    if shown := [entry for entry in document["graphs"] if entry]:
        table = number_table(console, "Undirected connected graphs", "graph", "Kirchhoff index")
        first = ", ".join(agent_name(agent, document.get("names")) for agent in (1, 2))
        table.add_column(Text(f"information centrality of agents {first}, ..."), overflow="fold")
        for entry in shown:
            values = listed([number_text(value) for value in entry["information_centrality"]])
            table.add_row(Text(entry["name"]), number_text(entry["kirchhoff_index"]), values)
        print_table(console, table)
    for law, form in (document["two_topology"] or {}).items():
        _print_form(law, form, document.get("names"), console)
    for note in document["notes"]:
        console.print(Text(note, style="yellow"))


def _print_lemmas(facts: list[dict[str, Any]], console: Console) -> None:
    table = number_table(console, "Eigenvalues of the paper's matrices", "matrix")
    table.add_column("lemma (corrected)", overflow="fold")
    for heading in ("count", "others", ""):
        table.add_column(heading, justify="right")
    for fact in facts:
        holds = Text("holds", style="green") if fact["holds"] else Text("does not hold", style="bold red")
        table.add_row(fact["name"], fact["statement"], str(fact["multiplicity"]), number_text(fact["others"]), holds)
    print_table(console, table)


def _print_form(law: str, form: dict[str, Any], names: Sequence[str] | None, console: Console) -> None:
    title = f"Two graphs in closed form, {LAW_NAMES[law]}, beta = {number_text(form['rate'])}"
    keys = ("static", "switching", "error", "fast")
    rows = [
        # Rounding errors, for agents for which nothing changes.
        [number_text(0.0 if abs(value) < 1e-14 * abs(row[0]) else value) for value in row]
        for row in zip(*(form["nodes"][key] for key in keys), strict=True)
    ]
    heads = ("static", "switching adds", "error", "fastest adds")
    print_errors(console, title, heads, [number_text(form["system"][key]) for key in keys], rows, names)


def print_plan(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``RunPlan.to_json()``: the run of the file, lengths for the precision, power for faults."""
    rate, sought = document["rate"], percent(document["precision"])
    console.print(Text(_answer(document), style="bold"))
    facts = fact_table(console, f"Plan of {document['experiment']}")
    facts.add_row("predicted system error", number_text(document["system_error"]))
    facts.add_row("as configured", _run_text(document["file"]))
    if budget := document["budget"]:
        facts.add_row(f"best run in {duration_text(budget['time'])}", _run_text(budget))
    if document["warm_up"]:
        facts.add_row("warm-up", f"{document['warm_up']} steps, in every length below")
    speed = f"{number_text(rate)} steps per second" if rate else "not known: --speed gives the wall time"
    facts.add_row("speed", speed)
    console.print(facts)
    title = f"Run length for ± {sought} (95 %): evaluated once at the end, or monitored throughout"
    heads = ("steps", "duration", "wall time", "steps, monitored", "wall time, monitored")
    table = number_table(console, title, "replicas", *heads)
    table.columns[0].justify = "right"
    for row in document["lengths"]:
        once = (_count(row["steps"]), number_text(row["duration"]), _time(row["wall_time"]))
        table.add_row(str(row["replicas"]), *once, _count(row["any_time_steps"]), _time(row["any_time_wall_time"]))
    print_table(console, table)
    steps = document["file"]["steps"]
    title = f"Detectable faults: power of the tests in {steps} steps, false-alarm rate {percent(document['level'])}"
    rows = [
        (row["fault"], percent(row["power"]), _count(row["steps"]), _count(row["any_time_steps"]))
        for row in document["faults"]
    ]
    if rows:
        print_rows(console, title, ("fault", "power", "steps for 99 %", "steps, monitored"), rows)
    for note in document["notes"]:
        console.print(Text(f"Note: {note}", style="yellow"))


def _run_text(run: dict[str, Any]) -> str:
    text = f"{run['steps']} steps, replicas {run['replicas']}"
    if run["wall_time"] is not None:
        text += f", {duration_text(run['wall_time'])}"
    if not math.isfinite(run["half_width"]):
        return f"{text}: ends before the effect of the start does"
    text += f": ± {percent(run['half_width'])} (95 %) at the end"
    uniform = run["any_time_half_width"]
    return text if uniform is None else f"{text}, ± {percent(uniform)} if monitored throughout"


def _answer(document: dict[str, Any]) -> str:
    """How long to run for the precision, with the replicas of the file, and how precise its own length is."""
    own = document["file"]
    row = next(row for row in document["lengths"] if row["replicas"] == own["replicas"])
    time = f" ({duration_text(row['wall_time'])})" if row["wall_time"] is not None else ""
    reached = f"gives ± {percent(own['half_width'])}" if math.isfinite(own["half_width"]) else "ends in the warm-up"
    return (
        f"For ± {percent(document['precision'])} of the system error (95 %), run {_count(row['steps'])} steps{time} "
        f"with {counted(own['replicas'], 'replica')}; the length of the file, {own['steps']} steps, {reached}."
    )


def _time(seconds: float | None) -> str:
    return "-" if seconds is None else duration_text(seconds)


def _count(steps: float | None) -> str:
    return "-" if steps is None else f"{steps:.0f}"


def print_spectrum(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``MeasuredSpectrum.to_json()``: some lags and frequencies, and the test of a log."""
    lags, course, error = document["lags"], document["system_autocovariance"], document["system_error"]
    rows = [
        [number_text(lags[at]), number_text(course[at]), number_text(course[at] / error, 3) if error else "-"]
        for at in _some(len(course))
    ]
    print_rows(console, f"Autocovariance of {document['experiment']}", ("lag", "system", "correlation"), rows)
    frequencies, density = document["frequencies"], document["system_density"]
    rows = [[number_text(frequencies[at], 3), number_text(density[at])] for at in _some(len(frequencies))]
    print_rows(console, "Spectral density, one-sided", ("frequency", "system"), rows)
    if log := document["log"]:
        heads = ("lag", "predicted", "measured", "corrected for graphs", "95 % interval", "z")
        found = zip(
            *(log[key] for key in ("lags", "predicted", "measured", "corrected", "intervals", "z")), strict=True
        )
        rows = [[*map(number_text, numbers), interval_text(interval), z_text(z)] for *numbers, interval, z in found]
        print_rows(console, f"The log, {log['steps']} steps", heads, rows)
        if log["p"] is not None:
            verdict = "agrees with" if log["p"] >= document["level"] else "disagrees with"
            console.print(f"The log {verdict} the predicted autocovariance: p = {p_text(log['p'])}.")
    if document["note"]:
        console.print(Text(f"Note: {document['note']}", style="yellow"))


def _some(count: int, most: int = 12) -> list[int]:
    """Places of some of so many rows, at equal distances."""
    return sorted({round(k * (count - 1) / (most - 1)) for k in range(most)}) if count else []
