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

"""What lost messages add to a step's map of second moments, and the adjoint of that, matrix-free.

A message from j to i that may be lost adds variance_ij E[(x_i - x_j)^2] to the second moment of agent i
(docs/theory.md, "Beyond the paper").
"""

from __future__ import annotations

import numpy as np

from msg_analysis.types import FloatArray


def lost(lift: FloatArray, variance: FloatArray, moments: FloatArray) -> FloatArray:
    """(..., n, d, d): sum_ij variance_ij <(e_i - e_j)(e_i - e_j)^T, C> e_i e_i^T in reduced coordinates.

    Parameters
    ----------
    lift
        (k, d), see ``JumpSystem``; k = m without delay
    variance
        (n, k, k), or (k, k) for one graph; see ``StepModel.loss_variance``
    moments
        (..., n, d, d) symmetric C
    """
    full = lift @ moments @ lift.T
    own = np.diagonal(full, axis1=-2, axis2=-1)
    squares = own[..., :, None] + own[..., None, :] - 2.0 * full
    spread = (variance * squares).sum(axis=-1)
    return np.asarray(lift.T @ (spread[..., None] * lift))


def lost_adjoint(lift: FloatArray, variance: FloatArray, forms: FloatArray) -> FloatArray:
    """(..., n, d, d): sum_ij variance_ij <e_i e_i^T, Y> (e_i - e_j)(e_i - e_j)^T in reduced coordinates.

    The adjoint of ``lost``, with the same arguments; ``forms``: (..., n, d, d) symmetric Y.
    """
    seen = variance * ((lift @ forms) * lift).sum(axis=-1)[..., None]
    laplacian = -(seen + seen.swapaxes(-1, -2))
    laplacian += np.eye(len(lift)) * (seen.sum(axis=-1) + seen.sum(axis=-2))[..., None]
    return np.asarray(lift.T @ laplacian @ lift)
