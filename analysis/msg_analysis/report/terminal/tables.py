"""What all terminal tables share: layout, and numbers as text."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msg_analysis.common.markdown import number_text as number_text

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


def note_cut(table: Table, total: int, what: str) -> None:
    """Caption a table, of the first ``ROWS`` of ``total`` rows, with how many rows (``what``) are left out."""
    if total > ROWS:
        table.caption = f"{total - ROWS} more {what}: use --json"


def z_text(value: float | None) -> str:
    """A z with its sign; "-" for None."""
    return "-" if value is None else f"{value:+.2f}"


def p_text(value: float | None) -> str:
    """Three significant digits; "-" for None."""
    return "-" if value is None else f"{value:.3g}"


def interval_text(interval: Sequence[float | None] | None) -> str:
    """Low .. high; "-" if either is not known."""
    if not interval or None in interval:
        return "-"
    return f"{number_text(interval[0])} .. {number_text(interval[1])}"
