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

"""Points of several series side by side, so that their intervals do not overlap."""

from __future__ import annotations

import numpy as np

from msg_analysis.types import FloatArray

_FREE = 0.4  # of the way to the next value: left free between the points of two values
_MOST = 0.02  # of the axis, between two series


def shifted(places: FloatArray, values: FloatArray, series: int, count: int, *, logarithmic: bool) -> FloatArray:
    """Places along the axis of the points of a series, of ``count``, from 0; ``values``: those of all series."""
    if count < 2:
        return places
    known = np.unique(np.log(values) if logarithmic else values)
    gaps = np.diff(known)
    length = float(known[-1] - known[0]) if len(known) > 1 else 1.0
    nearest = float(gaps.min()) if len(gaps) else length
    step = min((1 - _FREE) * nearest / count, _MOST * length)
    way = (series - (count - 1) / 2) * step
    return places * np.exp(way) if logarithmic else places + way
