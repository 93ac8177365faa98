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

"""Lists of runs for a terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from msg_analysis.common.text.number_words import counted, half_width_text, number_text, z_text
from msg_analysis.report.terminal.tables import number_table, print_table, room_for_names
from msg_analysis.runs.run_list import RunEntry

_STYLES = {"agrees": "green", "disagrees": "bold red", "incomplete": "yellow"}


def print_runs(runs: Sequence[RunEntry], folder: Path, total: int, console: Console) -> None:
    """Print the runs as a table, one line each; ``total``: how many there are in the folder."""
    if not runs:
        console.print(Text(f"{folder}: no run" if not total else f"{folder}: none of {counted(total, 'run')}"))
        return
    heads = ["run", "experiment", "date", "seed", "verdict", "system error", "± (95 %)", "predicted", "z"]
    rows = [
        [
            run.name or "-",
            f"{run.date:%Y-%m-%d %H:%M}",
            "-" if run.seed is None else str(run.seed),
            run.verdict or run.status,
            number_text(run.measured),
            half_width_text((run.low, run.high)),
            number_text(run.predicted),
            z_text(run.z),
        ]
        for run in runs
    ]
    if all(Path(run.folder).name.startswith(f"{run.name}_{run.date:%Y%m%d_%H%M}") for run in runs):
        heads.remove("experiment")  # the names of the folders have it, and the date
        heads.remove("date")
        rows = [row[2:] for row in rows]
    empty = {place for place in range(len(rows[0])) if {row[place] for row in rows} == {"-"}}
    heads = [heads[0], *(head for place, head in enumerate(heads[1:]) if place not in empty)]
    rows = [[cell for place, cell in enumerate(row) if place not in empty] for row in rows]
    room = max(room_for_names(console, heads[1:], rows), max(len(Path(run.folder).name) for run in runs))
    table = number_table(console, f"Runs in {folder}", *heads)
    verdict = heads.index("verdict")
    table.columns[0].min_width = min(room, max(len(Path(run.folder).name) for run in runs))
    for run, row in zip(runs, rows, strict=True):
        style = _STYLES.get(run.verdict or "", "dim" if run.verdict is None else "")
        cells = [Text(cell, style=style if place == verdict else "") for place, cell in enumerate(row, start=1)]
        table.add_row(Text(Path(run.folder).name), *cells)
    print_table(console, table)
    counts = Counter(run.verdict or run.status for run in runs)
    listed = ", ".join(f"{number} {word}" for word, number in counts.most_common())
    console.print(Text(f"{counted(len(runs), 'run')}{f' of {total}' if len(runs) < total else ''}: {listed}"))
    for run in runs:
        if run.status == "damaged" and run.problem:
            console.print(Text(f"damaged: {run.problem}", style="yellow"))
