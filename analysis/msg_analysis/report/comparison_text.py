# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Comparisons, live estimates and differences in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text import (
    agent_name,
    agent_text,
    counted,
    listed,
    measured_text,
    number_text,
    p_text,
    percent,
    with_names,
    z_text,
)
from msg_analysis.experiment.problems import show
from msg_analysis.inference.realtime_laws import SUPPORT
from msg_analysis.model.run_record import RunRecord
from msg_analysis.report.tables import ROWS, fact_table, first_rows, interval_text, number_table, print_table
from msg_analysis.report.wording import (
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
from msg_analysis.theory.prediction import LAW_NAMES

if TYPE_CHECKING:
    from msg_analysis.inference.estimates import Estimate
    from msg_analysis.inference.online_errors import LiveReport


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


def live_document(report: LiveReport, record: RunRecord) -> dict[str, Any]:
    """The document of ``msg-agents live --json``; keys as in that of ``compare`` where both have them."""
    dt = record.experiment.step_length
    return {
        "run": str(record.run),
        "experiment": record.experiment.name,
        "names": record.experiment.names,
        "first_step": report.first,
        "last_step": report.last,
        "steps": report.steps,
        "missing": report.missing,
        "simulated_time": report.steps * dt,
        "system_error": report.system.to_json(),
        "node_errors": [node.to_json() for node in report.nodes],
        "any_time": report.any_time.to_json(),
        "refused": report.refused,
        "note": report.note,
    }


def live_line(report: LiveReport, last: int, rate: float) -> str:
    """Step, of ``last`` ones, system error and missing steps in one line; ``rate`` in steps per second."""
    parts = [f"step {min(max(report.newest, 0), last)} of {last}", f"system error {error_text(report.system)}"]
    if any_time := any_time_text(report):
        parts.append(any_time)
    return ", ".join(parts + (coverage(report) if report.steps else ["no complete step yet"]) + [f"{rate:.0f} steps/s"])


def any_time_text(report: LiveReport) -> str:
    """What is valid however often one looks: half-width of the interval, evidence; may be empty."""
    seen, parts = report.any_time, []
    if seen.half_width is not None:
        parts.append(f"any time ± {number_text(seen.half_width, 2)}")
    if seen.log_evidence is not None:
        evidence = seen.to_json()["evidence"]
        shown = "more than 1e300" if evidence is None else number_text(evidence, 2)
        limit = f"disagrees: {seen.strongest}" if seen.crossed else f"disagrees at {seen.threshold:g}"
        parts.append(f"evidence against the prediction {shown} ({limit})")
    return ", ".join(parts)


def coverage(report: LiveReport) -> list[str]:
    """Steps in the errors, incomplete ones, and refused messages by reason."""
    since = f" since step {report.first}" if report.first else ""
    parts = [f"{report.steps} steps{since}", f"{report.missing} missing"]
    return parts + [f"{reason}: {count}" for reason, count in report.refused.items()]


def error_text(estimate: Estimate) -> str:
    """An error next to its prediction: ``1.45 ± 0.059 (95 %), predicted 1.41, z = +1.33``."""
    text = measured_text(estimate.measured, estimate.interval)
    if estimate.predicted is not None:
        text += f", predicted {number_text(estimate.predicted)}"
    return text + (f", z = {z_text(estimate.z)}" if estimate.z is not None else "")


_MOST_PERCENT = 5.0  # larger changes are factors
_RATES = {"mean": "of means", "second_moment": "of second moments", "graph": "of graph probabilities"}


def print_bag_difference(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``bag_difference``."""
    a, b = document["a"], document["b"]
    facts = number_table(console, "Runs", "", "A", "B")
    for title, values in (
        ("bag", [side["bag"] for side in (a, b)]),
        ("experiment", [side["experiment"] for side in (a, b)]),
        ("seed", [str(side["seed"]) for side in (a, b)]),
        ("steps", [str(side["steps"]) for side in (a, b)]),
        ("states missing", [_missing(side) for side in (a, b)]),
        ("verdict", [side["verdict"] or "none" for side in (a, b)]),
    ):
        facts.add_row(title, *map(Text, values))
    print_table(console, facts)
    _print_keys("Experiment", document["keys"], console)
    _print_keys("Versions", document["versions"], console)
    for line in _states(document):
        console.print(Text(line))
    _print_error_differences(document["errors"], _names(document), console)
    for name, side in (("A", a), ("B", b)):
        if side["unpredicted"]:
            console.print(Text(f"{name} has no prediction: {side['unpredicted']}"))


def print_experiment_difference(document: dict[str, Any], console: Console) -> None:
    """Print a document of ``experiment_difference``."""
    a, b = document["a"], document["b"]
    console.print(Text(f"A: {a['file']} ({a['name']})\nB: {b['file']} ({b['name']}); changes are from A to B"))
    _print_keys("Keys", document["keys"], console)
    for name, side in (("A", a), ("B", b)):
        if side["unpredicted"]:
            console.print(Text(f"{name} has no prediction: {side['unpredicted']}"))
    for law, errors in document["predictions"].items():
        table = number_table(
            console, f"Mean-square error in the steady state, {LAW_NAMES[law]}", "", "A", "B", "change"
        )
        table.add_row("system", *_relative(errors["system_error"]), end_section=True)
        for place, error in enumerate(first_rows(table, errors["node_errors"], "agents"), start=1):
            table.add_row(Text(agent_text(place, _names(document))), *_relative(error))
        print_table(console, table)
    table = number_table(console, "Decay rates of the steps of the run", "", "A", "B", "change")
    for key, title in _RATES.items():
        table.add_row(title, *_relative(document["rates"][key]))
    print_table(console, table)
    leaders = number_table(console, "Leaders", "", "agents", "gain", "system error")
    for name, key in (("A", "a"), ("B", "b")):
        side, names = document["leaders"][key], document[key]["names"]
        if side["agents"]:
            leaders.add_row(name, *_leaders(side, names))
        if side["best"]:
            leaders.add_row(f"best of {name}", *_leaders(side["best"], names))
        elif side["note"]:
            leaders.caption = f"{leaders.caption or ''}{name}: {side['note']}. "
    print_table(console, leaders)


def _print_keys(title: str, keys: Sequence[dict[str, Any]], console: Console) -> None:
    if not keys:
        console.print(Text(f"{title}: no difference"))
        return
    table = fact_table(console, f"{title}: {counted(len(keys), 'difference')}")
    for entry in keys:
        table.add_row(Text(entry["key"]), Text(f"A: {_value(entry['a'])}\nB: {_value(entry['b'])}"))
    console.print(table)


def _value(value: Any) -> str:
    return "-" if value is None else value if isinstance(value, str) else show(value)


def _missing(side: dict[str, Any]) -> str:
    count = side["completeness"]
    graphs = f", graphs of {count['missing_modes']} steps" if count["missing_modes"] else ""
    return f"{count['missing']} of {count['expected']}{graphs}"


def _states(document: dict[str, Any]) -> list[str]:
    """What is said of states and graphs."""
    states, graphs = document["states"], document["graphs"]
    if states["compared"] is None:
        return [f"States: not comparable: {states['why']}"]
    lines = []
    first, largest, last, names = states["first"], states["largest"], states["last"], _names(document)
    if states["equal"]:
        lines.append(f"States: equal to the last bit, x(0) to x({states['compared']})")
    elif first is None:
        lines.append(f"States: equal to the last bit up to x({states['compared']}), where both runs have them")
    else:
        everybody = len(first["agents"]) == document["a"]["agents"]
        agents = "all agents" if everybody else _agents(first["agents"], names)
        agent = agent_text(largest["agent"], names)
        lines += [
            f"States: first difference at step {first['step']} (time {number_text(first['time'])}), {agents}, by "
            f"{number_text(first['difference'])}",
            f"  different: {counted(states['states'], 'state')} in {counted(states['steps'], 'step')} of "
            f"{states['compared'] + 1}",
            f"  largest: {number_text(largest['difference'])} at step {largest['step']}, {agent}, "
            f"number {largest['number']}; at the last common step {last['step'] if last else '-'}: "
            f"{number_text(last['difference'] if last else None)}",
        ]
    lines += [
        f"  {states[key]} states only in {name}" for key, name in (("only_a", "A"), ("only_b", "B")) if states[key]
    ]
    if graphs:
        lines.append(
            f"Graphs: first difference at step {graphs['step']}: {graphs['a']} in A, {graphs['b']} in B; "
            f"different in {counted(graphs['steps'], 'step')}"
        )
    else:
        lines.append("Graphs: equal in all steps that both runs have")
    return lines


def _print_error_differences(errors: dict[str, Any], names: Sequence[str] | None, console: Console) -> None:
    table = number_table(console, "Measured mean-square errors", "", "A", "B", "B - A", "in standard errors")
    table.add_row("system", *_measured(errors["system"]), end_section=True)
    for place, error in enumerate(first_rows(table, errors["agents"], "agents"), start=1):
        table.add_row(Text(agent_text(place, names)), *_measured(error))
    print_table(console, table)
    if not errors["independent"]:
        console.print(Text("Both runs have the same seed: their errors are not independent.", style="dim"))


def _measured(error: dict[str, Any]) -> list[str]:
    sides = (error["a"] or {}, error["b"] or {})
    texts = [measured_text(side.get("measured"), (side.get("low"), side.get("high"))) for side in sides]
    return [*(text.removesuffix(" (95 %)") for text in texts), number_text(error["difference"], 3), z_text(error["z"])]


def _relative(pair: dict[str, Any]) -> list[str]:
    a, b, change = pair["a"], pair["b"], pair["relative"]
    if change is None:
        text = "-"
    elif change == 0.0:
        text = "equal"
    elif abs(change) > _MOST_PERCENT:
        text = f"{number_text(b / a, 3)} times"
    else:
        text = f"{'+' if change > 0 else '-'}{percent(abs(change))}"
    return [number_text(a), number_text(b), text]


def _leaders(side: dict[str, Any], names: Sequence[str] | None) -> list[str | Text]:
    agents = Text(listed([agent_name(agent, names) for agent in side["agents"]]))
    gain = side["gain"]
    return [agents, gain if gain == "inf" else number_text(gain), number_text(side["system_error"])]


def _names(document: dict[str, Any]) -> list[str] | None:
    """The names of the agents, where both have the same ones."""
    names: list[str] | None = document["a"]["names"]
    return names if names == document["b"]["names"] else None


def _agents(agents: Sequence[int], names: Sequence[str] | None) -> str:
    return f"{'agent' if len(agents) == 1 else 'agents'} {listed([agent_name(agent, names) for agent in agents])}"
