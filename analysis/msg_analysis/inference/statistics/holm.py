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

"""Holm's step-down adjustment of many tests to one level."""

from __future__ import annotations

import numpy as np

from msg_analysis.types import FloatArray


def holm(p_values: FloatArray) -> FloatArray:
    """Adjusted p-values: the probability that any true hypothesis has one below a level is at most that level.

    This holds for any dependence between the tests (Holm 1979).

    Parameters
    ----------
    p_values
        (q,)

    Returns
    -------
    FloatArray
        (q,) in the order given
    """
    order = np.argsort(p_values)
    stepped = p_values[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted
