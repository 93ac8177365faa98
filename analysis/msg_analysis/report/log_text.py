# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Terminal text on logs of any origin: the comparison with a law, and what is in a log."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.common.text import agent_text, counted, listed, measured_text, number_text, p_text, with_names
from msg_analysis.report.tables import number_table, print_table

VERDICTS = {"agrees": "The log agrees with the law.", "disagrees": "The log disagrees with the law."}
STYLES = {"agrees": "bold green", "disagrees": "bold red"}
FACTORS = {
    "gains": "all gains",
    "noise": "all noise variances",
    "measurement_noise": "variance of the measurement noise",
    "rates": "all rates of the switching",
}
MOST_TESTS = 12


def print_log_comparison(document: dict[str, Any], console: Console, *, verbose: bool = False) -> None:
    """Print the comparison of a log; with ``verbose`` all tests."""
    names = document["names"]

    def say(line: str, style: str = "") -> None:
        console.print(Text(with_names(line, names), style=style), soft_wrap=True)

    say(VERDICTS[document["verdict"]], STYLES[document["verdict"]])
    for cause in document["causes"]:
        say(f"  {cause['words']}")
    between = document["intervals"]
    say(
        f"{document['law']}: {counted(document['samples'], 'sample')} in {number_text(document['span'])} units of "
        f"time, intervals {number_text(between['least'], 3)} to {number_text(between['largest'], 3)}, "
        f"{document['missing']} values missing"
    )
    error = document["system_error"]
    if error:
        over = "over all paths" if document["hidden"] else "given the path of the graphs"
        text = f"expected {over} {number_text(error['predicted'])}"
        say(f"system error: {measured_text(error['measured'], error['interval'])}, {text}")
    noise = document["measurement_noise"]
    if noise["estimated"]:
        low, high = noise["interval"]
        text = f"{number_text(noise['values'][0], 4)} ({number_text(low, 4)} to {number_text(high, 4)})"
        say(f"measurement noise, estimated: {text}")
    table = number_table(console, "Measured over expected", "", "factor", "95 %")
    for key, name in FACTORS.items():
        found = document["factors"].get(key)
        if found and found["interval"]:
            low, high = found["interval"]
            table.add_row(name, number_text(found["estimate"], 4), f"{number_text(low, 4)} to {number_text(high, 4)}")
    for number, ratio in enumerate(document["ratios"], start=1):
        if ratio is not None:
            table.add_row(f"squared innovations, {agent_text(number, names)}", number_text(ratio, 4), "")
    if table.row_count:
        print_table(console, table)
    tests = sorted(document["tests"], key=lambda test: test["p"])
    shown = tests if verbose else [test for test in tests if test["rejected"]][:MOST_TESTS]
    if shown:
        table = number_table(console, f"Tests (level {document['level']:g} over all)", "test", "p", "adjusted", "")
        for test in shown:
            mark = "rejected" if test["rejected"] else "ok"
            table.add_row(with_names(test["name"], names), p_text(test["p"]), p_text(test["p_adjusted"]), mark)
        print_table(console, table)
    else:
        say(f"All {len(tests)} tests are ok; the smallest p-value is {p_text(tests[0]['p'])} ({tests[0]['name']}).")
    for title, key in (("Exact", "exact"), ("Approximate", "approximate"), ("Not tested", "untested")):
        say(f"{title}: {' '.join(document[key])}")
    for note in document["notes"]:
        say(f"note: {note}")


def print_log_check(document: dict[str, Any], console: Console) -> None:
    """Print what is in a log."""

    def say(line: str) -> None:
        console.print(Text(line), soft_wrap=True)

    table = number_table(
        console, f"{document['source']} (time: {document['time']})", "agent", "values", "from to [s]", "rate [1/s]",
        "jitter [s]", "gaps", "range", "change",
    )  # fmt: skip
    for each in document["agents"]:
        low, high = each["least"], each["largest"]
        between = "" if low is None else "; ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
        span = f"{each['first']:.6g} to {each['last']:.6g}"
        numbers = [number_text(each[key], 3) for key in ("rate", "jitter")]
        table.add_row(
            f"{each['agent']} {each['source']}", str(each["values"]), span, *numbers, str(each["gaps"]), between,
            number_text(each["change"], 3),
        )  # fmt: skip
    print_table(console, table)
    for each in document["agents"]:
        found = [
            (each["gaps"], f"gaps, the longest of {number_text(each['longest_gap'], 3)} s"),
            (each["clock_jumps"], "jumps of the clock backwards"),
            (each["duplicates"], "values with the time of the one before"),
            (each["not_finite"], "values that are not finite"),
            (each["short"], "messages without the field"),
        ]
        problems = [f"{count} {what}" for count, what in found if count]
        if problems:
            say(f"agent {each['agent']}: {', '.join(problems)}")
    graph = document["graph"]
    if graph:
        say(
            f"graph {graph['source']}: {graph['messages']} messages from {graph['first']:.6g} s on, "
            f"{graph['switches']} switches between {listed(graph['names'])}"
        )
    else:
        say("graph: none in the log")
    say(f"All agents have a value at {100 * document['together']:.3g} % of the sample times.")
    for note in document["notes"]:
        say(f"note: {note}")
