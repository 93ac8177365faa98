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

"""A sweep as a terminal table, and as a document."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from msg_analysis.common.text.number_words import half_width_text, number_text, p_text
from msg_analysis.report.terminal.tables import ROWS, first_rows, number_table, print_table
from msg_analysis.sweep.conduct import Conducted, Judgement
from msg_analysis.sweep.figure_series import Picture, value_text
from msg_analysis.sweep.jobs.job import FAILED
from msg_analysis.sweep.plan import Sweep
from msg_analysis.sweep.table import Row


def describe_sweep(sweep: Sweep, done: Conducted, judgement: Judgement, rows: Sequence[Row]) -> dict[str, Any]:
    """The document of ``msg-analysis sweep --json``, without the names of the files; ``rows`` of ``rows_of``."""
    failed = sum(outcome.status == FAILED for outcome in done.outcomes)
    return {
        "sweep": sweep.name,
        "experiment": sweep.experiment,
        "kind": sweep.kind,
        "keys": list(sweep.keys),
        "level": sweep.spec.level,
        "verdict": judgement.verdict,
        "done": len(rows) - failed,
        "failed": failed,
        "kept": done.kept,
        "points": list(rows),
    }


def print_sweep(sweep: Sweep, document: dict[str, Any], picture: Picture, console: Console) -> None:
    """Print a table of what the figure shows, what failed, and the verdict; ``document`` of ``describe_sweep``."""
    heads = ["measured", "± (95 %)", "predicted"] if picture.measured else [picture.y, "in continuous time"]
    several = len(picture.series) > 1
    first = [picture.x] if several else []
    table = number_table(console, f"{sweep.name}: {picture.y}", "" if several else picture.x, *first, *heads)
    places = [(series.label, place) for series in picture.series for place in series.places]
    for label, place in first_rows(table, places, "rows"):
        numbers = [number_text(place.value)]
        if picture.measured:
            numbers += [half_width_text((place.low, place.high)), number_text(place.predicted)]
        else:
            numbers += [number_text(place.reference)]
        table.add_row(*([Text(label)] if several else []), Text(value_text(place.x)), *numbers)
    print_table(console, table)
    for row in [row for row in document["points"] if row["status"] == FAILED][:ROWS]:
        console.print(Text(f"point {row['point']}: no result: {row['reason']}"))
    for row in [row for row in document["points"] if row.get("verdict") == "disagrees"][:ROWS]:
        why = row.get("blame") or row.get("least")
        console.print(Text(f"point {row['point']} disagrees with its prediction (p = {p_text(row['p_holm'])}): {why}"))
    console.print(Text(summary(document)))


def summary(document: dict[str, Any]) -> str:
    """How many points, and what came of them; ``document`` of ``describe_sweep``."""
    count = len(document["points"])
    what = {"predict": "predictions", "simulate": "runs simulated", "network": "networks run"}[document["kind"]]
    text = f"{count} {what}"
    if document["kept"]:
        text += f", {document['kept']} of them from an earlier sweep"
    if document["failed"]:
        text += f"; {document['failed']} without a result"
    tested = [row["p_holm"] for row in document["points"] if row.get("p_holm") is not None]
    if tested:
        apart = sum(row.get("verdict") == "disagrees" for row in document["points"])
        text += f". {apart or 'None'} of {len(tested)} {'disagree' if apart > 1 else 'disagrees'} with its prediction"
        text += f" (Holm over all points, level {document['level']:g}; smallest p {min(tested):.3g})"
    return text + "."
