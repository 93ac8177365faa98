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

"""The update law, implemented once: agents, twin and checks all call these functions.

Two rules make a network of processes and the vectorised twin equal bit for bit. Sums run over the agents in ascending
order, one term at a time (never through BLAS or a reduction, whose order depends on shapes and threads). Each term is
one multiplication and one addition of doubles.
"""

from __future__ import annotations

from collections.abc import Sequence

from msg_analysis.types import FloatArray


def weighted_sum(weights: Sequence[float | FloatArray], values: Sequence[FloatArray]) -> FloatArray:
    """sum_j weights[j] * values[j], term after term in the order given; at least one term, values of one shape.

    A weight is a number, or an array that broadcasts against the values.
    """
    terms = zip(values, weights, strict=True)
    value, weight = next(terms)
    total = value * weight
    for value, weight in terms:
        total += value * weight
    return total


def step(weights: Sequence[float | FloatArray], values: Sequence[FloatArray], drive: FloatArray) -> FloatArray:
    """x_i(k+1) = sum_j W_ij x_j(k) + drive_i(k), for the non-zero W_ij of row i, j ascending, and values of shape (R,).

    For many rows at once: weights (m, 1), padded with zeros, and values (m, R). The drive, of the shape of a value, is
    the noise plus the offset that a reference adds to the row.
    """
    total = weighted_sum(weights, values)
    total += drive
    return total
