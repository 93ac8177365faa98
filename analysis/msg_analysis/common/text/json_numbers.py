"""JSON documents. JSON has no infinite or undefined numbers: they become null."""

from __future__ import annotations

import json
import math
from typing import Any


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
