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


def add_broadcast_noise(air: Air, states: FloatArray, first: int) -> FloatArray:
    """(K, m, R) what the agents publish of x(first), ..., their values."""
    noise, steps = partial(air.broadcast_noise, until=first + len(states)), np.arange(first, first + len(states))
    return states + np.stack([_of_steps(partial(noise, i), steps) for i in range(states.shape[1])], axis=1)


def by_sender_and_block(senders: IntArray, used: IntArray) -> Iterator[tuple[int, int, BoolArray, IntArray]]:
    """Of messages from ``senders`` with the steps ``used`` (NOTHING: none), arrays of one shape: each sender and block.

    With each, which entries are its messages, and the places of their steps in the block.
    """
    block, within = np.divmod(used, STEPS_PER_BLOCK)
    heard = used != NOTHING
    for sender, number in {*zip(senders[heard].tolist(), block[heard].tolist(), strict=True)}:
        these = (senders == sender) & (block == number)
        yield sender, number, these, within[these]


class MessagesUsed:
    """Which messages are used in a run in which all steps are made in time, block after block of steps."""

    def __init__(self, experiment: ValidExperiment, model: Wiring) -> None:
        self._air, self._lead, self._tables = Air(experiment), ahead(experiment), neighbour_tables(model)
        self._pairs: list[tuple[int, int]] = [(i, j) for i, j in np.argwhere(model.listens()).tolist()]
        # (n, m, D) number of the link from each neighbour in each graph; L beyond the last neighbour.
        self._links = np.full(self._tables.senders.shape, len(self._pairs))
        there = np.arange(model.most_neighbours) < self._tables.count[:, :, None]
        numbers = np.zeros((model.agents, model.agents), dtype=np.int64)
        for number, link in enumerate(self._pairs):
            numbers[link] = number
        receivers = np.arange(model.agents)[:, None]
        self._links[there] = numbers[receivers, self._tables.senders][there]

    def used(self, first: int, modes: IntArray) -> IntArray:
        """(K, m, D) entries of ``used`` of ``Trajectory`` for the steps first, ... with these graphs (K,)."""
        found = np.full((len(self._pairs) + 1, len(modes)), NOTHING, dtype=np.int64)
        steps = np.arange(first, first + len(modes))
        for number, (i, j) in enumerate(self._pairs if len(modes) else ()):
            should = np.maximum(0, steps + self._lead[i, j] - self._air.delay)
            found[number] = _of_steps(partial(self._air.sources, i, j), should) if self._air.loss else should
        return np.asarray(found[self._links[modes], np.arange(len(modes))[:, None, None]])

    def lost(self, first: int, used: IntArray, modes: IntArray) -> BoolArray:
        """The same of ``lost``, in lockstep; ``used`` is that of these steps."""
        newest = np.maximum(0, np.arange(first, first + len(modes)) - self._air.delay)
        there = self._links[modes] < len(self._pairs)
        return np.asarray(there & (used != newest[:, None, None]))
