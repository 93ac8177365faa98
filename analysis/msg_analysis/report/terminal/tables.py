"""Layout of terminal tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.text.number_words import number_text

Row = TypeVar("Row")

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


def fact_table(console: Console, title: str) -> Table:
    """Print the heading, and make a table of names and values."""
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def listed(values: Sequence[Any], longest: int = 12) -> str:
    """The values, separated by commas; of more than ``longest``, how many are left out."""
    more = f", and {len(values) - longest} more" if len(values) > longest else ""
    return ", ".join(str(value) for value in values[:longest]) + more


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
