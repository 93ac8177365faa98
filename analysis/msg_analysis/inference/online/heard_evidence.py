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

"""Evidence against the law of a running network from what every agent heard: on the air, with delay, in real time.

The sums of ``sequential.evidence_sums``. The newest steps are kept until the values that were used in them are there. A
value that is not there, because its step was not seen or is older than what is kept, leaves out the agent that used it
in this step: that depends on times and losses only, never on states. O(1) per step; bounded memory.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msg_analysis.common.large_arrays import BLOCK_NUMBERS
from msg_analysis.inference.hypothesis_tests.innovations import heard_innovations
from msg_analysis.inference.observed.heard_values import HeardValues
from msg_analysis.inference.observed.observation import bounded
from msg_analysis.inference.online.logged_states import LoggedStates
from msg_analysis.inference.online.running_evidence import EvidenceWatch, needs_log
from msg_analysis.model.step.logged_inputs import LoggedInputs
from msg_analysis.theory.prediction import Prediction
from msg_analysis.types import BoolArray, IntArray

KEPT_BYTES = 32 * 2**20  # of the newest steps
LEAST_KEPT, MOST_KEPT = 256, 4096  # steps, besides those of the delay


class HeardEvidence(EvidenceWatch):
    """The evidence of a run from its states with their logs, as they come, each once or more often."""

    def __init__(self, prediction: Prediction, replicas: int) -> None:
        super().__init__(prediction, replicas)
        if not needs_log(prediction.experiment):
            raise ValueError("the states alone give the evidence of this run")
        experiment, self._step = prediction.experiment, prediction.step
        step, m = self._step, self._step.agents
        self._inputs = LoggedInputs(step, experiment)
        self._realtime = experiment.run.pace == "realtime"
        self._lossy = experiment.noise.loss.any and not self._realtime
        truth = experiment.truth
        each = 8 * m * (replicas * (2 if truth else 1) + step.most_neighbours + 1)
        self._kept = kept = experiment.noise.delay + int(np.clip(KEPT_BYTES // each, LEAST_KEPT, MOST_KEPT))
        self._patience = (kept - experiment.noise.delay) // 2  # steps for which values that are not there are awaited
        # Rings: what is known of step k is at the place k modulo their length.
        self._label = np.full(kept, -2, dtype=np.int64)
        self._done = np.zeros(kept, dtype=np.bool_)  # whether the step from here to the next one has been added
        self._states = np.zeros((kept, m, replicas))
        self._published = np.zeros((kept, m, replicas)) if truth else self._states
        self._graphs = np.zeros((kept, m), dtype=np.int64)
        self._used = np.zeros((kept, m, step.most_neighbours), dtype=np.int64)
        self._newest, self._end = -1, experiment.steps
        self._largest = 0.0
        self._length = max(1, BLOCK_NUMBERS // ((4 + step.most_neighbours) * m * replicas + m * m))
        self._path = NetworkPath()

    def end_at(self, step: int) -> None:
        """The run ends at this step: what was done after it is not a part of it."""
        self._end = min(step, self._end)

    def add(self, logged: LoggedStates) -> None:
        """Add whole steps."""
        logged = logged[np.argsort(logged.steps, kind="stable")]
        logged = logged[logged.steps <= self._end]
        length = max(1, self._patience // 2)
        for first in range(0, len(logged.steps), length):
            part = logged[first : first + length]
            self._add_ready(int(part.steps[-1]))  # before anything of it is overwritten
            self._keep(part)
            self._add_ready(int(part.steps[-1]))

    def add_sojourn(self, first: int, last: int, graph: int) -> bool:
        """In real time: take a sojourn of the network's graph, from 0, from step to step; False: it contradicts one."""
        return self._path.add(first, last, graph)

    def _keep(self, part: LoggedStates) -> None:
        self._newest = max(self._newest, int(part.steps[-1]))
        place = part.steps % self._kept
        new = (part.steps > self._newest - self._kept) & (self._label[place] < part.steps)
        part, place = part[new], place[new]
        self._label[place], self._done[place] = part.steps, False
        self._states[place] = states = bounded(part.states)
        self._largest = max(self._largest, float(np.abs(states).max(initial=0.0)))
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
            ready: BoolArray = known.all(axis=(1, 2)) | (part < newest - self._patience)
            self._add_steps(part[ready], known[ready].all(axis=2))
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
        reception = HeardValues.by(
            step, graphs[:, 0], graphs, np.where(used < 0, used, used % kept), now, self._published
        )
        if not known.all():
            reception = replace(reception, link_variance=np.where(known, reception.link_variance, np.inf))
        lost = None
        if self._lossy:
            agents = np.tile(np.arange(step.agents), len(steps))
            flat = np.repeat(steps + 1, step.agents), graphs.reshape(-1) + 1, agents
            lost = self._inputs.lost(*flat, used.reshape(len(agents), -1)).reshape(used.shape)
        self.sums.add_heard(reception, heard_innovations(step, reception, self._states[after]), lost, self._largest)
        self.sums.add_broadcast(self._published[place] - now)
        self._done[place] = True
        self.count += len(steps)
        if not self._realtime:
            self._add_graphs(steps, graphs[:, 0])

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
    """In real time: the graph of the network, sojourn by sojourn; agents may use it late."""

    def __init__(self) -> None:
        self._ahead: dict[int, tuple[int, int]] = {}  # last step and graph, by first step
        self._now: tuple[int, int, int] | None = None  # first step that is not counted, last step, graph

    def add(self, first: int, last: int, graph: int) -> bool:
        """See ``HeardEvidence.add_sojourn``."""
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
