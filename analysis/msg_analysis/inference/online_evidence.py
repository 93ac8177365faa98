# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Evidence against the law of a running network, and the interval of its system error that holds at all times at once.

Which steps are left out, because they were not seen whole, must not depend on what happened in them. A received value
that is not there, because its step was not seen or is too old, leaves out the agent that used it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BLOCK_NUMBERS, BoolArray, FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.inference.evidence_sums import LARGEST_LOGARITHM, EvidenceSums
from msg_analysis.inference.observation import Observation, bounded
from msg_analysis.inference.online_steps import LoggedStates
from msg_analysis.inference.received_values import ReceivedValues
from msg_analysis.inference.residuals import received_residuals
from msg_analysis.model.run import LoggedInputs
from msg_analysis.theory import packed_symmetric
from msg_analysis.theory.prediction import Prediction

LEVEL = 0.01  # of the evidence, as of the verdict
MOST_BYTES = 4 * 2**20  # memory for the evidence on the system error; where that is too little, there is no evidence


@dataclass(frozen=True, slots=True)
class AnyTime:
    """What may be said of a running network at any time."""

    half_width: float | None  # of the 95 % interval of the system error that holds at all times at once
    log_evidence: float | None = None  # None: not known, see ``supports``
    threshold: float = 1.0 / LEVEL
    crossed: int | None = None  # steps that had been seen when the evidence was first found above the threshold
    strongest: str | None = None  # what the strongest evidence is about

    @property
    def exceeded(self) -> bool:
        """Whether the threshold was exceeded."""
        return self.crossed is not None

    def to_json(self) -> dict[str, Any]:
        """The document; evidence that is too large for a number is None."""
        known = self.log_evidence is not None and self.log_evidence < LARGEST_LOGARITHM
        return {
            "evidence": math.exp(self.log_evidence) if known and self.log_evidence is not None else None,
            "log_evidence": self.log_evidence,
            "threshold": self.threshold,
            "exceeded": self.exceeded,
            "strongest": self.strongest,
            "half_width": self.half_width,
        }


def needs_log(experiment: Experiment) -> bool:
    """Whether the evidence needs what the messages log, and not only the states."""
    noise = experiment.noise
    return bool(noise.on_air or noise.delay or experiment.run.pace == "realtime")


def supports(prediction: Prediction, most_bytes: int = MOST_BYTES) -> bool:
    """Whether there is evidence: of not too many agents."""
    step, system = prediction.step, prediction.system
    if needs_log(prediction.experiment):
        numbers = (8 + step.modes) * step.agents**2
    else:
        numbers = 16 * system.modes**2 * (packed_symmetric.size(system.dimension) + 1)
    return 8 * numbers <= most_bytes


class EvidenceWatch:
    """Sums of a run that goes on, and what they show at any time; ValueError where ``supports`` says no."""

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        if not supports(prediction):
            raise ValueError("too many agents for the evidence of this run")
        self.sums = EvidenceSums(prediction, replicas)
        self.count, self._end = 0, prediction.experiment.steps  # steps that have been added, and last one that counts
        self._crossed: int | None = None
        # Of the martingale difference of the system error in a step, by which its interval is tuned.
        self.variance = self.sums.error.variance if self.sums.error is not None else None

    def end_at(self, step: int) -> None:
        """The run ends at this step: what was done after it is not a part of it."""
        self._end = min(step, self._end)

    def report(self, half_width: float | None) -> AnyTime:
        """The evidence now; ``half_width``: of the interval of the system error, which is passed on."""
        evidence = self.sums.evidence()
        if math.isnan(evidence):  # numbers too large to compute with: the law never gives one
            evidence = math.inf
        threshold = 1.0 / LEVEL
        if self._crossed is None and evidence >= math.log(threshold):
            self._crossed = self.count
        strongest = None
        if self._crossed is not None:
            strongest = max(self.sums.strongest(self.sums.families()), key=lambda question: question[1])[0]
        return AnyTime(half_width, evidence, threshold, self._crossed, strongest)


class RunningEvidence(EvidenceWatch):
    """The evidence of a run in which all agents receive the states themselves, from its whole steps, as they come."""

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        super().__init__(prediction, replicas)
        if not self.sums.plain:
            raise ValueError("the states alone do not give the evidence of this run")
        self._prediction, self._replicas = prediction, replicas
        self._length = max(1, BLOCK_NUMBERS // self.sums.numbers_per_step)
        # The newest step, which counts when the graph after it is known: its number, graph, states before it and after.
        self._kept: tuple[int, IntArray, FloatArray] | None = None

    def end_at(self, step: int) -> None:
        """See ``EvidenceWatch``; the last step counts now."""
        super().end_at(step)
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


KEPT_BYTES = 32 * 2**20  # of the newest steps
LEAST_KEPT, MOST_KEPT = 256, 4096  # steps, besides those of the delay


class ReceivedEvidence(EvidenceWatch):
    """The evidence of a run from its states with their logs, as they come, each once or more often.

    ``kept``: newest steps whose values are kept, besides those of the delay; by default as many as ``KEPT_BYTES`` hold.
    """

    def __init__(self, prediction: Prediction, replicas: int, kept: int | None = None) -> None:
        super().__init__(prediction, replicas)
        if not needs_log(prediction.experiment):
            raise ValueError("the states alone give the evidence of this run")
        experiment, self._step = prediction.experiment, prediction.step
        step, m = self._step, self._step.agents
        self._inputs = LoggedInputs(step, experiment)
        self._realtime = experiment.run.pace == "realtime"
        self._sure_messages = experiment.noise.sure_messages
        self._lossy = experiment.noise.loss.any and not self._realtime
        truth = experiment.truth
        each = 8 * m * (replicas * (2 if truth else 1) + step.most_neighbours + 1)
        kept = kept or int(np.clip(KEPT_BYTES // each, LEAST_KEPT, MOST_KEPT))
        self._timeout = kept // 2  # steps for which values that are not there are awaited
        self._kept = kept = experiment.noise.delay + kept
        # Rings: what is known of step k is at the place k modulo their length.
        self._label = np.full(kept, -2, dtype=np.int64)
        self._done = np.zeros(kept, dtype=np.bool_)  # whether the step from here to the next one has been added
        self._states = np.zeros((kept, m, replicas))
        self._published = np.zeros((kept, m, replicas)) if truth else self._states
        self._graphs = np.zeros((kept, m), dtype=np.int64)
        self._used = np.zeros((kept, m, step.most_neighbours), dtype=np.int64)
        self._newest = -1
        self._length = max(1, BLOCK_NUMBERS // self.sums.numbers_per_step)
        self._path = NetworkPath()
        self._repeated = self.sums.repeated
        # Steps before this one use a message again; the next of them, None if one is missing or there are none.
        self._again = self._repeated.end or 0 if self._repeated else 0
        self._turn = 0 if self._again else None

    def add(self, logged: LoggedStates) -> None:
        """Add whole steps."""
        logged = logged[np.argsort(logged.steps, kind="stable")]
        logged = logged[logged.steps <= self._end]
        length = max(1, self._timeout // 2)
        for first in range(0, len(logged.steps), length):
            part = logged[first : first + length]
            self._add_ready(int(part.steps[-1]))  # before anything of it is overwritten
            self._keep(part)
            self._add_ready(int(part.steps[-1]))

    def add_holding_period(self, first: int, last: int, graph: int) -> bool:
        """In real time: take steps in which the network has a graph, from 0; False: they contradict earlier ones."""
        return self._path.add(first, last, graph)

    def _keep(self, part: LoggedStates) -> None:
        self._newest = max(self._newest, int(part.steps[-1]))
        place = part.steps % self._kept
        new = (part.steps > self._newest - self._kept) & (self._label[place] < part.steps)
        part, place = part[new], place[new]
        self._label[place], self._done[place] = part.steps, False
        self._states[place] = bounded(part.states)
        if part.published is not None:
            self._published[place] = bounded(part.published)
        self._graphs[place], self._used[place] = part.graphs, part.used

    def _add_ready(self, newest: int) -> None:
        """Add the steps that are there with all that was used in them, or have waited for it for too long."""
        label = self._label
        there = (label >= 0) & ~self._done & (np.roll(label, -1) == label + 1)
        steps = np.sort(label[there])
        for first in range(0, len(steps), self._length):
            part = steps[first : first + self._length]
            after = (part + 1) % self._kept
            used = self._used[after]
            known = (used < 0) | (label[used % self._kept] == used)
            late = part < newest - self._timeout
            ready: BoolArray = known.all(axis=(1, 2)) | late
            early = part < self._again
            if self._turn is not None:  # one after the other
                in_turn = np.logical_and.accumulate(ready & (part == self._turn + np.arange(len(part))))
                ready &= ~early | in_turn | late
            for chosen in (ready & early, ready & ~early):
                self._add_steps(part[chosen], known[chosen].all(axis=2))
        if self._realtime:
            graphs, following, count = self._path.passed(min(self._newest, self._end) - 1)
            self.sums.add_transitions(np.repeat(graphs, count), np.repeat(following, count))

    def _add_steps(self, steps: IntArray, known: BoolArray) -> None:
        """Add steps k -> k+1 (a,); ``known`` (a, m): whether all that the agents used is there."""
        if not len(steps):
            return
        step, kept = self._step, self._kept
        place, after = steps % kept, (steps + 1) % kept
        graphs, used = self._graphs[after], self._used[after]
        now = self._states[place]
        reception = ReceivedValues.by(
            step, graphs[:, 0], graphs, np.where(used < 0, used, used % kept), now, self._published
        )
        if not known.all():
            reception = replace(reception, link_variance=np.where(known, reception.link_variance, np.inf))
        lost = None
        if self._lossy:
            agents = np.tile(np.arange(step.agents), len(steps))
            flat = np.repeat(steps + 1, step.agents), graphs.reshape(-1) + 1, agents
            lost = self._inputs.lost(*flat, used.reshape(len(agents), -1)).reshape(used.shape)
        e = received_residuals(step, reception, self._states[after])
        if steps[0] < self._again:
            e, reception = self._freed(steps, known, e, reception)
        self.sums.add_received(reception, e, lost, steps >= self._sure_messages)
        self.sums.add_broadcast(self._published[place] - now)
        self._done[place] = True
        self.count += len(steps)
        if not self._realtime:
            self._add_graphs(steps, graphs[:, 0])

    def _freed(
        self, steps: IntArray, known: BoolArray, e: FloatArray, reception: ReceivedValues
    ) -> tuple[FloatArray, ReceivedValues]:
        """Residuals of the first steps, less what earlier ones say of the noise in them; left out if one is missing."""
        if (
            not self._repeated
            or self._turn is None
            or not known.all()
            or (steps != self._turn + np.arange(len(steps))).any()
        ):
            self._turn = None
            return e, replace(reception, link_variance=np.full_like(reception.link_variance, np.inf))
        self._turn += len(steps)
        return self._repeated.free(int(steps[0]), e, reception)

    def _add_graphs(self, steps: IntArray, graphs: IntArray) -> None:
        """In lockstep: count the transitions between these steps, which are done now, and those next to them."""
        label, done, kept = self._label, self._done, self._kept
        before = (steps - 1) % kept
        joined = done[before] & (label[before] == steps - 1)
        self.sums.add_transitions(self._graphs[steps[joined] % kept, 0], graphs[joined])
        after = (steps + 1) % kept
        joined = done[after] & (label[after] == steps + 1) & ~np.isin(steps + 1, steps)
        self.sums.add_transitions(graphs[joined], self._graphs[(steps[joined] + 2) % kept, 0])


class NetworkPath:
    """In real time: the graph of the network, one holding time after the other; agents may use it late."""

    def __init__(self) -> None:
        self._ahead: dict[int, tuple[int, int]] = {}  # last step and graph, by first step
        self._now: tuple[int, int, int] | None = None  # first step that is not counted, last step, graph

    def add(self, first: int, last: int, graph: int) -> bool:
        """See ``ReceivedEvidence.add_holding_period``."""
        if self._now is not None and first <= self._now[1]:
            return True  # it comes again
        return self._ahead.setdefault(first, (last, graph)) == (last, graph)

    def passed(self, last: int) -> tuple[IntArray, IntArray, IntArray]:
        """Transitions up to the graph of step ``last`` since the last call: graphs, the next ones, how often, (k,)."""
        found: list[tuple[int, int, int]] = []
        while self._now is not None or self._ahead:
            if self._now is None:
                begin = min(self._ahead)
                self._now = begin, *self._ahead.pop(begin)
            first, end, graph = self._now
            until = max(first, min(end, last))
            found.append((graph, graph, until - first))
            self._now = until, end, graph
            if end >= last or not self._ahead:
                break
            following = self._ahead.pop(end + 1, None)
            if following is None:  # what is between was not seen
                self._now, self._ahead = None, {step: kept for step, kept in self._ahead.items() if step > end}
            else:
                found.append((graph, following[1], 1))
                self._now = end + 1, *following
        graphs, following_ones, count = np.array(found, dtype=np.int64).reshape(-1, 3).T
        return graphs, following_ones, count
