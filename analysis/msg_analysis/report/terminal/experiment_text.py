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

"""Experiments as terminal tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text.agent_names import agent_name
from msg_analysis.common.text.number_words import listed, number_text
from msg_analysis.model.experiment.memory import amount
from msg_analysis.report.terminal.tables import ROWS, fact_table, number_table


def print_experiment(document: dict[str, Any], console: Console) -> None:
    """Print an experiment: a document of ``info.describe_experiment``."""
    run, names = document["run"], document.get("names")
    facts = fact_table(console, document["name"])
    facts.add_row("problem", f"{document['problem']} of {document['agents']} agents in {document['time']} time")
    if names:
        facts.add_row("agents", Text(listed(names)))
    if document["leaders"]:
        leaders = document["leaders"]
        named = listed([agent_name(agent, names) for agent in leaders["agents"]])
        text = f"{named}, gain {leaders['gain']}, reference {leaders['reference']}"
        facts.add_row("leaders", Text(text))
    add_protocol(facts, document.get("protocol"))
    facts.add_row("noise", Text(_noise(document["noise"], names)))
    facts.add_row("steps", f"{run['steps']} of {number_text(run['dt'])}, {number_text(run['duration'])} units of time")
    facts.add_row("stability limit of dt", number_text(document["stability_limit"]))
    facts.add_row("replicas", str(run["replicas"]))
    facts.add_row("seed", str(run["seed"]))
    facts.add_row("start", f"{_short(run['start'])}, first graph {document['switching']['initial']}")
    facts.add_row("pace", f"{run['pace']}, processes {run['processes']}")
    facts.add_row("predicted system error", number_text(document["predicted_system_error"]))
    memory = document["memory"]
    facts.add_row("memory", f"states {amount(memory['states'])}, graphs {amount(memory['matrices'])}")
    facts.add_row("can be run", "yes" if not document["unavailable"] else "no")
    console.print(facts)
    columns = ("connectivity", "share", "held for", "dt limit")
    graphs = number_table(console, "Graphs", "graph", *columns)
    graphs.add_column("links", overflow="fold")
    for graph in document["graphs"]:
        graphs.add_row(
            Text(graph["name"]),
            number_text(graph["algebraic_connectivity"]),
            number_text(graph["stationary"]),
            number_text(graph["mean_holding_time"]),
            number_text(graph["stability_limit"]),
            Text(_links(graph, names)),
        )
    console.print(graphs)
    switching = document["switching"]
    title = "Switching rates" if document["time"] == "continuous" else "Switching probabilities"
    modes = [graph["name"] for graph in document["graphs"]]
    if 1 < len(modes) <= ROWS:
        chain = number_table(console, title, "from / to", *modes)
        for name, row in zip(modes, switching["matrix"], strict=True):
            chain.add_row(Text(name), *map(number_text, row))
        console.print(chain)
    for line in document["unavailable"]:
        console.print(Text(line, style="yellow"))
    if document["predicted_system_error"]:
        console.print("How long to run it, and what it will find: msg-analysis plan", style="dim")


def add_protocol(facts: Table, protocol: dict[str, Any] | None) -> None:
    """Add rows for the protocol of a document of ``info``; none for the built-in law (None)."""
    if protocol is None:
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


def _links(graph: dict[str, Any], names: Sequence[str] | None) -> str:
    """``1-2, 2-3 (0.5)`` for edges, ``1>2`` for arcs (2 hears 1)."""
    sign, links = ("-", graph["edges"]) if graph["edges"] is not None else (">", graph["arcs"])
    ends = [(agent_name(i, names), agent_name(j, names), weight) for i, j, weight in links]
    return listed([f"{i}{sign}{j}" + (f" ({weight:g})" if weight != 1 else "") for i, j, weight in ends]) or "none"
