"""What a comparison says beyond its numbers: causes, the runs of a pool, and which agents differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.report.terminal.tables import ROWS, note_cut, number_table, number_text, z_text


def print_blame(document: dict[str, Any], console: Console) -> None:
    """Print what is wrong, a sentence each."""
    for cause in (document.get("blame") or [])[:ROWS]:
        console.print(Text(f"{sentence(cause['words'])}"), style="bold red")


def sentence(words: str) -> str:
    """The words with a capital letter and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def _agents_first(words: str) -> str:
    """A sentence; one that begins with the name of a file keeps its first letter."""
    return sentence(words) if words.startswith("agent ") else f"{words}."


def print_bags(document: dict[str, Any], console: Console) -> None:
    """Print the runs of a pooled comparison; nothing for a single run."""
    bags = document.get("bags") or []
    if not bags:
        return
    table = number_table(console, f"{len(bags)} runs", "bag", "seed", "time", "system error", "z", "missing", "")
    for bag in bags[:ROWS]:
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
    note_cut(table, len(bags), "runs")
    console.print(table)
    torn = [bag["bag"] for bag in bags if not bag["complete"]]
    if torn:
        console.print(Text(f"Incomplete: {', '.join(torn)}. Leave them out for a verdict on the others."))


def print_order(document: dict[str, Any], console: Console) -> None:
    """Print which agents are more certain than which."""
    order = document.get("order")
    if order:
        agents = len(document["node_errors"])
        names = [f"agent {i}" for i in range(1, agents + 1)]
        for line in order_statements(order, names, "is more certain than"):
            console.print(Text(line))


def order_statements(order: dict[str, Any], names: Sequence[str], relation: str, most: int = 12) -> list[str]:
    """Which of ``names`` differ, in sentences with the ``relation`` of the better one; ``most`` pairs one by one."""

    def named(pair: dict[str, Any]) -> str:
        sure = pair["confidence"]
        confidence = "> 99.99 %" if sure > 0.9999 else f"{100 * sure:.2f} %"
        return f"{names[pair['better'] - 1]} {relation} {names[pair['worse'] - 1]} (confidence {confidence})"

    lines = [
        f"Order, smallest measured error first: {', '.join(names[i - 1] for i in order['ranking'])}. "
        f"{order['distinguished']} of {order['pairs']} pairs can be told apart, all together at level "
        f"{order['level']:g}."
    ]
    # Of each, only the nearest one below it that can be told apart: those further down add little.
    places = {number: place for place, number in enumerate(order["ranking"])}
    nearest: dict[int, dict[str, Any]] = {}
    for pair in sorted(order["distinctions"], key=lambda pair: places[pair["worse"]]):
        nearest.setdefault(places[pair["better"]], pair)
    lines += [_agents_first(named(pair)) for _, pair in sorted(nearest.items())[:most]]
    if order["ties"] and order["distinguished"]:
        ties = [f"{names[a - 1]} and {names[b - 1]}" for a, b in order["ties"][:most]]
        lines.append(f"Not told apart: {'; '.join(ties)}.")
    for pair in order["contradictions"][:most]:
        expected = "the other way round" if pair["predicted"] is False else "as equal"
        lines.append(f"But predicted {expected}: {named(pair)}.")
    return lines
