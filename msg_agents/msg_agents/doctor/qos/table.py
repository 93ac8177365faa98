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

"""The matrix as tables, for terminals and as Markdown, and what it says in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from msg_agents.doctor.qos.matrix import Matrix
from msg_agents.doctor.qos.tally import VIOLATIONS, CellResult, quantile, rate
from msg_analysis.common.text.markdown import markdown_table
from msg_analysis.common.text.number_words import counted, number_text

if TYPE_CHECKING:
    from rich.console import Console

HEADS = (
    *("history", "reader", "readers", "ROS 2"),
    *("tries", "against ROS 2, % (95 %)", "with loss, % (95 %)"),
    *("sent", "received", "lost", "doubled", "out of order", "median ms", "99 % ms"),
)
WORDS = 4  # columns of words


def markdown(matrix: Matrix) -> str:
    """A table for each reliability and durability, behind a line that names them."""
    parts = [
        f"**{title}**\n\n{markdown_table(HEADS, [row_of(cell) for cell in cells], WORDS)}"
        for title, cells in _groups(matrix.cells)
    ]
    return "\n".join([*parts, f"{summary(matrix)}\n"])


def print_matrix(console: Console, matrix: Matrix) -> None:
    """The same tables without the intervals, and the summary, on a terminal."""
    from msg_analysis.report.terminal.tables import number_table, print_table

    names = [" ".join(cell.cell.words[2:]) for cell in matrix.cells]
    for title, cells in _groups(matrix.cells):
        table = number_table(console, title, "cell", HEADS[3], HEADS[4], *HEADS[7:])
        table.columns[0].min_width = max(map(len, names))
        for cell in cells:
            row = row_of(cell)
            table.add_row(" ".join(row[:3]), row[3], row[4], *row[7:])
        print_table(console, table)
    console.print(summary(matrix), soft_wrap=True)


def row_of(cell: CellResult) -> list[str]:
    """The cells of one row, in the order of ``HEADS``."""
    total, tries = cell.total, len(cell.made)
    return [
        *cell.cell.words[2:],
        verdict_of(cell),
        str(tries),
        _percent(cell.violating, tries),
        _percent(cell.tries_with("lost"), tries),
        str(sum(each.sent for each in cell.made)),
        str(total.received),
        str(total.lost),
        str(total.doubled),
        str(total.out_of_order),
        *(_milliseconds(value) for value in (quantile(total.latencies, 0.5), quantile(total.latencies, 0.99))),
    ]


def verdict_of(cell: CellResult) -> str:
    """Whether the cell meets what ROS 2 demands, or in how many tries it does not."""
    found = []
    for what in VIOLATIONS:
        if count := cell.tries_with(what):
            found.append(f"{what.replace('_', ' ')} in {_percent(count, len(cell.made))} % of tries")
    if not_counted := len(cell.tries) - len(cell.made):
        found.append(f"{not_counted} not counted")
    return "; ".join(found) or "ok"


def summary(matrix: Matrix) -> str:
    """The result in one line."""
    name = f"{matrix.middleware} of {matrix.distribution.capitalize()}"
    tries = sum(len(cell.made) for cell in matrix.cells)
    scope = f"{counted(len(matrix.cells), 'cell')}, {'1 try' if tries == 1 else f'{tries} tries'}"
    bad = len(matrix.violating)
    found = f"{bad} of them contradict ROS 2" if bad else "all as ROS 2 demands"
    if matrix.not_counted:
        found += (
            f"; not counted: {matrix.not_counted} (processes did not find each other, or were stopped for too long)"
        )
    return f"{name}: {scope}: {found}."


def _groups(cells: Sequence[CellResult]) -> list[tuple[str, list[CellResult]]]:
    grouped = groupby(cells, key=lambda cell: ", ".join(cell.cell.words[:2]).replace("_", " "))
    return [(title, list(group)) for title, group in grouped]


def _percent(count: int, tries: int) -> str:
    found = rate(count, tries)
    share = 100 * count / tries if tries else float("nan")
    return f"{share:.3g} ({100 * found['low']:.2g} to {100 * found['high']:.3g})"


def _milliseconds(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1e3 * seconds:.0f}" if seconds > 0.1 else number_text(1e3 * seconds, 2)
