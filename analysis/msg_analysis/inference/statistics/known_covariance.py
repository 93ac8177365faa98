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

"""Normal vectors with mean 0 and a known covariance, which may be singular; its rank is judged on the correlations.

So the results do not depend on the units of the entries, and a direction in which a vector moves only by rounding,
which depends on the processor, counts as one without variance.
"""

from __future__ import annotations

import numpy as np

from msg_analysis.inference.statistics.distributions import two_sided
from msg_analysis.types import FloatArray

ROUNDED_DEVIATION = 1e-12  # relative to the largest standard deviation
ROUNDED_CORRELATION = 1e-10  # eigenvalue of a matrix of correlations


def quadratic_form(vector: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """v^T C^+ v, and the rank of C, its degrees of freedom.

    Parameters
    ----------
    vector
        (q,)
    covariance
        (q, q)
    """
    inverse, correlations = _scaled(covariance)
    values, vectors = np.linalg.eigh(correlations)
    keep = values > ROUNDED_CORRELATION
    scores = vectors[:, keep].T @ (vector * inverse)
    return float((scores**2 / values[keep]).sum()), int(keep.sum())


def direction_p(direction: FloatArray, vector: FloatArray, covariance: FloatArray) -> float | None:
    """Two-sided p-value of d^T v; None where its variance is nothing but rounding.

    Parameters
    ----------
    direction
        (q,)
    vector
        (q,)
    covariance
        (q, q)
    """
    inverse, correlations = _scaled(covariance)
    scaled = np.divide(direction, inverse, out=np.zeros_like(direction), where=inverse > 0.0)
    variance = float(scaled @ correlations @ scaled)
    if variance <= ROUNDED_CORRELATION * float(scaled @ scaled):
        return None
    return float(two_sided(float(scaled @ (vector * inverse)) / np.sqrt(variance)))


def pseudo_inverse(covariance: FloatArray) -> FloatArray:
    """C^+, computed from the correlations.

    Parameters
    ----------
    covariance
        (q, q)

    Returns
    -------
    FloatArray
        (q, q)
    """
    inverse, correlations = _scaled(covariance)
    scale = np.outer(inverse, inverse)
    return np.asarray(scale * np.linalg.pinv(correlations, rcond=ROUNDED_CORRELATION, hermitian=True))


def _scaled(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse standard deviations (q,) and correlations (q, q); both 0 where an entry moves only by rounding."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    alive = deviation > ROUNDED_DEVIATION * deviation.max(initial=0.0)
    inverse = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=alive)
    return inverse, covariance * np.outer(inverse, inverse)
