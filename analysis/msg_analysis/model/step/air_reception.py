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

"""What all agents hear in steps with noise, loss or delay on the air: ``air`` for all at once, for the twin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import numpy as np

from msg_analysis.model.arithmetic.many_steps import Reception
from msg_analysis.model.arithmetic.random_streams import STEPS_PER_BLOCK
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.model.step.air import NOTHING, Air
from msg_analysis.model.step.neighbours import neighbour_tables
from msg_analysis.model.step.phases import phases
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.types import AnyArray, BoolArray, FloatArray, IntArray

Array = TypeVar("Array", bound=AnyArray)


def ahead(experiment: ValidExperiment) -> IntArray:
    """(m, m) by receiver and sender: 1 where the sender steps first, in real time with ideal timers, else 0."""
    if experiment.run.pace == "lockstep":
        return np.zeros((experiment.agents, experiment.agents), dtype=np.int64)
    phase = phases(experiment)
    return (phase < phase[:, None]).astype(np.int64)


class AirReception:
    """The reception of block after block of steps, from x(first) = ``start`` (m, R) on."""

    def __init__(self, experiment: ValidExperiment, model: Wiring, start: FloatArray, first: int = 0) -> None:
        self._air = air = Air(experiment, first)
        self._first = first
        links = np.argwhere(model.listens())  # (L, 2): receiver, sender
        self._pairs: list[tuple[int, int]] = [(i, j) for i, j in links.tolist()]
        self._receivers, self._senders = links.T.copy()
        self._agents, self._replicas = model.agents, experiment.run.replicas
        self._numbers = np.full((model.agents, model.agents), len(links))
        self._numbers[links[:, 0], links[:, 1]] = np.arange(len(links))
        self._ahead = ahead(experiment)[links[:, 0], links[:, 1]]
        self._held: FloatArray | None = None
        if air.holds:
            begin = np.array([first])
            self._held = start[self._senders].copy()
            if air.broadcast:
                self._held += self._broadcast(begin)[self._senders, 0]
            if air.link:
                self._held += self._link(begin)[:, 0]

    def block(self, begin: int, count: int) -> Reception:
        """Of the steps begin, ..., begin + count - 1."""
        air = self._air
        latest = begin + count + int(self._ahead.max(initial=0))
        # Before the start, the first message stands for earlier ones.
        steps = np.maximum(self._first, np.arange(begin, latest) - air.delay)
        lost = np.zeros((len(self._pairs) + 1, len(steps)), dtype=np.bool_)
        for link, (i, j) in enumerate(self._pairs if air.loss else ()):
            lost[link] = _of_steps(partial(air.losses, i, j), steps)
        return Reception(
            links=self._numbers,
            first=np.searchsorted(self._receivers, np.arange(self._agents + 1)),
            senders=self._senders,
            ahead=self._ahead,
            delay=air.delay,
            lost=lost,
            broadcast=self._broadcast(steps) if air.broadcast else None,
            link=self._link(steps) if air.link else None,
            held=self._held,
        )

    def _broadcast(self, steps: IntArray) -> FloatArray:
        noise = partial(self._air.broadcast_noise, until=int(steps[-1]) + 1)
        return np.stack([_of_steps(partial(noise, i), steps) for i in range(self._agents)])

    def _link(self, steps: IntArray) -> FloatArray:
        noise = partial(self._air.link_noise, until=int(steps[-1]) + 1)
        noises = [_of_steps(partial(noise, i, j), steps) for i, j in self._pairs]
        return np.array(noises).reshape(len(self._pairs), len(steps), self._replicas)  # there may be no link


def _of_steps(block: Callable[[int], Array], steps: IntArray) -> Array:
    """Entries of these steps, ascending, of what a function gives for every block of steps."""
    numbers = range(int(steps[0]) // STEPS_PER_BLOCK, int(steps[-1]) // STEPS_PER_BLOCK + 1)
    ends = np.searchsorted(steps, [number * STEPS_PER_BLOCK for number in (*numbers, numbers.stop)]).tolist()
    parts = [
        block(number)[steps[first:last] - number * STEPS_PER_BLOCK]
        for number, first, last in zip(numbers, ends, ends[1:], strict=False)
    ]
    return np.concatenate(parts)  # type: ignore[return-value]


def add_broadcast_noise(experiment: ValidExperiment, states: FloatArray) -> FloatArray:
    """(N + 1, m, R) what the agents publish of x(0..N), their values."""
    air, published = Air(experiment), np.empty(states.shape)
    for first in range(0, len(states), STEPS_PER_BLOCK):
        now = states[first : first + STEPS_PER_BLOCK]
        for i in range(states.shape[1]):
            noise = air.broadcast_noise(i, first // STEPS_PER_BLOCK, first + len(now))
            published[first : first + len(now), i] = now[:, i] + noise
    return published


def used_steps(experiment: ValidExperiment, model: Wiring, modes: IntArray) -> IntArray:
    """``used`` of ``Trajectory``, of a run with these graphs (N,) in which all steps are made in time."""
    used = np.full((len(modes), model.agents, model.most_neighbours), NOTHING, dtype=np.int64)
    for at, i, place, _, found in _sources(experiment, model, modes):
        used[at, i, place] = found
    return used


def lost_values(experiment: ValidExperiment, model: Wiring, modes: IntArray) -> BoolArray:
    """``lost`` of ``Trajectory``, of a run in lockstep with these graphs (N,)."""
    lost = np.zeros((len(modes), model.agents, model.most_neighbours), dtype=np.bool_)
    for at, i, place, newest, found in _sources(experiment, model, modes):
        lost[at, i, place] = found != newest
    return lost


def _sources(
    experiment: ValidExperiment, model: Wiring, modes: IntArray
) -> Iterator[tuple[IntArray, int, int, IntArray, IntArray]]:
    """For each neighbour of each agent in each graph: the steps (k,) with that graph, agent and place of the neighbour,
    and of the message that these steps should use, and of the one that they use, the steps (k,).
    """
    air, lead, tables = Air(experiment), ahead(experiment), neighbour_tables(model)
    steps_of = [np.flatnonzero(modes == mode) for mode in range(model.modes)]
    for i, j in np.argwhere(model.listens()).tolist():
        steps = np.maximum(0, np.arange(len(modes)) + lead[i, j] - air.delay)
        found = _of_steps(partial(air.sources, i, j), steps) if air.loss else steps
        for mode, at in enumerate(steps_of):
            for place in np.flatnonzero(tables.senders[mode, i, : tables.count[mode, i]] == j).tolist():
                yield at, i, place, steps[at], found[at]


def lost_messages(experiment: ValidExperiment, receiver: int, sender: int, count: int) -> BoolArray:
    """(count,) whether the messages of the first steps of a run, from sender to receiver, are lost."""
    return _of_steps(partial(Air(experiment).losses, receiver, sender), np.arange(count))
