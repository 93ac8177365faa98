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

"""Two values side by side: what ``diff`` says of keys, numbers and measured errors. Differences are B - A."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The keys whose values differ, in the order of ``a``: ``key``, ``a``, ``b``; None where one does not have it."""
    return [
        {"key": key, "a": a.get(key), "b": b.get(key)}
        for key in [*a, *(key for key in b if key not in a)]
        if a.get(key) != b.get(key)
    ]


def relative(a: float | None, b: float | None) -> dict[str, float | None]:
    """Two numbers, and their difference relative to ``a``; None where that is 0, or one is not there."""
    known = a is not None and b is not None
    return {"a": a, "b": b, "relative": (b - a) / abs(a) if known and a and b is not None else None}


def measured(a: Mapping[str, Any] | None, b: Mapping[str, Any] | None) -> dict[str, Any]:
    """Two measured errors with ``measured`` and ``standard_error``: their difference, and it in standard errors, ``z``.

    The standard error of the difference is that of independent runs; None where one is not known.
    """
    one, other = a or {}, b or {}
    difference = error = None
    if one.get("measured") is not None and other.get("measured") is not None:
        difference = other["measured"] - one["measured"]
    if one.get("standard_error") is not None and other.get("standard_error") is not None:
        error = math.hypot(one["standard_error"], other["standard_error"])
    z = difference / error if difference is not None and error else None
    return {"a": a, "b": b, "difference": difference, "standard_error": error, "z": z}
