"""Numbers in JSON documents, which has none that are infinite or undefined."""

from __future__ import annotations

import math
from typing import Any


def finite(value: Any) -> Any:
    """A copy of the document with None in place of infinite numbers and NaN; tuples become lists."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
