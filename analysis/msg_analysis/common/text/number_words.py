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

"""Numbers as text: in tables, and as words of a sentence."""

from __future__ import annotations

from collections.abc import Sequence


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
