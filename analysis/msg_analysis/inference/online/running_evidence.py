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

"""Evidence against the law of a running network, and the interval of its system error that holds at all times at once.

The sums of ``sequential.evidence_sums``, one stretch of whole steps after the other; O(1) per step. Which steps are
left out, because they were not seen whole, must not depend on what happened in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS
from msg_analysis.inference.evidence.mixture_evidence import log_mean
from msg_analysis.inference.observed.observation import Observation, bounded
from msg_analysis.inference.sequential.evidence_sums import EvidenceSums
from msg_analysis.inference.sequential.law_questions import question_words
from msg_analysis.inference.sequential.watched_evidence import LARGEST_LOGARITHM
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.types import FloatArray, IntArray

LEVEL = 0.01  # of the evidence, as of the verdict
MOST_BYTES = 4 * 2**20  # memory for the evidence on the system error; where that is too little, there is no evidence


@dataclass(frozen=True, slots=True)
class AnyTime:
    """What may be said of a running network at any time, however often one looks."""

    half_width: float | None  # of the 95 % interval of the system error that holds at all times at once
    log_evidence: float | None = None  # None: not known, see ``supports``
    threshold: float = 1.0 / LEVEL
    crossed: int | None = None  # steps that had been seen when the evidence was first found above the threshold
    strongest: str | None = None  # what the strongest evidence is about

    def to_json(self) -> dict[str, Any]:
        """The document; evidence that is too large for a number is None."""
        known = self.log_evidence is not None and self.log_evidence < LARGEST_LOGARITHM
        return {
            "evidence": math.exp(self.log_evidence) if known and self.log_evidence is not None else None,
            "log_evidence": self.log_evidence,
            "threshold": self.threshold,
            "disagrees": self.crossed is not None,
            "strongest": self.strongest,
            "half_width": self.half_width,
        }


def needs_log(experiment: ValidExperiment) -> bool:
    """Whether the evidence needs what the messages log, and not only the states."""
    noise = experiment.noise
    return bool(noise.on_air or noise.delay or experiment.run.pace == "realtime")


def supports(prediction: Prediction) -> bool:
    """Whether there is evidence: of not too many agents."""
    step, system = prediction.step, prediction.system
    if needs_log(prediction.experiment):
        numbers = (8 + step.modes) * step.agents**2
    else:
        numbers = 16 * system.modes**2 * (packed_symmetric.size(system.dimension) + 1)
    return 8 * numbers <= MOST_BYTES


class EvidenceWatch:
    """Sums of a run that goes on, and what they say when they are looked at; ValueError where ``supports`` says no."""

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        if not supports(prediction):
            raise ValueError("too many agents for the evidence of this run")
        self.sums = EvidenceSums(prediction, replicas)
        self.count = 0  # steps that have been added
        self._names = [graph.name for graph in prediction.experiment.graph_list]
        self._crossed: int | None = None

    @property
    def variance(self) -> float | None:
        """Of the martingale difference of the system error in a step, by which its interval is tuned."""
        return self.sums.error.variance if self.sums.error is not None else None

    def look(self, half_width: float | None) -> AnyTime:
        """The evidence now; ``half_width``: of the interval of the system error, which is passed on."""
        evidence = self.sums.evidence()
        if math.isnan(evidence):  # numbers too large to compute with: the law never gives one
            evidence = math.inf
        threshold = 1.0 / LEVEL
        if self._crossed is None and evidence >= math.log(threshold):
            self._crossed = self.count
        strongest = None
        if self._crossed is not None:
            best = {kind: log_mean(logs, axis=1) for kind, logs in self.sums.families().items()}
            kind = max(best, key=lambda kind: float(best[kind].max()))
            strongest = question_words(self.sums.question(kind, int(best[kind].argmax())), self._names)
        return AnyTime(half_width, evidence, threshold, self._crossed, strongest)


class RunningEvidence(EvidenceWatch):
    """The evidence of a run in which all agents hear the states themselves, from its whole steps, as they come."""

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        super().__init__(prediction, replicas)
        if self.sums.error is None:
            raise ValueError("the states alone do not give the evidence of this run")
        self._prediction, self._replicas = prediction, replicas
        step = prediction.step
        numbers = (4 + step.most_neighbours) * step.agents * replicas
        numbers = max(numbers + step.agents**2, self.sums.error.numbers * (1 + len(self.sums.error.rates)))
        self._length = max(1, BLOCK_NUMBERS // numbers)
        self._end = prediction.experiment.steps
        # The newest step, which counts when the graph after it is known: its number, graph, states before it and after.
        self._kept: tuple[int, IntArray, FloatArray] | None = None

    def end_at(self, step: int) -> None:
        """The run ends at this step: what was done after it is not a part of it, and the last step counts now."""
        self._end = min(step, self._end)
        self._add_last()

    def add(self, steps: IntArray, modes: IntArray, states: FloatArray, after: FloatArray) -> None:
        """Add whole steps, each only once; arrays as in ``LiveEstimate.add_whole``."""
        if len(steps) and int(steps.max()) >= self._end:
            within = steps < self._end
            steps, modes, states, after = steps[within], modes[within], states[within], after[within]
        if not len(steps):
            return
        if (np.diff(steps) < 0).any():
            order = np.argsort(steps, kind="stable")
            steps, modes, states, after = steps[order], modes[order], states[order], after[order]
        ends = [0, *(np.flatnonzero(np.diff(steps) != 1) + 1).tolist(), len(steps)]
        for first, end in pairwise(ends):
            self._add_stretch(int(steps[first]), modes[first:end], states[first:end], after[end - 1])

    def _add_stretch(self, first: int, modes: IntArray, states: FloatArray, end: FloatArray) -> None:
        """Add steps in a row from ``first`` on; ``end``: the states after the last one."""
        parts = [states[:, :, : self._replicas], end[None, :, : self._replicas]]
        if self._kept is not None and self._kept[0] == first - 1:
            modes, parts = np.concatenate([self._kept[1], modes]), [self._kept[2][:1], *parts]
            first -= 1
        whole = bounded(np.concatenate(parts))
        last = len(modes) - 1  # its next graph is not known yet
        for start in range(0, last, self._length):
            stop = min(start + self._length, last)
            part = whole[start : stop + 2]
            self.sums.add(Observation(self._prediction, part, modes[start : stop + 1], part[0]), 0, stop - start)
        self.count += last
        self._kept = first + last, modes[last:], whole[last:]
        self._add_last()

    def _add_last(self) -> None:
        """Add the last step of the run, after which there is no graph."""
        if self._kept is not None and self._kept[0] == self._end - 1:
            _, modes, states = self._kept
            self.sums.add(Observation(self._prediction, states, modes, states[0]), 0, 1)
            self.count, self._kept = self.count + 1, None
