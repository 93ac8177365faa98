# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Comparisons and live estimates in words: sentences for terminal and report, and the terminal text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text import (
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
from msg_analysis.inference.realtime_laws import SUPPORT
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import step_law
from msg_analysis.report.tables import fact_table, first_rows, gaps, interval_text, print_rows, print_table
from msg_analysis.theory.prediction import LAW_NAMES

if TYPE_CHECKING:
    from msg_analysis.inference.estimates import Estimate
    from msg_analysis.inference.online_errors import LiveReport


VERDICTS = {
    "agrees": "The run agrees with the prediction.",
    "disagrees": "The run disagrees with the prediction.",
    "late": "The run was late, so it is no test of the prediction",
    "incomplete": "No verdict: the data are incomplete.",
    "unpredicted": "No verdict, because there is no prediction. All available tests are ok.",
}
TIMES = {
    "lateness_ms": "lateness [ms]",
    "jitter_ms": "period jitter [ms]",
    "staleness_ms": "age of values used [ms]",
    "staleness_steps": "age of values used [steps]",
}
QUANTILES = {"p50": "median", "p95": "95 %", "p99": "99 %", "max": "largest"}
REAL_TIME_LAWS = {key: LAW_NAMES[key] for key in ("pattern", "sequential", "continuous")}
CORRECTED = "corrected for this run's graph sequence"
SMALLER = "has a smaller error than"

_STYLES = {
    "agrees": "bold green",
    "disagrees": "bold red",
    "late": "bold yellow",
    "incomplete": "bold yellow",
    "unpredicted": "bold",
}
_FEW_AGENTS, _WORST = 8, 5  # most agents of whom each has a row; rows of larger networks


def print_comparison(document: dict[str, Any], console: Console, *, verbose: bool = False) -> None:
    """Print a comparison, perhaps that of a network with its rejected messages; with ``verbose`` everything."""

    def say(*lines: str) -> None:
        for line in lines:
            console.print(Text(line))

    console.print(verdict_line(document), style=_STYLES[document["verdict"]])
    say(*power_words(document), *_facts(document))
    for cause in document.get("causes") or []:
        console.print(Text(with_names(sentence(cause["words"]), document.get("names"))), style="bold red")
    say(*trust_words(document))
    _print_bags(document.get("bags") or [], console)
    _print_tests(document, console, verbose)
    _print_errors(document, console, verbose)
    if verbose or (document.get("any_time") or {}).get("exceeded"):
        say(*any_time_words(document))
    if document.get("laws"):
        if verbose:
            _print_timing(document["timing"], document["laws"], console)
        say(with_names(document["laws"]["why"], document.get("names")), *lost_words(document))
    _print_rejected(document.get("rejected_messages") or [], console)
    if verbose:
        say(*_details(document))


def external_words(agents: Sequence[int]) -> str:
    """Which agents (from 1) are external."""
    one = len(agents) == 1
    return f"{'Agent' if one else 'Agents'} {', '.join(map(str, agents))} {'is' if one else 'are'} external."


def _facts(document: dict[str, Any]) -> list[str]:
    """How many states there are, how the run ended, and what its errors leave out."""
    count = document["completeness"]
    lines = [
        f"{count['received']} of {count['expected']} states in {document['steps']} steps "
        f"({number_text(document['simulated_time'])} units of time)"
    ]
    wrong = [f"{count[key]} {key.replace('_', ' ')}" for key in ("missing", "duplicates", "out_of_order") if count[key]]
    lines[0] += f": {', '.join(wrong)}" if wrong else ""
    if (until := document.get("until")) is not None:
        step, why = document["steps"], until.get("reason") or f"--until {until['rule']}"
        ended = f"The run ended in order at step {step} of {until['planned_steps']}: {why}."
        missed = f"--until {until['rule']}: {until.get('reason') or 'not reached before the planned end'}."
        lines.append(ended if until["ended_early"] else missed)
    if restarts := document.get("restarts"):
        nodes = Counter(line.partition(":")[0].replace("agent_", "agent ") for line in restarts)
        each = listed([node + (f" {times} times" if times > 1 else "") for node, times in nodes.items()])
        lines.append(with_names(f"{counted(len(restarts), 'restart')} ({each})", document.get("names")))
    if external := document.get("external"):
        lines.append(with_names(external_words(external), document.get("names")))
    lines += gaps(count)
    if document.get("unpredicted"):
        lines.append(f"No prediction: {document['unpredicted']}.")
    if sampled := document.get("sampled"):
        lines.append(f"Sampled instead: {number_text(sampled['system_error'])} ({interval_text(sampled['interval'])}).")
    if document.get("transient"):
        lines.append(f"The errors leave out the first {document['transient']} steps (transient).")
    return lines


def _details(document: dict[str, Any]) -> list[str]:
    lines = agent_order(document)
    loss = document.get("loss") or {}
    if loss.get("lost") is not None:
        lines.append(f"{loss['lost']} messages lost, {loss['expected']:.6g} expected")
    measured = measured_text(document["system_error"]["measured"], document["batch_means"]["interval"])
    lines.append(f"Model-free estimate of the system error (batch means): {measured}")
    continuous = document["continuous"]["system_error"]
    if continuous is not None and not document.get("laws"):
        lines.append(f"System error in continuous time, for reference: {number_text(continuous)}")
    return lines


def _print_bags(bags: Sequence[dict[str, Any]], console: Console) -> None:
    if not bags:  # a single run
        return
    rows = []
    for bag in bags:
        error = bag["system_error"]
        numbers = (number_text(bag["simulated_time"]), number_text(error["measured"]), z_text(error["z"]))
        rows.append((bag["bag"], str(bag["seed"]), *numbers, str(bag["missing"]), bag["verdict"]))
    heads = ("bag", "seed", "time", "system error", "z", "missing", "")
    print_rows(console, f"{len(bags)} runs", heads, rows, "runs")
    if torn := [bag["bag"] for bag in bags if not bag["complete"]]:
        console.print(Text(f"Incomplete: {', '.join(torn)}. Leave them out for a verdict on the others."))


def _print_tests(document: dict[str, Any], console: Console, verbose: bool) -> None:
    """How many tests are ok, and all that are rejected; with ``verbose`` the others, too."""
    tests = document.get("tests") or []
    rejected = [test for test in tests if test["rejected"]]
    known = [test["p_adjusted"] for test in tests if test["p_adjusted"] is not None]
    if not known:
        return
    count = f"{len(rejected)} of {len(known)} tests rejected" if rejected else f"{len(known)} of {len(known)} tests ok"
    line = f"{count} (smallest adjusted p {min(known):.2g}"
    line += f"; family-wise false-alarm rate {percent(document['level'])})" if rejected or verbose else ")"
    if not rejected and not verbose:
        console.print(line)
        return
    rows = []
    for test in sorted(tests if verbose else rejected, key=lambda test: not test["rejected"]):
        mark = Text("rejected", style="bold red") if test["rejected"] else Text("ok", style="green")
        mark = mark if test["p"] is not None else Text("not tested", style="dim")
        name = with_names(str(test["name"]), document.get("names"))
        rows.append((name, p_text(test["p"]), p_text(test["p_adjusted"]), mark))
    print_rows(console, line, ("test", "p", "p adjusted", ""), rows)


def _print_errors(document: dict[str, Any], console: Console, verbose: bool) -> None:
    """Of the system and of the agents; of large networks, those agents that are furthest from the prediction."""
    table = Table(box=None, pad_edge=False, padding=(0, 1))
    table.add_column("mean-square error")
    predicted = f"predicted, {LAW_NAMES[document['law']]}" if document.get("laws") else "predicted"
    for head in ("measured", "95 % interval", predicted, "z"):
        table.add_column(head, justify="right")

    def row(label: str, entry: dict[str, Any] | None) -> None:
        entry = entry or {}
        measured, predicted = number_text(entry.get("measured")), number_text(entry.get("predicted"))
        table.add_row(Text(label), measured, interval_text(entry.get("interval")), predicted, z_text(entry.get("z")))

    row("system", document["system_error"])
    if given := document.get("given_path"):
        row("system, corrected*", given["system_error"])
    agents, corrected = agent_errors(document)
    shown: Sequence[int] = range(len(agents))
    if len(agents) > _FEW_AGENTS and not verbose:
        shown = furthest([agent["z"] for agent in agents], _WORST)
    for place in shown:
        row(agent_text(place + 1, document.get("names")) + (", corrected*" if corrected else ""), agents[place])
    print_table(console, table)
    if given:
        console.print(f"* {CORRECTED}", style="dim")
    if len(shown) < len(agents):
        inside = sum(agent["z"] is not None and abs(agent["z"]) < 1.96 for agent in agents)
        console.print(
            f"{inside} of {len(agents)} agent errors have the prediction in their 95 % intervals; shown are the "
            f"{len(shown)} that are furthest from it."
        )


def _print_timing(timing: dict[str, Any], laws: dict[str, Any], console: Console) -> None:
    """How well a run in real time kept its time, and which models it supports."""
    rows: list[Sequence[str]] = [
        [title, *(number_text(timing[key][quantile], 3) for quantile in QUANTILES)] for key, title in TIMES.items()
    ]
    print_rows(console, "Timing: quantiles", ["", *QUANTILES.values()], rows)
    facts = fact_table(console, "Real time")
    for title, text in timing_facts(timing):
        facts.add_row(title, text)
    console.print(facts)
    rows = []
    for key, title in REAL_TIME_LAWS.items():
        error, support = laws[key]["system_error"], SUPPORT[laws[key]["supported"]]
        rows.append((title, number_text(error["predicted"]), z_text(error["z"]), support))
    print_rows(console, "Models", ("system error", "predicted", "z", ""), rows)


def _print_rejected(messages: Sequence[dict[str, Any]], console: Console) -> None:
    if not messages:
        return
    console.print(Text("Rejected messages", style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("node", "topic", "reason"):
        table.add_column(heading, overflow="fold")
    table.add_column("number", justify="right")
    for entry in first_rows(table, messages, "kinds"):
        table.add_row(*(Text(str(entry[key])) for key in ("node", "topic", "reason", "count")))
    console.print(table)


def verdict_line(document: dict[str, Any]) -> str:
    """The verdict on one run or several; in real time also on the prediction made before the run."""
    verdict = VERDICTS[document["verdict"]]
    if real_time := document.get("real_time"):
        return _realtime_line(document["verdict"], real_time)
    if document.get("bags"):
        verdict = verdict.replace("The run agrees", "The runs agree").replace("The run disagrees", "The runs disagree")
    return verdict


def _realtime_line(verdict: str, real_time: dict[str, Any]) -> str:
    """Two statements: on the agents given what they received, and on the prediction made before the run."""
    obeys = "follow" if real_time["follows_model"] else "do not follow"
    line = f"The agents {obeys} the model, given what they received; the prediction for real time is "
    line += {True: "supported", False: "not supported", None: "not decided"}[real_time["prediction"]]
    missed, limit = real_time["missed"], real_time["max_missed"]
    if missed:
        line += f"; {percent(missed)} of the deadlines were missed"
    start = VERDICTS[verdict].removesuffix(".")
    if verdict == "late":
        return f"{start} (at most {percent(limit)} may be missed). {line}."
    return f"{line}." if verdict in ("agrees", "disagrees") else f"{start}. {line}."


_FAULTS = {"noise": "a noise variance of one agent", "gain": "a gain of one link", "switching": "all switching rates"}


def power_words(document: dict[str, Any]) -> list[str]:
    """What a run that agrees could have found, in a sentence; empty where that is not known."""
    power = document.get("power")
    if document["verdict"] != "agrees" or not power:
        return []
    width, factor = power["half_width"], power["factor"]
    parts = [] if width is None else [f"The system error is known to ± {percent(width)} (95 %)"]
    if factor is not None:
        size = f"{100 * abs(factor - 1.0):.0f} % too {'large' if factor > 1.0 else 'small'}"
        parts.append(f"{_FAULTS[power['kind']]} {size} would be found with probability {percent(power['power'])}")
    return [sentence("; ".join(parts))] if parts else []


def timing_facts(timing: dict[str, Any]) -> list[tuple[str, str]]:
    """Counts of a run in real time, ``timing`` of a comparison: what was counted, and the numbers."""
    deadlines, uses, graphs = timing["deadlines"], timing["ideal_uses"], timing["outdated_graph"]
    facts = [
        ("period", f"{number_text(timing['period_ms'])} ms"),
        ("deadlines missed", f"{deadlines['missed']} of {deadlines['steps']} ({percent(deadlines['share'])})"),
        ("neighbour values as recent as with ideal timers", percent(uses["share"])),
        ("steps with an outdated graph", f"{graphs['steps']} of {deadlines['steps']} ({percent(graphs['share'])})"),
    ]
    if timing["never_received"]:
        facts.append(("uses of neighbours before their first message", str(timing["never_received"])))
    lost = timing.get("lost_messages")  # results of older versions have none
    if lost:
        numbers = f"{lost['lost']} of {lost['messages']} ({percent(lost['share'])})"
        facts.append(("late or lost messages", f"{numbers}; simulated loss {percent(lost['expected'])}"))
    return facts


def lost_words(document: dict[str, Any]) -> list[str]:
    """That messages between agents were lost or late, in a sentence; empty where the experiment says so."""
    words = ((document.get("timing") or {}).get("lost_messages") or {}).get("words")
    return [with_names(sentence(words), document.get("names"))] if words else []


def sentence(words: str) -> str:
    """The words with a capital letter and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def agent_errors(document: dict[str, Any]) -> tuple[list[dict[str, Any]], bool]:
    """The agent errors, and whether they are corrected for the graph sequence."""
    given = (document.get("given_path") or {}).get("node_errors") or []
    # Where only these have intervals: in runs that are too short for intervals over all paths.
    corrected = bool(document["system_error"].get("standard_error") is None and given)
    found = given if corrected else document["node_errors"] or []
    return [{"p_adjusted": error.get("p_holm"), **error} for error in found], corrected  # results of before have p_holm


def any_time_words(document: dict[str, Any]) -> list[str]:
    """The sequential test in sentences; empty where there is none."""
    if not (seen := document.get("any_time")):
        return []
    evidence, limit = seen["evidence"], f"threshold {seen['threshold']:g}"
    shown = number_text(evidence, 2) if evidence is not None else "more than 1e300"
    line = f"Sequential test: evidence {shown} against the prediction"
    if not seen["exceeded"]:
        return [f"{line} ({limit}, not exceeded). Valid at any stopping time."]
    when = f" at t = {number_text(seen['crossed_at'])}" if seen["crossed_at"] is not None else ""
    strongest = f"; strongest for: {seen['questions'][0]['about']}" if seen["questions"] else ""
    line += f" ({limit}, exceeded{when}){strongest}. Valid at any stopping time."
    return [with_names(line, document.get("names"))]


def trust_words(document: dict[str, Any]) -> list[str]:
    """Which errors to trust, where that is not obvious: with heavy tails, few switches, or few digits."""
    trust = document.get("trust")
    return [trust["words"]] if trust and trust["reason"] in ("few_digits", "heavy_tails", "few_switches") else []


def agent_order(document: dict[str, Any]) -> list[str]:
    """Which agents have smaller errors than which, in sentences; empty where that is not known."""
    if not document.get("order"):
        return []
    names = [agent_text(i, document.get("names")) for i in range(1, len(document["node_errors"]) + 1)]
    return order_statements(document["order"], names, SMALLER)


def order_statements(order: dict[str, Any], names: Sequence[str], relation: str, most: int = 12) -> list[str]:
    """Which of ``names`` differ, in sentences with the ``relation`` of the better one; ``most`` pairs one by one."""

    def named(pair: dict[str, Any]) -> str:
        sure = pair["confidence"]
        confidence = "> 99.99 %" if sure > 0.9999 else f"{100 * sure:.2f} %"
        return f"{names[pair['better'] - 1]} {relation} {names[pair['worse'] - 1]} (confidence {confidence})"

    lines = [
        f"Order, smallest measured error first: {', '.join(names[i - 1] for i in order['ranking'])}. "
        f"{order['distinguished']} of {order['pairs']} pairs differ significantly (family-wise level "
        f"{order['level']:g})."
    ]
    # Of each, only the nearest one below it that differs significantly: those further down add little.
    places = {number: place for place, number in enumerate(order["ranking"])}
    nearest: dict[int, dict[str, Any]] = {}
    for pair in sorted(order["distinctions"], key=lambda pair: places[pair["worse"]]):
        nearest.setdefault(places[pair["better"]], pair)
    for _, pair in sorted(nearest.items())[:most]:  # the name of a file keeps its first letter
        lines.append(sentence(named(pair)) if named(pair).startswith("agent ") else f"{named(pair)}.")
    if order["ties"] and order["distinguished"]:
        ties = [f"{names[a - 1]} and {names[b - 1]}" for a, b in order["ties"][:most]]
        lines.append(f"Not significantly different: {'; '.join(ties)}.")
    for pair in order["contradictions"][:most]:
        expected = "the opposite order" if pair["predicted"] is False else "equal errors"
        lines.append(f"Unexpected: {named(pair)}; the theory predicts {expected}.")
    return lines


def furthest(z: Sequence[float | None], most: int) -> list[int]:
    """Places, from 0, of the ``most`` estimates with the largest abs(z), largest first."""
    return sorted(range(len(z)), key=lambda place: -abs(z[place] or 0.0))[:most]


def live_document(report: LiveReport, record: RunRecord) -> dict[str, Any]:
    """The document of ``msg-agents live --json``; keys as in that of ``compare`` where both have them."""
    dt = record.experiment.step_length
    return {
        "run": str(record.run),
        "experiment": record.experiment.name,
        "names": record.experiment.names,
        "law": step_law(record.experiment),
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
    """Half-width of the interval that is valid at all times, and the evidence; may be empty."""
    seen, parts = report.any_time, []
    if seen.half_width is not None:
        parts.append(f"at all times ± {number_text(seen.half_width, 2)}")
    if seen.log_evidence is not None:
        evidence = seen.to_json()["evidence"]
        shown = "more than 1e300" if evidence is None else number_text(evidence, 2)
        limit = f"exceeded: {seen.strongest}" if seen.crossed else f"threshold {seen.threshold:g}"
        parts.append(f"evidence against the prediction {shown} ({limit})")
    return ", ".join(parts)


def coverage(report: LiveReport) -> list[str]:
    """Steps in the errors, incomplete ones, and rejected messages by reason."""
    since = f" since step {report.first}" if report.first else ""
    parts = [f"{report.steps} steps{since}", f"{report.missing} missing"]
    return parts + [f"{reason}: {count}" for reason, count in report.refused.items()]


def error_text(estimate: Estimate) -> str:
    """An error next to its prediction: ``1.45 ± 0.059 (95 %), predicted 1.41, z = +1.33``."""
    text = measured_text(estimate.measured, estimate.interval)
    if estimate.predicted is not None:
        text += f", predicted {number_text(estimate.predicted)}"
    return text + (f", z = {z_text(estimate.z)}" if estimate.z is not None else "")
