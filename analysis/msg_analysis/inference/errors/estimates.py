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

"""Measured errors next to their expectations."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.common.text.markdown import markdown_table
from msg_analysis.common.text.number_words import number_text
from msg_analysis.inference.errors.time_means import TimeMeans
from msg_analysis.inference.statistics.distributions import chi2_tail, two_sided
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.inference.statistics.known_covariance import quadratic_form
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.types import FloatArray


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measured error next to its prediction; None where a number is not available.

    Attributes
    ----------
    measured, predicted
        time mean over the run, and its exact expectation
    standard_error
        of ``measured``, by the martingale method
    z
        (measured - predicted) / standard_error; None without noise
    p
        two-sided, of z
    p_holm
        adjusted over the nodes; None for the system error
    """

    measured: float | None = None
    predicted: float | None = None
    standard_error: float | None = None
    z: float | None = None
    p: float | None = None
    p_holm: float | None = None

    def _repr_markdown_(self) -> str:
        numbers = (self.measured, self.predicted, self.standard_error, self.z, self.p)
        heads = ("measured", "predicted", "standard error", "z", "p")
        return markdown_table(heads, [[number_text(number) for number in numbers]], names=0)

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """95 % confidence interval around the measured error."""
        if self.measured is None or self.standard_error is None:
            return None, None
        half = HALF_WIDTH_95 * self.standard_error
        return self.measured - half, self.measured + half

    def without_error(self) -> Estimate:
        """Only measured and predicted."""
        return Estimate(self.measured, self.predicted)

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {**asdict(self), "interval": list(self.interval)}


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceTest:
    """Test of all second moments together."""

    measured: FloatArray | None = None  # (m, m) time mean
    predicted: FloatArray | None = None  # (m, m) its expectation
    chi2: float | None = None  # of the half-vectorised difference; None without a joint test
    dof: int | None = None  # of ``chi2``
    p: float | None = None
    note: str | None = None  # why there is no test
    z: FloatArray | None = None  # (m, m) entries of the difference in standard errors; NaN where these are rounding


def estimates(means: TimeMeans, system: JumpSystem) -> tuple[Estimate, list[Estimate]]:
    """The system error and the node errors; the latter without standard errors where only the system error has one."""
    combinations = np.vstack([means.trace, means.nodes])
    measured, predicted = combinations @ means.measured, combinations @ means.predicted
    errors = np.sqrt(np.einsum("aq,qr,ar->a", combinations, means.covariance, combinations).clip(0.0))
    found, nodes = beside(measured, predicted, errors)
    if not len(means.nodes):
        frame = system.frame
        both = (np.diag(frame @ matrix @ frame.T) for matrix in (means.second_moments, means.expected_moments))
        return found, [Estimate(float(m), float(p)) for m, p in zip(*both, strict=True)]
    return found, nodes


def beside(measured: FloatArray, predicted: FloatArray, errors: FloatArray) -> tuple[Estimate, list[Estimate]]:
    """Estimates of the system error and of the node errors from arrays (1 + nodes,), the system error first.

    ``errors`` are standard errors. The p-values of the nodes are adjusted by Holm.
    """
    found = [estimate(*numbers, predicted[0]) for numbers in zip(measured, predicted, errors, strict=True)]
    tested = [i for i, entry in enumerate(found) if i > 0 and entry.p is not None]
    adjusted = dict(zip(tested, holm(np.array([found[i].p for i in tested], dtype=float)), strict=True))
    nodes = [
        Estimate(e.measured, e.predicted, e.standard_error, e.z, e.p, float(adjusted[i]) if i in adjusted else None)
        for i, e in enumerate(found)
        if i > 0
    ]
    return found[0], nodes


def estimate(measured: float, predicted: float, error: float, scale: float) -> Estimate:
    """A measured error next to its prediction; a standard error of rounding size, relative to ``scale``, gives no z."""
    if error <= 1e-12 * scale or error == 0.0:  # without noise: rounding only
        return Estimate(float(measured), float(predicted), float(error))
    z = float((measured - predicted) / error)
    return Estimate(float(measured), float(predicted), float(error), z, float(two_sided(z)))


def covariance_test(means: TimeMeans, system: JumpSystem) -> CovarianceTest:
    """Test of all second moments together: the quadratic form of measured - predicted is chi-square.

    Parameters
    ----------
    means
        of the run, or of several
    system
        the reduced system whose moments they are

    Returns
    -------
    CovarianceTest
        without ``chi2`` where not all moments are estimated together; without ``p`` where dof = 0
    """
    frame = system.frame
    measured = frame @ means.second_moments @ frame.T
    predicted = frame @ means.expected_moments @ frame.T
    if not means.joint:
        return CovarianceTest(measured, predicted, note="too many agents for a joint test of a run of this length")
    chi2, dof = quadratic_form(means.measured - means.predicted, means.covariance)
    p = float(chi2_tail(chi2, dof)) if dof else None
    return CovarianceTest(measured, predicted, chi2, dof, p, z=_standardised(means, system))


def _standardised(means: TimeMeans, system: JumpSystem) -> FloatArray:
    """(m, m) entries of the difference of the second moments of the agents, each in its standard errors."""
    frame = system.frame
    d = frame.shape[1]
    variances, directions = np.linalg.eigh(means.covariance)
    spread = frame @ packed_symmetric.unpack(directions.T * np.sqrt(variances.clip(0.0))[:, None], d) @ frame.T
    errors = np.sqrt(np.square(spread).sum(axis=0))
    difference = frame @ packed_symmetric.unpack(means.measured - means.predicted, d) @ frame.T
    scale = float(np.abs(means.predicted).max(initial=0.0))
    return np.where(errors > 1e-12 * scale, difference / np.where(errors > 0.0, errors, 1.0), np.nan)
