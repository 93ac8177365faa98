# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Numbers, agents and tables as text; text that is safe for terminals."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

HALF_WIDTH_95 = 1.959963984540054
"""Half-width of a 95 % interval, in standard errors."""


def number_text(value: float | None, digits: int = 6) -> str:
    """Significant digits, six unless told otherwise; "-" for None."""
    return "-" if value is None else f"{value:.{digits}g}"


def z_text(value: float | None) -> str:
    """A z with its sign; "-" for None."""
    return "-" if value is None else f"{value:+.2f}"


def p_text(value: float | None) -> str:
    """Three significant digits; "-" for None."""
    return number_text(value, 3)


def half_width_text(interval: Sequence[float | None] | None) -> str:
    """Half the width of an interval around a measured value, two digits: the number after ±; "-" if not known."""
    low, high = interval or (None, None)
    return "-" if low is None or high is None else number_text((high - low) / 2, 2)


def measured_text(value: float | None, interval: Sequence[float | None] | None) -> str:
    """A measured value with its 95 % interval: ``1.72 ± 0.15 (95 %)``; without one, the value alone."""
    half = half_width_text(interval)
    return number_text(value) + ("" if half == "-" else f" ± {half} (95 %)")


def percent(share: float) -> str:
    """A share from 0 to 1 in percent, with three digits; never "0 %" or "100 %" for a share in between."""
    value = 100.0 * share
    if 0.0 < value < 0.01:
        return "less than 0.01 %"
    return "more than 99.9 %" if 99.9 < value < 100.0 else f"{value:.3g} %"


def counted(number: int, thing: str) -> str:
    """A number and a noun whose plural ends with s: ``1 step``, ``2 steps``."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def listed(values: Sequence[object], longest: int = 12) -> str:
    """The values, separated by commas; of more than ``longest``, how many are left out."""
    more = f", and {len(values) - longest} more" if len(values) > longest else ""
    return ", ".join(str(value) for value in values[:longest]) + more


def duration_text(seconds: float) -> str:
    """A duration in its two largest units, up to hours: ``57 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    return f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"


_NUMBER = r"(?<![\w.])\d+(?!\w|\.\d)"
_AGENTS = re.compile(rf"\b([Aa]gents? )({_NUMBER}(?:(?:,| and|, and) {_NUMBER})*)(?! to \d)")


def agent_name(number: int, names: Sequence[str] | None) -> str:
    """The name of an agent, or its number; the latter, too, where there is no such agent."""
    return names[number - 1] if names and 1 <= number <= len(names) else str(number)


def agent_text(number: int, names: Sequence[str] | None) -> str:
    """``agent 3``, or ``agent north``."""
    return f"agent {agent_name(number, names)}"


def with_names(text: str, names: Sequence[str] | None) -> str:
    """The text with names instead of numbers after the word "agent" or "agents": in results, agents have numbers."""
    if not names:
        return text
    return _AGENTS.sub(lambda found: found[1] + re.sub(r"\d+", lambda n: agent_name(int(n[0]), names), found[2]), text)


def finite(value: Any) -> Any:
    """A copy of the document with None in place of infinite numbers and NaN; tuples become lists."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(document: Any, indent: int | None = None) -> str:
    """The document as JSON."""
    return json.dumps(finite(document), indent=indent, allow_nan=False)


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]], names: int = 1) -> str:
    """A Markdown table; the first ``names`` columns hold words, the others right-aligned numbers."""
    lines = [heads, ["---"] * names + ["---:"] * (len(heads) - names), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


_ORDER = {*range(0x202A, 0x202F), *range(0x2066, 0x206A)}  # characters that change the order of those after them
_SHOWN = {
    code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
    for code in [*range(0x20), *range(0x7F, 0xA0), *_ORDER]
    if chr(code) not in "\n\t"
}


def visible(text: str) -> str:
    """The text with its control characters written as escapes; line ends and tabs stay."""
    return text.translate(_SHOWN)


def amount(size: float) -> str:
    """A number of bytes as text with a unit: ``1.5 GB``."""
    units = ["B", "kB", "MB", "GB", "TB"]
    while size >= 1000 and len(units) > 1:
        size /= 1000
        units.pop(0)
    return f"{size:.3g} {units[0]}"
