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

"""The evidence against the law of a run over time, looked at after some of its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS
from msg_analysis.inference.departures.departure import Finding
from msg_analysis.inference.evidence.looks import Looks
from msg_analysis.inference.evidence.mixture_evidence import log_mean
from msg_analysis.inference.observed.heard_values import HeardValues
from msg_analysis.inference.observed.observation import Observation
from msg_analysis.inference.sequential.evidence_sums import EvidenceSums
from msg_analysis.inference.sequential.law_questions import question_words
from msg_analysis.inference.statistics.confidence_sequence import simultaneous_half_width
from msg_analysis.types import FloatArray, IntArray

LARGEST_LOGARITHM = 700.0  # evidence beyond is not shown as a number: floating point ends there


@dataclass(frozen=True, slots=True, eq=False)
class WatchedEvidence:
    """Sums over a run, and the evidence after some of its steps; of several runs, only the sums."""

    sums: EvidenceSums
    dt: float
    steps: IntArray | None  # (T,) ascending, the last is all steps
    logarithms: FloatArray | None  # (T,) of the evidence after them

    @classmethod
    def of(cls, observation: Observation, looks: IntArray) -> WatchedEvidence:
        """Of a run, at the numbers of steps ``looks`` (T,), ascending, the last of which is all steps."""
        watch = Watch(observation, looks)
        for first, last in observation.blocks(watch.numbers_per_step, "evidence"):
            watch.add(first, last)
        return watch.result()

    def findings(self) -> list[Finding]:
        """The clearest departure of each kind that is tested."""
        return self.sums.departures.findings() if self.sums.departures else []

    def merged(self, other: WatchedEvidence) -> WatchedEvidence:
        """Of these and other runs of the same experiment; the sums of ``self`` are changed in place."""
        self.sums.merge(other.sums)
        return WatchedEvidence(self.sums, self.dt, None, None)


class Watch:
    """Adds the steps of a run in order, and looks at the evidence after the numbers of steps ``looks`` (T,)."""

    def __init__(self, observation: Observation, looks: IntArray) -> None:
        self._observation, self._looks = observation, looks
        self._sums = EvidenceSums(observation.prediction, observation.replicas, in_detail=True)
        self._logarithms = np.empty(len(looks))
        self._looked = 0
        self._most = max(1, BLOCK_NUMBERS // self._sums.numbers_per_look)  # looks in one pass

    @property
    def numbers_per_step(self) -> int:
        """Of temporary arrays."""
        step, error = self._observation.step, self._sums.error
        numbers = (4 + step.most_neighbours) * self._observation.states[0].size + step.agents**2
        return int(numbers if error is None else max(numbers, error.numbers * (1 + len(error.rates))))

    def add(self, first: int, last: int, heard: tuple[HeardValues, FloatArray] | None = None) -> None:
        """Add the steps first..last-1; ``heard`` as of ``EvidenceSums.add``."""
        begin = first
        while first < last:
            ends = self._looks[self._looked : self._looked + self._most]
            ends = ends[ends <= last]
            looked = self._looked + len(ends)
            if len(ends) < self._most and (not len(ends) or ends[-1] < last):
                ends = np.append(ends, last)
            until = int(ends[-1])
            known = heard and (heard[0].part(first - begin, until - begin), heard[1][first - begin : until - begin])
            found = self._sums.look(self._observation, first, until, Looks(ends - first), known)
            self._logarithms[self._looked : looked] = found[: looked - self._looked]
            first, self._looked = until, looked

    def result(self) -> WatchedEvidence:
        """After all steps."""
        return WatchedEvidence(self._sums, self._observation.step.dt, self._looks, self._logarithms)


@dataclass(frozen=True, slots=True, eq=False)
class AnyTimeEvidence:
    """What may be said at any time, however often one looks.

    While the run follows the law, the evidence ever passes ``threshold`` with probability at most 1 / threshold.
    """

    threshold: float
    log_evidence: float
    crossed: float | None  # [units of simulated time] when it passed the threshold first; None: never, or several runs
    time: FloatArray | None  # (T,) [units of simulated time]; None of several runs
    log_curve: FloatArray | None  # (T,)
    questions: Sequence[tuple[str, float]]  # the strongest question of each kind, and its log evidence; largest first
    half_width: float | None  # of the 95 % interval of the system error that holds at all times at once

    @property
    def disagrees(self) -> bool:
        """Whether the threshold is passed, or was."""
        return self.crossed is not None or self.log_evidence >= math.log(self.threshold)

    def to_json(self) -> dict[str, Any]:
        """The document; evidence that is too large for a number is None."""
        small = self.log_evidence < LARGEST_LOGARITHM
        return {
            "evidence": math.exp(self.log_evidence) if small else None,
            "log_evidence": self.log_evidence,
            "threshold": self.threshold,
            "disagrees": self.disagrees,
            "crossed_at": self.crossed,
            "questions": [{"about": words, "log_evidence": log} for words, log in self.questions],
            "half_width": self.half_width,
        }


def any_time_evidence(
    watched: WatchedEvidence,
    level: float,
    graphs: Sequence[str],
    variance: float | None = None,
    steps: int | None = None,
    planned: float | None = None,
) -> AnyTimeEvidence:
    """The evidence in words and numbers.

    Parameters
    ----------
    watched
        of one run or several
    level
        probability that the threshold 1 / level is ever passed by a run that follows its law, at most
    graphs
        their names
    variance, steps, planned
        sum of Var(D_k) of the system error over so many steps, and the number of steps at which its interval is to be
        narrowest, chosen before the run; None where it is not known
    """
    threshold, sums = 1.0 / level, watched.sums
    time, crossed = None, None
    if watched.steps is not None and watched.logarithms is not None:
        time = np.asarray(watched.steps * watched.dt, dtype=float)
        over = np.flatnonzero(watched.logarithms >= math.log(threshold))
        crossed = float(time[over[0]]) if len(over) else None
    questions, families = [], sums.families()
    for kind, logarithms in families.items():
        each = log_mean(logarithms, axis=1)
        best = int(np.argmax(each))
        words = sums.departures.question(kind, best, graphs) if sums.departures else None
        words = words or question_words(sums.question(kind, best), graphs)
        questions.append((words, float(each[best])))
    half_width = None
    if variance and steps and planned and sums.error is not None:
        half_width = float(simultaneous_half_width(variance, sums.error.variance * planned)) / steps
    return AnyTimeEvidence(
        threshold=threshold,
        log_evidence=sums.evidence(families),
        crossed=crossed,
        time=time,
        log_curve=watched.logarithms,
        questions=sorted(questions, key=lambda entry: -entry[1]),
        half_width=half_width,
    )
