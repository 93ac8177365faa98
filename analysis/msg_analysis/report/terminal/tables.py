"""Tables for a terminal: what all of them have in common."""

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
    """A table under its heading: one column of names, the others of numbers.

    Parameters
    ----------
    console
        where the heading goes
    title
        of the table
    first
        head of the column of names
    *numbers
        heads of the other columns
    """
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(Text(first))
    for number in numbers:
        table.add_column(Text(number), justify="right")
    return table


def fact_table(console: Console, title: str) -> Table:
    """A table of names and what they are, under its heading.

    Parameters
    ----------
    console
        where the heading goes
    title
        of the table
    """
    console.print(Text(title, style="bold"))
    table = Table(box=box.SIMPLE, show_header=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def note_cut(table: Table, total: int, what: str) -> None:
    """Say how many rows of the total are not shown.

    Parameters
    ----------
    table
        that shows the first ``ROWS``
    total
        number of rows
    what
        the rows are
    """
    if total > ROWS:
        table.caption = f"{total - ROWS} more {what}: use --json"


def z_text(value: float | None) -> str:
    """With its sign.

    Parameters
    ----------
    value
        z, if there is one
    """
    return "-" if value is None else f"{value:+.2f}"


def p_text(value: float | None) -> str:
    """Three digits.

    Parameters
    ----------
    value
        p, if there is one
    """
    return "-" if value is None else f"{value:.3g}"


def interval_text(interval: Sequence[float | None] | None) -> str:
    """Low .. high.

    Parameters
    ----------
    interval
        low and high, if known
    """
    if not interval or None in interval:
        return "-"
    return f"{number_text(interval[0])} .. {number_text(interval[1])}"
