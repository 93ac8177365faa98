"""Which of many possible single changes of a law explains what was seen: forward selection by score tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from msg_analysis.types import BoolArray, FloatArray

MOST = 6
"""Causes looked for in one group; what is wrong in more places than this is wrong altogether."""
SAME = 1e-9
"""Share of a candidate's information that must be left when what others explain has been taken out."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A change of the law along one direction.

    Attributes
    ----------
    part, what
        what it is, for those who made it
    direction
        (K,) change of the parameters for a change by 1
    """

    part: str
    what: Any
    direction: FloatArray


@dataclass(frozen=True, slots=True)
class Selected:
    """A change that was found.

    Attributes
    ----------
    part, what
        of the candidate
    estimate, standard_error
        of the change, with all others that were found
    log_p
        logarithm of the p-value, adjusted for all candidates
    """

    part: str
    what: Any
    estimate: float
    standard_error: float
    log_p: float

    @property
    def interval(self) -> tuple[float, float]:
        """95 %."""
        half = float(stats.norm.ppf(0.975)) * self.standard_error
        return self.estimate - half, self.estimate + half


def select(
    score: FloatArray, information: FloatArray, classes: Sequence[Sequence[Candidate]], families: int, level: float
) -> tuple[list[Selected], FloatArray]:
    """Find the changes that explain a score, the clearest first, each given the others.

    A candidate's p-value is multiplied by the number of candidates of its class and by the number of classes
    (Bonferroni): so a class of one (all messages alike) is believed sooner than one of many links.

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
        chance of finding anything where nothing is wrong

    Returns
    -------
    tuple[list[Selected], FloatArray]
        what was found, and the change (K,) of the parameters that it makes together
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
        # What a later one explains better is no cause any more.
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
    """(C,): of all candidates, given those that were chosen."""
    own = np.diag(full).copy()
    rest, left = scores, own.copy()
    if chosen:
        shared = full[:, chosen] @ np.linalg.pinv(full[np.ix_(chosen, chosen)], hermitian=True)
        rest = scores - shared @ scores[chosen]
        left = own - np.einsum("cs,cs->c", shared, full[:, chosen])
    possible: BoolArray = left > SAME * np.maximum(own, own.max(initial=0.0) * SAME)
    z = np.zeros(len(scores))
    z[possible] = rest[possible] / np.sqrt(left[possible])
    return np.where(possible, math.log(2.0) + stats.norm.logsf(np.abs(z)), 0.0)


def _distinct(classes: Sequence[Sequence[Candidate]], families: int) -> tuple[list[Candidate], FloatArray]:
    """Candidates that are not the same as an earlier one, and the logarithm of what each p-value is multiplied by."""
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
