# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of the errors of system and agents, and their order."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_analysis.common.arrays import FloatArray, IntArray
from msg_analysis.common.text import HALF_WIDTH_95, markdown_table, number_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.limits import prediction_method
from msg_analysis.inference.statistics import chi2_tail, holm, quadratic_form, two_sided
from msg_analysis.inference.time_means import TimeMeans
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.sampling import SampledPrediction, sampled_prediction

if TYPE_CHECKING:
    from msg_analysis.experiment.experiment import Experiment


SAMPLED_TO, SAMPLED_WITHIN = 0.02, 10.0  # relative half width, and time [s], of a sampled error next to a run


def sampled_beside(experiment: Experiment) -> SampledPrediction | None:
    """The sampled errors next to those of a run; None: not sampled, or not known in this time."""
    if prediction_method(experiment)[0] == "sampled":
        with suppress(InputError):
            return sampled_prediction(experiment, precision=SAMPLED_TO, within=SAMPLED_WITHIN)
    return None


def beside_sampled(measured: FloatArray, expected: FloatArray | None) -> list[Estimate]:
    """Errors (q,) next to sampled ones, nan where these are not known; None: of none."""
    known = np.full(len(measured), np.nan) if expected is None else expected
    pairs = zip(measured.tolist(), known.tolist(), strict=True)
    return [Estimate(error, None if math.isnan(predicted) else predicted) for error, predicted in pairs]


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
    p_adjusted
        adjusted over the nodes; None for the system error
    """

    measured: float | None = None
    predicted: float | None = None
    standard_error: float | None = None
    z: float | None = None
    p: float | None = None
    p_adjusted: float | None = None

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
    """Estimates of the system error and of the node errors (Holm), from arrays (1 + nodes,), the system error first."""
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
    """Quadratic form of measured - predicted second moments; without ``chi2`` where they are not estimated together."""
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


MAX_RANKED_PAIRS = 4950  # pairs tested, at most: 100 agents
EQUAL = 1e-9  # relative difference of predicted errors that counts as none


@dataclass(frozen=True, slots=True)
class Distinction:
    """A pair whose errors can be distinguished; numbers from 1."""

    better: int  # the agent with the smaller measured error
    worse: int
    difference: float  # of the measured errors, worse - better
    standard_error: float  # of ``difference``
    confidence: float  # 1 - p, adjusted for all pairs (Holm)
    predicted: bool | None  # whether the predicted order is the same; None if equal or unknown


@dataclass(frozen=True, slots=True)
class Ranking:
    """Measured errors in order."""

    ranking: tuple[int, ...]  # numbers from 1, smallest measured error first
    predicted_ranking: tuple[int, ...] | None  # the same of the predicted errors; None without a prediction
    distinctions: tuple[Distinction, ...]  # pairs that can be distinguished, smallest p first
    pairs: int  # that were tested
    level: float  # probability that any distinction is wrong, at most

    @property
    def contradictions(self) -> tuple[Distinction, ...]:
        """Distinguished pairs whose predicted order is another, or whose predicted errors are equal."""
        if self.predicted_ranking is None:
            return ()
        return tuple(pair for pair in self.distinctions if not pair.predicted)

    @property
    def ties(self) -> tuple[tuple[int, int], ...]:
        """Neighbours in the ranking that cannot be distinguished."""
        apart = {frozenset((pair.better, pair.worse)) for pair in self.distinctions}
        following = zip(self.ranking, self.ranking[1:], strict=False)
        return tuple(pair for pair in following if frozenset(pair) not in apart)

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "ranking": list(self.ranking),
            "predicted_ranking": None if self.predicted_ranking is None else list(self.predicted_ranking),
            "level": self.level,
            "pairs": self.pairs,
            "distinguished": len(self.distinctions),
            "ties": [list(pair) for pair in self.ties],
            "contradictions": [asdict(pair) for pair in self.contradictions],
            "distinctions": [asdict(pair) for pair in self.distinctions],
        }


def rank_agents(means: TimeMeans, level: float) -> Ranking | None:
    """Order the agents by measured error; None where their errors are not estimated together."""
    if not len(means.nodes):
        return None
    covariance = means.nodes @ means.covariance @ means.nodes.T
    return rank_estimates(means.nodes @ means.measured, covariance, means.nodes @ means.predicted, level)


def rank_estimates(
    measured: FloatArray, covariance: FloatArray, predicted: FloatArray | None, level: float
) -> Ranking | None:
    """Order estimates (q,), and distinguish pairs of them by z-tests (Holm); None without pairs or noise."""
    q = len(measured)
    first, second = np.triu_indices(q, 1)
    if not 0 < len(first) <= MAX_RANKED_PAIRS:
        return None
    difference = measured[second] - measured[first]
    own = np.diag(covariance)
    variance = (own[first] + own[second] - 2.0 * covariance[first, second]).clip(0.0)
    usable = variance > 1e-20 * measured.max(initial=0.0) ** 2
    if not usable.any():
        return None
    first, second, difference, error = first[usable], second[usable], difference[usable], np.sqrt(variance[usable])
    adjusted = holm(two_sided(difference / error))
    apart = np.flatnonzero(adjusted < level)
    found = []
    for a in apart[np.argsort(adjusted[apart], kind="stable")].tolist():
        better, worse = (first[a], second[a]) if difference[a] > 0.0 else (second[a], first[a])
        agrees = None
        if predicted is not None:
            gap = float(predicted[worse] - predicted[better])
            agrees = None if abs(gap) <= EQUAL * float(predicted.max()) else gap > 0.0
        size, confidence = abs(float(difference[a])), 1.0 - float(adjusted[a])
        found.append(Distinction(int(better) + 1, int(worse) + 1, size, float(error[a]), confidence, agrees))
    return Ranking(
        ranking=_ranking(measured),
        predicted_ranking=None if predicted is None else _ranking(predicted),
        distinctions=tuple(found),
        pairs=len(first),
        level=level,
    )


def _ranking(values: FloatArray) -> tuple[int, ...]:
    # Rounding must not order errors that are equal by symmetry.
    rounded: IntArray = np.rint(values / (EQUAL * max(float(np.abs(values).max(initial=0.0)), 1e-300))).astype(np.int64)
    return tuple(int(i) + 1 for i in np.argsort(rounded, kind="stable"))
