# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The comparison of a run, or of several, with its prediction as terminal tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text.agent_names import agent_text, with_names
from msg_analysis.common.text.number_words import measured_text, number_text, p_text, z_text
from msg_analysis.inference.realtime.laws import SUPPORT
from msg_analysis.report.documents.comparison_words import (
    QUANTILES,
    REAL_TIME_LAWS,
    TIMES,
    agent_errors,
    agent_order,
    any_time_words,
    gaps,
    sentence,
    timing_facts,
    trust_words,
    unheard_words,
    verdict_line,
)
from msg_analysis.report.terminal.tables import ROWS, fact_table, first_rows, interval_text, number_table, print_table

_STYLES = {"agrees": "bold green", "disagrees": "bold red", "incomplete": "bold yellow", "unpredicted": "bold"}


def print_comparison(document: dict[str, Any], console: Console) -> None:
    """Print verdict, errors measured and predicted, tests and what is missing; a run's ``strangers``, if any."""
    console.print(verdict_line(document), style=_STYLES[document["verdict"]])
    count = document["completeness"]
    console.print(
        f"{count['received']} of {count['expected']} states in {document['steps']} steps "
        f"({number_text(document['simulated_time'])} units of time): {count['missing']} missing, "
        f"{count['duplicates']} duplicates, {count['out_of_order']} out of order"
    )
    if (until := document.get("until")) is not None and until["ended_early"]:
        step, why = document["steps"], until.get("reason") or f"--until {until['rule']}"
        console.print(Text(f"The run ended in order at step {step} of {until['planned_steps']}: {why}."))
    elif until is not None:
        console.print(Text(f"--until {until['rule']}: {until.get('reason') or 'not reached before the planned end'}."))
    for line in gaps(count):
        console.print(Text(line))
    if document.get("unpredicted"):
        console.print(Text(f"No prediction: {document['unpredicted']}."))
    if document.get("transient"):
        console.print(f"The errors leave out the first {document['transient']} steps (transient).")
    for cause in (document.get("blame") or [])[:ROWS]:
        console.print(Text(with_names(sentence(cause["words"]), document.get("names"))), style="bold red")
    for line in trust_words(document):
        console.print(Text(line))
    _print_bags(document.get("bags") or [], console)
    _print_errors(document, console)
    _print_tests(document, console)
    for line in [*any_time_words(document), *agent_order(document)]:
        console.print(Text(line))
    loss = document.get("loss") or {}
    if loss.get("lost") is not None:
        console.print(f"{loss['lost']} messages lost, {loss['expected']:.6g} expected")
    _print_timing(document, console)
    _print_strangers(document.get("strangers") or [], console)
    interval = document["batch_means"]["interval"]
    measured = measured_text(document["system_error"]["measured"], interval)
    console.print(f"System error without a model of the run (batch means): {measured}", style="dim")
    continuous = document["continuous"]["system_error"]
    if continuous is not None and not document.get("laws"):
        console.print(f"System error in continuous time, for reference: {number_text(continuous)}", style="dim")


def _print_bags(bags: Sequence[dict[str, Any]], console: Console) -> None:
    """The runs of a pooled comparison; nothing for a single run."""
    if not bags:
        return
    table = number_table(console, f"{len(bags)} runs", "bag", "seed", "time", "system error", "z", "missing", "")
    for bag in first_rows(table, bags, "runs"):
        error = bag["system_error"]
        table.add_row(
            Text(bag["bag"]),
            str(bag["seed"]),
            number_text(bag["simulated_time"]),
            number_text(error["measured"]),
            z_text(error["z"]),
            str(bag["missing"]),
            bag["verdict"],
        )
    print_table(console, table)
    torn = [bag["bag"] for bag in bags if not bag["complete"]]
    if torn:
        console.print(Text(f"Incomplete: {', '.join(torn)}. Leave them out for a verdict on the others."))


def _print_strangers(strangers: Sequence[dict[str, Any]], console: Console) -> None:
    if not strangers:
        return
    console.print(Text("Refused messages", style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("node", "topic", "reason"):
        table.add_column(heading, overflow="fold")
    table.add_column("number", justify="right")
    for entry in first_rows(table, strangers, "kinds"):
        table.add_row(*(Text(str(entry[key])) for key in ("node", "topic", "reason", "count")))
    console.print(table)


def _print_errors(document: dict[str, Any], console: Console) -> None:
    columns = ("measured", "95 % interval", "predicted", "z")
    table = number_table(console, "Mean-square error over the run", "", *columns)

    def row(label: str, entry: dict[str, Any] | None, end_section: bool = False) -> None:
        entry = entry or {}
        measured, predicted = number_text(entry.get("measured")), number_text(entry.get("predicted"))
        cells = (Text(label), measured, interval_text(entry.get("interval")), predicted, z_text(entry.get("z")))
        table.add_row(*cells, end_section=end_section)

    given = document.get("given_path")
    row("system", document["system_error"], end_section=not given)
    if given:
        row("system, given the path", given["system_error"], end_section=True)
    agents, corrected = agent_errors(document)
    for agent, entry in enumerate(first_rows(table, agents, "agents"), start=1):
        row(agent_text(agent, document.get("names")) + (", given the path" if corrected else ""), entry)
    print_table(console, table)


def _print_timing(document: dict[str, Any], console: Console) -> None:
    """How well a run in real time kept its time, and which laws it supports."""
    timing, laws = document.get("timing"), document.get("laws")
    if not timing or not laws:
        return
    table = number_table(console, "Timing: quantiles", "", *QUANTILES.values())
    for key, title in TIMES.items():
        values = timing[key]
        table.add_row(Text(title), *(number_text(values[quantile], 3) for quantile in QUANTILES))
    print_table(console, table)
    facts = fact_table(console, "Real time")
    for title, text in timing_facts(timing):
        facts.add_row(title, text)
    console.print(facts)
    table = number_table(console, "Laws", "system error", "predicted", "z", "")
    for key, title in REAL_TIME_LAWS.items():
        law = laws[key]
        error = law["system_error"]
        table.add_row(title, number_text(error["predicted"]), z_text(error["z"]), Text(SUPPORT[law["supported"]]))
    print_table(console, table)
    for line in [with_names(laws["why"], document.get("names")), *unheard_words(document)]:
        console.print(Text(line))


def _print_tests(document: dict[str, Any], console: Console) -> None:
    tests = document.get("tests") or []
    if not tests:
        return
    title = f"Tests (level {number_text(document.get('level'))} for all together)"
    table = number_table(console, title, "test", "p", "p adjusted", "")
    # Rejected tests first: with many agents the table is cut.
    shown = [test for test in tests if test["rejected"]] + [test for test in tests if not test["rejected"]]
    for test in first_rows(table, shown, "tests"):
        name = with_names(str(test["name"]), document.get("names"))
        table.add_row(Text(name), p_text(test["p"]), p_text(test["p_adjusted"]), _mark(test))
    print_table(console, table)


def _mark(test: dict[str, Any]) -> Text:
    if test["p"] is None:
        return Text("not tested", style="dim")
    return Text("rejected", style="bold red") if test["rejected"] else Text("passed", style="green")
