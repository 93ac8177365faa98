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

"""Which of many possible single changes of a law explain what was seen: forward selection by score tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.intervals import HALF_WIDTH_95
from msg_analysis.inference.statistics.distributions import log_normal_tail
from msg_analysis.types import BoolArray, FloatArray

MOST = 6  # causes searched for in one group
SAME = 1e-9  # share of a candidate's information that must be left after removing what the others explain


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A change of the law along one direction."""

    part: str  # with ``what``, the meaning, for the caller
    what: Any
    direction: FloatArray  # (K,) change of the parameters for a change by 1


@dataclass(frozen=True, slots=True)
class Selected:
    """A change that was found."""

    part: str  # of the candidate, as ``what``
    what: Any
    estimate: float  # of the change, given all others that were found
    standard_error: float
    log_p: float  # logarithm of the p-value, adjusted for all candidates

    @property
    def interval(self) -> tuple[float, float]:
        """95 %."""
        half = HALF_WIDTH_95 * self.standard_error
        return self.estimate - half, self.estimate + half


def select(
    score: FloatArray, information: FloatArray, classes: Sequence[Sequence[Candidate]], families: int, level: float
) -> tuple[list[Selected], FloatArray]:
    """Find the changes that explain a score, the smallest p-value first, each given the others.

    A candidate's p-value is multiplied by the number of candidates of its class and by the number of classes
    (Bonferroni): so a class of one (all messages alike) needs less evidence than one of many links.

    Parameters
    ----------
    score
        (K,) with mean information @ change
    information
        (K, K) covariance of the score where nothing is wrong
    classes
        candidates, class by class
    families
        number of classes, those of other scores included
    level
        probability of finding anything where nothing is wrong, at most

    Returns
    -------
    tuple[list[Selected], FloatArray]
        what was found, and the total change (K,) of the parameters
    """
    candidates, penalties = _distinct(classes, families)
    if not candidates:
        return [], np.zeros(len(score))
    directions = np.array([candidate.direction for candidate in candidates])
    moved = directions @ information
    scores, full = directions @ score, moved @ directions.T
    chosen: list[int] = []
    while len(chosen) < MOST:
        log_p = _log_p(scores, full, chosen) + penalties
        best = int(np.argmin(log_p))
        if log_p[best] >= math.log(level):
            break
        chosen.append(best)
        # A cause that later ones explain better is dropped.
        for old in list(chosen[:-1]):
            others = [c for c in chosen if c != old]
            if (_log_p(scores, full, others) + penalties)[old] >= math.log(level):
                chosen = others
                break
    if not chosen:
        return [], np.zeros(len(score))
    inverse = np.linalg.pinv(full[np.ix_(chosen, chosen)], hermitian=True)
    values, errors = inverse @ scores[chosen], np.sqrt(np.diag(inverse).clip(0.0))
    found = []
    for place, c in enumerate(chosen):
        others = [other for other in chosen if other != c]
        surprise = float((_log_p(scores, full, others) + penalties)[c])
        part, what = candidates[c].part, candidates[c].what
        found.append(Selected(part, what, float(values[place]), float(errors[place]), min(surprise, 0.0)))
    return sorted(found, key=lambda one: one.log_p), values @ directions[chosen]


def _log_p(scores: FloatArray, full: FloatArray, chosen: list[int]) -> FloatArray:
    """(C,): of all candidates, given the chosen ones."""
    own = np.diag(full).copy()
    rest, left = scores, own.copy()
    if chosen:
        shared = full[:, chosen] @ np.linalg.pinv(full[np.ix_(chosen, chosen)], hermitian=True)
        rest = scores - shared @ scores[chosen]
        left = own - np.einsum("cs,cs->c", shared, full[:, chosen])
    possible: BoolArray = left > SAME * np.maximum(own, own.max(initial=0.0) * SAME)
    z = np.zeros(len(scores))
    z[possible] = rest[possible] / np.sqrt(left[possible])
    return np.where(possible, math.log(2.0) + log_normal_tail(np.abs(z)), 0.0)


def _distinct(classes: Sequence[Sequence[Candidate]], families: int) -> tuple[list[Candidate], FloatArray]:
    """Candidates that differ from all earlier ones, and the logarithm of the factor of each p-value."""
    seen: set[bytes] = set()
    kept: list[Candidate] = []
    penalties = []
    for candidates in classes:
        for candidate in candidates:
            key = np.round(candidate.direction, 12).tobytes()
            if key in seen or not candidate.direction.any():
                continue
            seen.add(key)
            kept.append(candidate)
            penalties.append(math.log(len(candidates) * families))
    return kept, np.array(penalties)
