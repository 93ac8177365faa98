"""Which agents are more certain than which: pairs that a run can tell apart, all of them at one level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from msg_analysis.inference.errors.time_means import TimeMeans
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.types import FloatArray, IntArray

MAX_PAIRS = 4950
"""Most pairs that are looked at: 100 agents."""
SHOWN = 12
"""Most statements in words."""
EQUAL = 1e-9
"""Relative difference of predicted errors that counts as none."""


@dataclass(frozen=True, slots=True)
class Distinction:
    """A pair whose errors can be told apart; numbers from 1.

    Attributes
    ----------
    better, worse
        the one with the smaller measured error, and the other
    difference, standard_error
        of the measured errors, worse less better
    confidence
        1 - p, adjusted for all pairs (Holm)
    predicted
        whether theory has them in this order (True), in the other (False), or equal (None)
    """

    better: int
    worse: int
    difference: float
    standard_error: float
    confidence: float
    predicted: bool | None

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return {
            "better": self.better,
            "worse": self.worse,
            "difference": self.difference,
            "standard_error": self.standard_error,
            "confidence": self.confidence,
            "predicted": self.predicted,
        }


@dataclass(frozen=True, slots=True)
class Order:
    """Measured errors in order.

    Attributes
    ----------
    ranking
        numbers from 1, smallest measured error first
    predicted_ranking
        the same of the predicted errors; None without a prediction
    distinctions
        pairs that can be told apart, surest first
    pairs
        that were looked at
    level
        chance that any distinction is wrong
    """

    ranking: tuple[int, ...]
    predicted_ranking: tuple[int, ...] | None
    distinctions: tuple[Distinction, ...]
    pairs: int
    level: float

    @property
    def contradictions(self) -> tuple[Distinction, ...]:
        """Pairs that are told apart otherwise than predicted."""
        if self.predicted_ranking is None:
            return ()
        return tuple(pair for pair in self.distinctions if not pair.predicted)

    @property
    def ties(self) -> tuple[tuple[int, int], ...]:
        """Neighbours in the ranking that cannot be told apart."""
        apart = {frozenset((pair.better, pair.worse)) for pair in self.distinctions}
        following = zip(self.ranking, self.ranking[1:], strict=False)
        return tuple(pair for pair in following if frozenset(pair) not in apart)

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return {
            "ranking": list(self.ranking),
            "predicted_ranking": None if self.predicted_ranking is None else list(self.predicted_ranking),
            "level": self.level,
            "pairs": self.pairs,
            "distinguished": len(self.distinctions),
            "ties": [list(pair) for pair in self.ties],
            "contradictions": [pair.to_json() for pair in self.contradictions],
            "distinctions": [pair.to_json() for pair in self.distinctions],
        }


def order_of_nodes(means: TimeMeans, level: float) -> Order | None:
    """Put the agents in the order of their certainty; None where their errors are not estimated together.

    Parameters
    ----------
    means
        of a run, or of several
    level
        chance of telling any pair apart wrongly
    """
    if not len(means.nodes):
        return None
    covariance = means.nodes @ means.covariance @ means.nodes.T
    return order_of(means.nodes @ means.measured, covariance, means.nodes @ means.predicted, level)


def order_of(measured: FloatArray, covariance: FloatArray, predicted: FloatArray | None, level: float) -> Order | None:
    """Put estimates in order, and tell pairs of them apart; None where there is no pair, or too many.

    Parameters
    ----------
    measured
        (q,) estimates
    covariance
        (q, q) of them
    predicted
        (q,) what they should be, or None
    level
        chance of telling any pair apart wrongly
    """
    q = len(measured)
    first, second = np.triu_indices(q, 1)
    if not 0 < len(first) <= MAX_PAIRS:
        return None
    difference = measured[second] - measured[first]
    own = np.diag(covariance)
    variance = (own[first] + own[second] - 2.0 * covariance[first, second]).clip(0.0)
    usable = variance > 1e-20 * measured.max(initial=0.0) ** 2
    if not usable.any():
        return None
    first, second, difference, error = first[usable], second[usable], difference[usable], np.sqrt(variance[usable])
    adjusted = holm(2.0 * stats.norm.sf(np.abs(difference / error)))
    apart = np.flatnonzero(adjusted < level)
    found = [
        _distinction(*_sorted(first[a], second[a], difference[a]), abs(difference[a]), error[a], adjusted[a], predicted)
        for a in apart[np.argsort(adjusted[apart], kind="stable")]
    ]
    return Order(
        ranking=_ranking(measured),
        predicted_ranking=None if predicted is None else _ranking(predicted),
        distinctions=tuple(found),
        pairs=len(first),
        level=level,
    )


def _sorted(first: int, second: int, difference: float) -> tuple[int, int]:
    return (first, second) if difference > 0.0 else (second, first)


def _distinction(
    better: int, worse: int, difference: float, error: float, p: float, predicted: FloatArray | None
) -> Distinction:
    agrees: bool | None = None
    if predicted is not None:
        gap = float(predicted[worse] - predicted[better])
        agrees = None if abs(gap) <= EQUAL * float(predicted.max()) else gap > 0.0
    return Distinction(int(better) + 1, int(worse) + 1, float(difference), float(error), 1.0 - float(p), agrees)


def _ranking(values: FloatArray) -> tuple[int, ...]:
    # Rounding must not decide between what is equal by symmetry.
    rounded: IntArray = np.rint(values / (EQUAL * max(float(np.abs(values).max(initial=0.0)), 1e-300))).astype(np.int64)
    return tuple(int(i) + 1 for i in np.argsort(rounded, kind="stable"))
