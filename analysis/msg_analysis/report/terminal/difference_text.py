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

"""Differences of two runs or two experiments for a terminal, from the documents of ``msg-analysis diff --json``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.common.text.agent_names import agent_name, agent_text
from msg_analysis.common.text.number_words import counted, listed, measured_text, number_text, percent, z_text
from msg_analysis.model.experiment.problems import show
from msg_analysis.report.terminal.tables import fact_table, first_rows, number_table, print_table
from msg_analysis.theory.prediction import LAW_NAMES

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
    _print_errors(document["errors"], _names(document), console)
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


def _print_errors(errors: dict[str, Any], names: Sequence[str] | None, console: Console) -> None:
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
