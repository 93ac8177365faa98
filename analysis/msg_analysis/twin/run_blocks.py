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

"""A run without ROS, block after block of steps, by the law and the random numbers of the network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from msg_analysis.common.large_arrays import large_zeros, release
from msg_analysis.model.arithmetic.payload import from_payload, to_payload
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.run.agent_law import ProtocolLaw
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.air import Air
from msg_analysis.model.step.air_reception import MessagesUsed, add_broadcast_noise, ahead
from msg_analysis.model.step.step_model import StepModel
from msg_analysis.twin.network_steps import states as states_of_all
from msg_analysis.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class RunBlock:
    """What ``Trajectory`` has from step ``first`` on. The last step of a run has a state, and nothing lost or used."""

    first: int
    states: FloatArray  # (K, m, width)
    published: FloatArray | None = None  # (K, m, R)
    lost: BoolArray | None = None  # (K, m, D)
    used: IntArray | None = None  # (K, m, D)

    @property
    def steps(self) -> slice:
        """The places of these steps in an array of all steps."""
        return slice(self.first, self.first + len(self.states))


def run_blocks(record: RunRecord, modes: IntArray) -> Iterator[RunBlock]:
    """A run with these graphs (N,), from x(0) to x(N): in lockstep, or with ideal timers and no latency."""
    experiment, model = record.experiment, record.model
    realtime, noise = experiment.run.pace == "realtime", experiment.noise
    looks_back = realtime or bool(noise.delay or noise.holds)
    messages = MessagesUsed(experiment, model) if looks_back or noise.loss.any else None
    values = _all_at_once(record, model, modes) if isinstance(model, StepModel) else _one_by_one(record, modes)
    for first, states, published in values:
        lost = used = None
        if messages is not None:
            now = modes[first : first + len(states)]
            used = messages.used(first, now)
            if not realtime and noise.loss.any:
                lost = messages.lost(first, used, now)
        yield RunBlock(first, states, published, lost, used if looks_back else None)


_Values = tuple[int, FloatArray, FloatArray | None]
"""First step, (K, m, width) states, and what is published of them, (K, m, R), if that is something else."""


def from_start(start: FloatArray, made: Iterable[FloatArray]) -> Iterator[tuple[int, FloatArray]]:
    """First step and states of blocks that begin with x(0) = ``start``; those of ``made`` begin with x(1)."""
    first, last = 0, start[None]
    for block in made:
        states = np.concatenate([last, block])
        yield first, states[:-1]
        first, last = first + len(block), states[-1:]
    yield first, last


def _all_at_once(record: RunRecord, model: StepModel, modes: IntArray) -> Iterator[_Values]:
    """A run of a linear law."""
    experiment = record.experiment
    air = Air(experiment) if experiment.noise.broadcast else None
    for first, states in from_start(record.start, states_of_all(experiment, model, modes, record.start)):
        yield first, states, add_broadcast_noise(air, states, first) if air else None


def _one_by_one(record: RunRecord, modes: IntArray) -> Iterator[_Values]:
    """The same by the laws of the single agents, one after the other, as the network has them."""
    experiment, model = record.experiment, record.model
    agents, replicas, count = model.agents, experiment.run.replicas, len(modes) + 1
    laws = [ProtocolLaw(record, model, i) for i in range(agents)]
    neighbours = [[law.neighbours(mode) for mode in range(model.modes)] for law in laws]
    lead = ahead(experiment)
    order = np.argsort(lead.sum(axis=1), kind="stable").tolist()
    # All of it, since a message that is held may be of any earlier step.
    published = large_zeros((count, agents, replicas), np.float64, total=8 * count * agents * replicas)

    def advance(k: int, i: int) -> None:
        mode = int(modes[k])
        senders = neighbours[i][mode]
        used = [laws[i].air.source(j, k + int(lead[i, j])) for j in senders]
        laws[i].advance(mode, [to_payload(published[s, j]) for s, j in zip(used, senders, strict=True)], used)

    for first in range(0, count, STEPS_PER_BLOCK):
        states = np.empty((min(STEPS_PER_BLOCK, count - first), *record.start.shape))
        for k in range(first, first + len(states)):
            for i in order:
                if k:
                    advance(k - 1, i)
                states[k - first, i] = from_payload(laws[i].state)
                published[k, i] = from_payload(laws[i].published(k, laws[i].state))
        yield first, states, published[first : first + len(states)].copy() if experiment.truth else None
        release(published)
