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

"""Measured numbers with their 95 % intervals: as text, and as small bars around the prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape

from msg_analysis.common.text.number_words import z_text

_LEAST_REACH = 0.02  # relative deviation at the ends of the narrowest scale


def plus_minus(measured: float | None, interval: Sequence[float | None]) -> str:
    """``1.722 ± 0.146``: four digits or more, so that the half-width has two; "–" for None."""
    if measured is None:
        return "–"
    low, high = interval
    half = None if low is None or high is None else (high - low) / 2
    size = abs(measured)
    if size != 0.0 and not 1e-3 <= size < 1e6:
        text = f"{measured:#.4g}" + ("" if half is None else f" ± {half:.2g}")
    else:
        digits = 3 - (math.floor(math.log10(size)) if size else 0)
        if half:
            digits = max(digits, 1 - math.floor(math.log10(half)))
        digits = min(max(digits, 0), 9)
        text = f"{measured:.{digits}f}" + ("" if half is None else f" ± {half:.{digits}f}")
    return text.replace("-", "−")


def interval_bars(estimates: Sequence[Mapping[str, Any]]) -> list[Markup]:
    """A bar per estimate, relative to its prediction, which is in the middle; all have the same scale.

    Empty where nothing is measured or predicted.
    """
    ends = [_relative(estimate) for estimate in estimates]
    reach = max((abs(value) for found in ends if found for value in found), default=0.0)
    reach = 1.05 * max(reach, _LEAST_REACH)
    return [_bar(estimate, found, reach) for estimate, found in zip(estimates, ends, strict=True)]


def _relative(estimate: Mapping[str, Any]) -> tuple[float, ...] | None:
    """Measured value and, where known, the ends of its interval, as relative deviations from the prediction."""
    measured, predicted = estimate["measured"], estimate["predicted"]
    if measured is None or predicted is None or predicted <= 0.0:
        return None
    known = [measured, *(end for end in estimate["interval"] if end is not None)]
    found = tuple(value / predicted - 1.0 for value in known)
    return found if all(map(math.isfinite, found)) else None


def _bar(estimate: Mapping[str, Any], found: tuple[float, ...] | None, reach: float) -> Markup:
    if found is None:
        return Markup("")
    places = [50.0 + 50.0 * value / reach for value in found]
    apart, line = False, ""
    if len(places) == 3:
        apart = not found[1] <= 0.0 <= found[2]
        line = f'<i style="left:{places[1]:.1f}%;width:{places[2] - places[1]:.1f}%"></i>'
    words = f"{100 * found[0]:+.2g} % of the prediction"
    if estimate.get("z") is not None:
        words += f"; z = {z_text(estimate['z'])}"
    words = words.replace("-", "−")
    return Markup(
        f'<span class="bar{" apart" if apart else ""}" title="{escape(words)}">{line}'
        f'<b style="left:{places[0]:.1f}%"></b><span class="hidden">{escape(words)}</span></span>'
    )
