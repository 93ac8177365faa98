"""Numbers as words of a sentence."""

from __future__ import annotations


def percent(share: float) -> str:
    """A share from 0 to 1 in percent, with three digits; never "0 %" or "100 %" for a share in between."""
    value = 100.0 * share
    if 0.0 < value < 0.01:
        return "less than 0.01 %"
    return "more than 99.9 %" if 99.9 < value < 100.0 else f"{value:.3g} %"


def counted(number: int, thing: str) -> str:
    """A number and a noun whose plural ends with s: ``1 step``, ``2 steps``."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
