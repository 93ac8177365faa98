"""Markdown tables for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]], names: int = 1) -> str:
    """A Markdown table; the first ``names`` columns hold words, the others right-aligned numbers."""
    lines = [heads, ["---"] * names + ["---:"] * (len(heads) - names), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
