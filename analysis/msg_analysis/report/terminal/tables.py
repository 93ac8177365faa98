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

"""Layout of terminal tables."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TypeVar

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text.number_words import number_text

Row = TypeVar("Row")

MARGIN = 3  # of every column: padding, and the line of the box
LEAST_NAME = 12  # characters for names, however narrow the terminal is
_NUMBER = re.compile(r"[-+0-9.e%±<>∞… ]*(inf|nan)?")
ROWS = 30
"""Most rows of a table; --json has them all."""


def number_table(console: Console, title: str, first: str, *numbers: str) -> Table:
    """Print the heading, and make a table with one column of names and further ones of numbers."""
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(Text(first))
    for number in numbers:
        table.add_column(Text(number), justify="right")
    return table


def print_table(console: Console, table: Table) -> None:
    """Print a table of ``number_table``: a narrow terminal folds words and headings, but never cuts a number."""
    heads = [str(column.header) for column in table.columns]
    cells = [[str(cell) for cell in column.cells] for column in table.columns]
    widest = sum(MARGIN + max(map(cell_len, [head, *column])) for head, column in zip(heads, cells, strict=True))
    width = console.width
    if widest > console.width:
        for column, head, texts in zip(table.columns[1:], heads[1:], cells[1:], strict=True):
            column.min_width = _least_width(head, texts)
            if all(map(_NUMBER.fullmatch, texts)):
                column.width = column.min_width
        least = 1 + sum(MARGIN + (column.min_width or 0) for column in table.columns[1:])
        console.width = max(width, least + MARGIN + (table.columns[0].min_width or LEAST_NAME))
    console.print(table)
    console.width = width


def room_for_names(console: Console, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Characters for each name of a ``number_table`` with these columns of numbers, and rows without the name."""
    columns = list(zip(*rows, strict=True))
    numbers = sum(MARGIN + _least_width(head, column) for head, column in zip(heads, columns, strict=True))
    return max(LEAST_NAME, console.width - numbers - MARGIN - 1)


def _least_width(head: str, cells: Sequence[str]) -> int:
    """Of a column whose heading and words may be folded, but not its numbers."""
    parts = [part for cell in cells for part in ([cell] if _NUMBER.fullmatch(cell) else cell.split(" "))]
    return max(map(cell_len, [*head.split(" "), *parts]), default=0)


def fact_table(console: Console, title: str) -> Table:
    """Print the heading, and make a table of names and values."""
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def first_rows(table: Table, rows: Iterable[Row], what: str, where: str = "--json") -> list[Row]:
    """The first ``ROWS`` rows for a table; a caption says how many (``what``) are left out, and where they are."""
    shown = list(rows)
    if len(shown) > ROWS:
        table.caption = f"{len(shown) - ROWS} more {what}: use {where}"
    return shown[:ROWS]


def interval_text(interval: Sequence[float | None] | None) -> str:
    """Low .. high; "-" if either is not known."""
    if not interval or None in interval:
        return "-"
    return f"{number_text(interval[0])} .. {number_text(interval[1])}"
