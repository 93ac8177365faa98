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

"""Which agents have smaller errors than which: pairs that a run can distinguish, all at one level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.inference.errors.time_means import TimeMeans
from msg_analysis.inference.statistics.distributions import two_sided
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.types import FloatArray, IntArray

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

    def to_json(self) -> dict[str, Any]:
        """The JSON document."""
        return {
            "better": self.better,
            "worse": self.worse,
            "difference": self.difference,
            "standard_error": self.standard_error,
            "confidence": self.confidence,
            "predicted": self.predicted,
        }


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
            "contradictions": [pair.to_json() for pair in self.contradictions],
            "distinctions": [pair.to_json() for pair in self.distinctions],
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
    """Order estimates, and distinguish pairs of them by z-tests, adjusted by Holm.

    None where there is no pair, no noise, or more than ``MAX_RANKED_PAIRS``.

    Parameters
    ----------
    measured, covariance, predicted
        (q,) estimates, their (q, q), and (q,) what they should be, or None
    level
        probability of any wrong distinction, at most
    """
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
    found = [
        _distinction(*_sorted(first[a], second[a], difference[a]), abs(difference[a]), error[a], adjusted[a], predicted)
        for a in apart[np.argsort(adjusted[apart], kind="stable")]
    ]
    return Ranking(
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
    # Rounding must not order errors that are equal by symmetry.
    rounded: IntArray = np.rint(values / (EQUAL * max(float(np.abs(values).max(initial=0.0)), 1e-300))).astype(np.int64)
    return tuple(int(i) + 1 for i in np.argsort(rounded, kind="stable"))
