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

"""Terminal tables of what a bag holds, and of what was salvaged from one."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text.number_words import counted, number_text
from msg_analysis.model.experiment.memory import amount
from msg_analysis.report.documents.comparison_words import gaps
from msg_analysis.report.terminal.experiment_text import add_protocol
from msg_analysis.report.terminal.tables import fact_table

_TOPICS = 12  # most topics listed; --json has all


def print_bag(document: dict[str, Any], console: Console) -> None:
    """Print what a bag holds: a document of ``msg_analysis.report.documents.info.describe_bag``."""
    facts = fact_table(console, document["bag"])
    if document["recording"]:
        facts.add_row("recording", f"process {document['recording']} is still writing it")
    if document["problem"]:
        facts.add_row("not a run", Text(document["problem"], style="yellow"))
    else:
        _add_run(facts, document)
    topics = document["topics"]
    for topic in topics[:_TOPICS]:
        facts.add_row("topic", Text(f"{topic['name']}, {counted(topic['messages'], 'message')}, {topic['type']}"))
    if len(topics) > _TOPICS:
        more = sum(topic["messages"] for topic in topics[_TOPICS:])
        facts.add_row("topic", f"and {len(topics) - _TOPICS} more with {counted(more, 'message')}")
    for file in document["files"]:
        facts.add_row("file", Text(f"{file['name']}, {amount(file['size'])}{_state_of(file)}"))
    for name, version in document["versions"].items():
        facts.add_row(Text(name), Text(str(version)))
    console.print(facts)


def _add_run(facts: Table, document: dict[str, Any]) -> None:
    count = document["completeness"]
    facts.add_row("run", document["run"])
    facts.add_row("experiment", f"{document['experiment']}, seed {document['seed']}")
    add_protocol(facts, document.get("protocol"))
    facts.add_row("agents, replicas", f"{document['agents']}, {document['replicas']}")
    facts.add_row("steps", f"{document['steps']}, {number_text(document['simulated_time'])} units of time")
    state = "complete" if count["complete"] else "incomplete"
    facts.add_row("states", f"{state}: {count['received']} of {count['expected']}, {count['missing']} missing")
    for line in gaps(count | {"refused": {}}):
        facts.add_row("", line)
    facts.add_row("duplicates, out of order", f"{count['duplicates']}, {count['out_of_order']}")
    facts.add_row("steps without a graph", str(count["missing_modes"]))
    for reason, number in count["refused"].items():
        facts.add_row("refused", Text(f"{number}: {reason}"))


def _state_of(file: dict[str, Any]) -> str:
    """Text behind the size of a file: messages, compression, damage; "" for a file that is not part of the bag."""
    if "messages" not in file:
        return ""
    words = [counted(file["messages"], "message")]
    if file["compression"]:
        words.append(str(file["compression"]))
    if file["torn"]:
        words.append(f"torn: {file['torn']}")
    if file["damaged_chunks"]:
        lost = f", {counted(file['lost_messages'], 'message')} lost" if file["lost_messages"] else ""
        words.append(f"{counted(file['damaged_chunks'], 'damaged chunk')}{lost}")
    if file["problem"]:
        words.append(file["problem"])
    return ": " + ", ".join(words)


def print_salvage(document: dict[str, Any], console: Console) -> None:
    """Print what was saved of a torn bag and what was dropped: a document of ``info.describe_salvage``."""
    facts = fact_table(console, document["bag"])
    facts.add_row("kept", counted(document["kept_messages"], "message"))
    dropped = (
        [f"{amount(document['dropped_bytes'])} after the last complete record"] if document["dropped_bytes"] else []
    )
    if document["damaged_chunks"]:
        known = f" with {counted(document['lost_messages'], 'message')}" if document["lost_messages"] else ""
        dropped.append(f"{counted(document['damaged_chunks'], 'damaged chunk')}{known}")
    if document["dropped_files"]:
        dropped.append(counted(document["dropped_files"], "unreadable file"))
    facts.add_row("dropped", ", ".join(dropped) or "nothing")
    if document["torn"]:
        facts.add_row("torn", Text(document["torn"]))
    if document["problem"]:
        facts.add_row("not a run", Text(document["problem"], style="yellow"))
    else:
        _add_run(facts, document)
    console.print(facts)
