"""Tables for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]], names: int = 1) -> str:
    """A table in Markdown.

    Parameters
    ----------
    heads
        of the columns
    rows
        one cell for each head
    names
        how many columns at the left are words; the others are numbers, and stand at the right of their cells
    """
    lines = [heads, ["---"] * names + ["---:"] * (len(heads) - names), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def number_text(value: float | None) -> str:
    """Six digits; a dash for what is undefined.

    Parameters
    ----------
    value
        any number, infinite ones too
    """
    return "-" if value is None else f"{value:.6g}"
