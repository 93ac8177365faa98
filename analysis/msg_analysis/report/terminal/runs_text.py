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
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.cells import cell_len
from rich.console import Console
from rich.text import Text

from msg_analysis.common.text.number_words import counted, half_width_text, number_text, z_text
from msg_analysis.report.terminal.tables import MARGIN, number_table
from msg_analysis.runs.run_list import RunEntry

_STYLES = {"agrees": "green", "disagrees": "bold red", "incomplete": "yellow"}


_LEAST_NAME = 12  # characters of a folder's name that are shown
_OPTIONAL = ("predicted", "z", "± (95 %)")  # left out in this order where the terminal is too narrow


def print_runs(runs: Sequence[RunEntry], folder: Path, total: int, console: Console) -> None:
    """Print the runs as a table, one line each; ``total``: how many there are in the folder."""
    if not runs:
        console.print(Text(f"{folder}: no run" if not total else f"{folder}: none of {counted(total, 'run')}"))
        return
    heads = ["run", "experiment", "date", "seed", "verdict", "system error", "± (95 %)", "predicted", "z"]
    rows = [
        [
            Path(run.folder).name,
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
    columns: dict[str, Sequence[str]] = dict(zip(heads, zip(*rows, strict=True), strict=True))
    if all(Path(run.folder).name.startswith(f"{run.name}_{run.date:%Y%m%d_%H%M}") for run in runs):
        del columns["experiment"], columns["date"]  # the names of the folders have them
    columns = {head: cells for head, cells in columns.items() if set(cells) != {"-"}}
    for head in _OPTIONAL:
        if _width(columns) > console.width:
            columns.pop(head, None)
    room = console.width - _width(columns) + _widest(columns["run"])
    columns["run"] = [_cut(name, max(room, _LEAST_NAME)) for name in columns["run"]]
    table = number_table(console, f"Runs in {folder}", *columns)
    for run, cells in zip(runs, zip(*columns.values(), strict=True), strict=True):
        style = _STYLES.get(run.verdict or "", "dim" if run.verdict is None else "")
        table.add_row(
            *(Text(cell, style if head == "verdict" else "") for head, cell in zip(columns, cells, strict=True))
        )
    width = console.width
    console.width = max(width, _width(columns))  # a line of its own for each run
    console.print(table)
    console.width = width
    counts = Counter(run.verdict or run.status for run in runs)
    listed = ", ".join(f"{number} {word}" for word, number in counts.most_common())
    console.print(Text(f"{counted(len(runs), 'run')}{f' of {total}' if len(runs) < total else ''}: {listed}"))
    for run in runs:
        if run.status == "damaged" and run.problem:
            console.print(Text(f"damaged: {run.problem}", style="yellow"))


def _width(columns: Mapping[str, Sequence[str]]) -> int:
    return 1 + sum(MARGIN + _widest((head, *cells)) for head, cells in columns.items())


def _widest(cells: Sequence[str]) -> int:
    return max(map(cell_len, cells))


def _cut(name: str, width: int) -> str:
    """The name without its middle where it is longer: folders differ at their ends."""
    left = width // 2 - 1
    return name if cell_len(name) <= width else f"{name[:left]}…{name[left + 1 - width :]}"
