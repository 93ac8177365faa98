# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Reception: which messages arrive, with what noise, and which value each agent uses.

The message of step k of agent j says x_j(k) + b_j(k); agent i receives y_ij(k) = x_j(k) + b_j(k) + l_ij(k), or nothing
where it is lost, with all its replicas. Noise and loss belong to the message: used twice, it has the same noise. With n
the step of the newest message, i uses that of step s = max(0, n - delay). If it is lost, x_i(k) takes its place (own),
or the newest one before that is not lost (hold; the first one never is).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np

from msg_analysis.arithmetic.reproducible import STEPS_PER_BLOCK, Stream, link_number, normals, uniforms
from msg_analysis.arithmetic.update_law import Reception, from_payload, to_payload
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.step_model import Wiring, ahead, turns


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """The neighbours of every agent in every graph, padded."""

    senders: IntArray  # (n, m, D) the d-th neighbour, ascending; the agent itself beyond their number
    count: IntArray  # (n, m) their number

    @property
    def there(self) -> BoolArray:
        """(n, m, D) whether there is a d-th neighbour."""
        return np.asarray(np.arange(self.senders.shape[2]) < self.count[:, :, None])


@lru_cache(maxsize=4)
def neighbour_tables(wiring: Wiring) -> Neighbours:
    """Tables of the neighbours, in the order of the log."""
    n, m = wiring.modes, wiring.agents
    senders = np.tile(np.arange(m)[:, None], (n, 1, wiring.most_neighbours))
    count = np.zeros((n, m), dtype=np.int64)
    for mode in range(n):
        for i in range(m):
            neighbours = wiring.neighbours(mode, i)
            count[mode, i] = len(neighbours)
            senders[mode, i, : len(neighbours)] = neighbours
    return Neighbours(senders, count)


def ideal_uses(wiring: Wiring, phase: FloatArray) -> IntArray:
    """(n, m, D) 1 for neighbours that are due earlier in a period than the agent, 0 for others; -1: no d-th one."""
    tables = neighbour_tables(wiring)
    return np.where(tables.there, phase[tables.senders] < phase[:, None], -1)


_WITHIN = np.arange(STEPS_PER_BLOCK)


def loss_probabilities(experiment: Experiment) -> tuple[FloatArray, FloatArray]:
    """Of a message after one that was not lost, and after one that was, (m, m) each: receiver, sender."""
    loss, burst = experiment.loss, experiment.noise.burst
    if burst is None:
        return loss, loss
    return loss / (burst * (1.0 - loss)), np.where(loss > 0.0, 1.0 - 1.0 / burst, 0.0)


class Losses:
    """The lost messages of every link, block after block of steps, by one uniform number for each message."""

    # With bursts a link is a stationary Markov chain (Gilbert 1960). A number below both ``after_lost`` and
    # ``after_kept`` means lost, above both not lost, between them the same as before (or the opposite, if losses come
    # more evenly than independent ones): the newest number that decides alone is all that must be known of the past.

    def __init__(self, experiment: Experiment) -> None:
        self._seed, self._whole = experiment.run.seed, bool(experiment.noise.whole_link)
        after_kept, after_lost = loss_probabilities(experiment)
        self._low, self._high = np.minimum(after_kept, after_lost), np.maximum(after_kept, after_lost)
        self._opposite = after_kept > after_lost
        # Of each link, the block that was drawn last, and whether its last message was lost.
        self._ends: dict[tuple[int, int], tuple[int, bool]] = {}

    def block(self, receiver: int, sender: int, number: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost in a block."""
        link = receiver, sender
        if not self._high[link]:
            return np.zeros(STEPS_PER_BLOCK, dtype=np.bool_)
        lost, decided = self._drawn(link, number)
        if decided.all():
            return lost
        newest = np.maximum.accumulate(np.where(decided, _WITHIN, -1))
        before = self._end(link, number - 1) if newest[0] < 0 else False
        lost = np.where(newest < 0, before, lost[newest])
        if self._opposite[link]:
            lost ^= (_WITHIN - newest) % 2 == 1
        self._ends[link] = number, bool(lost[-1])
        return lost

    def _drawn(self, link: tuple[int, int], number: int) -> tuple[BoolArray, BoolArray]:
        """Of every message of a block, whether its number alone makes it lost, and whether it decides alone."""
        of = (max(link), min(link)) if self._whole else link
        drawn = uniforms(self._seed, Stream.LOSS, link_number(*of), number, STEPS_PER_BLOCK)
        lost: BoolArray = drawn < self._low[link]
        return lost, lost | (drawn >= self._high[link])

    def _end(self, link: tuple[int, int], number: int) -> bool:
        """Whether the last message of a block is lost."""
        known = self._ends.get(link)
        if known and known[0] == number:
            return known[1]
        distance = 0
        while True:
            lost, decided = self._drawn(link, number)
            if decided.any():
                newest = int(np.flatnonzero(decided)[-1])
                odd = (distance + STEPS_PER_BLOCK - 1 - newest) % 2 == 1
                return bool(lost[newest]) ^ bool(self._opposite[link] and odd)
            number, distance = number - 1, distance + STEPS_PER_BLOCK


LOST = 2**64 - 1  # in ``heard`` of a state message, of a lost message; no step of a run has this number
NOTHING = -1  # in place of the step of a message: none, so that the agent uses its own value


class Air:
    """The random numbers of noise and loss on the air, block after block of steps."""

    # They do not depend on the graph: they are drawn for a link and a step whether that step uses the link or not.

    def __init__(self, experiment: Experiment, start: int = 0) -> None:
        noise = experiment.noise
        self.broadcast, self.link, self.loss = noise.broadcast, noise.link, noise.loss.any
        self.delay, self.holds = noise.delay, noise.holds
        self.start = start  # step of the first messages; negative for a past before the run
        self._seed = experiment.run.seed
        self._replicas = experiment.run.replicas
        self._losses = Losses(experiment)
        # Of each link, the block whose sources were found last, and the last one of them.
        self._ends: dict[tuple[int, int], tuple[int, int]] = {}
        # The step that an agent makes and the step of the state that it publishes may be in two blocks.
        self._broadcast_block = lru_cache(maxsize=2)(self.broadcast_noise)

    def broadcast_noise(self, agent: int, block: int, until: int | None = None) -> FloatArray:
        """(STEPS_PER_BLOCK, replicas): b of an agent (from 0) in a block of steps, or in those before ``until``."""
        return self.broadcast * normals(self._seed, Stream.BROADCAST, agent, block, self._shape(block, until))

    def link_noise(self, receiver: int, sender: int, block: int, until: int | None = None) -> FloatArray:
        """The same of l of the messages from sender to receiver (indices from 0)."""
        link = link_number(receiver, sender)
        return self.link * normals(self._seed, Stream.LINK, link, block, self._shape(block, until))

    def _shape(self, block: int, until: int | None) -> tuple[int, int]:
        steps = STEPS_PER_BLOCK if until is None else min(STEPS_PER_BLOCK, until - block * STEPS_PER_BLOCK)
        return steps, self._replicas

    def losses(self, receiver: int, sender: int, block: int) -> BoolArray:
        """(STEPS_PER_BLOCK,): which messages from sender to receiver (indices from 0) are lost in a block."""
        lost = self._losses.block(receiver, sender, block)
        if self.holds and block == self.start // STEPS_PER_BLOCK:
            lost[self.start % STEPS_PER_BLOCK] = False
        return lost

    def sources(self, receiver: int, sender: int, block: int) -> IntArray:
        """(STEPS_PER_BLOCK,): step of the message used where that of each step should be; NOTHING: the own value."""
        steps = block * STEPS_PER_BLOCK + np.arange(STEPS_PER_BLOCK)
        came = np.where(self.losses(receiver, sender, block), NOTHING, steps)
        if not self.holds:
            return came
        link = receiver, sender
        known, held = self._ends.get(link, (None, NOTHING))
        before = block
        if known != block - 1:
            held = NOTHING
        while came[0] == NOTHING and held == NOTHING:
            before -= 1
            kept = np.flatnonzero(~self.losses(receiver, sender, before))
            held = before * STEPS_PER_BLOCK + int(kept[-1]) if len(kept) else NOTHING
        found = np.maximum.accumulate(np.maximum(came, held))
        self._ends[link] = block, int(found[-1])
        return found

    def published(self, agent: int, step: int, state: FloatArray) -> FloatArray:
        """What an agent (index from 0) publishes of its state (replicas,) of a step."""
        block, within = divmod(step, STEPS_PER_BLOCK)
        return np.asarray(state + self._broadcast_block(agent, block)[within])


Array = TypeVar("Array", bound=AnyArray)


class AirReception:
    """The reception of block after block of steps, from x(first) = ``start`` (m, R) on."""

    def __init__(self, experiment: Experiment, model: Wiring, start: FloatArray, first: int = 0) -> None:
        self._air = air = Air(experiment, first)
        self._first = first
        links = np.argwhere(model.listens())  # (L, 2): receiver, sender
        self._pairs: list[tuple[int, int]] = [(i, j) for i, j in links.tolist()]
        self._receivers, self._senders = links.T.copy()
        self._agents, self._replicas = model.agents, experiment.run.replicas
        self._numbers = np.full((model.agents, model.agents), len(links))
        self._numbers[links[:, 0], links[:, 1]] = np.arange(len(links))
        self._ahead = ahead(turns(experiment), experiment.agents)[links[:, 0], links[:, 1]]
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
    """Each sender and block of messages with the steps ``used``; which entries these are, and their places in it."""
    block, within = np.divmod(used, STEPS_PER_BLOCK)
    heard = used != NOTHING
    for sender, number in {*zip(senders[heard].tolist(), block[heard].tolist(), strict=True)}:
        these = (senders == sender) & (block == number)
        yield sender, number, these, within[these]


class MessagesUsed:
    """Which messages are used in a run in which all steps are made in time, block after block of steps."""

    def __init__(self, experiment: Experiment, model: Wiring) -> None:
        self._air, self._tables = Air(experiment), neighbour_tables(model)
        self._lead = ahead(turns(experiment), model.agents)
        self._pairs: list[tuple[int, int]] = [(i, j) for i, j in np.argwhere(model.listens()).tolist()]
        # (n, m, D) number of the link from each neighbour in each graph; L beyond the last neighbour.
        self._links = np.full(self._tables.senders.shape, len(self._pairs))
        there = self._tables.there
        numbers = np.zeros((model.agents, model.agents), dtype=np.int64)
        for number, link in enumerate(self._pairs):
            numbers[link] = number
        receivers = np.arange(model.agents)[:, None]
        self._links[there] = numbers[receivers, self._tables.senders][there]

    def used(self, first: int, modes: IntArray) -> IntArray:
        """(K, m, D) entries of ``used`` of ``Run`` for the steps first, ... with these graphs (K,)."""
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


class AgentAir:
    """What happens to the messages of an agent (index from 0) and to those for it; see the module."""

    def __init__(self, experiment: Experiment, model: Wiring, agent: int) -> None:
        self._agent = agent
        self._air = air = Air(experiment)
        self.delay, self.broadcast, self.link, self.loss = air.delay, air.broadcast, air.link, air.loss
        # The newest message and the one that is used may be in two blocks.
        links = 2 * max(1, int(model.listens()[agent].sum()))

        @lru_cache(maxsize=links)
        def sources(sender: int, block: int) -> list[int]:
            steps = range(block * STEPS_PER_BLOCK, (block + 1) * STEPS_PER_BLOCK)
            return air.sources(agent, sender, block).tolist() if air.loss else list(steps)

        @lru_cache(maxsize=links)
        def noise(sender: int, block: int) -> FloatArray:
            return air.link_noise(agent, sender, block)

        self._sources, self._noise = sources, noise

    @property
    def looks_back(self) -> bool:
        """Whether steps can use messages of earlier steps than the newest."""
        return self.delay > 0 or self._air.holds

    def source(self, sender: int, newest: int) -> int:
        """Step of the message that is used when the newest one is of the step ``newest``; NOTHING: the own value."""
        block, within = divmod(max(0, newest - self.delay), STEPS_PER_BLOCK)
        return self._sources(sender, block)[within]

    def lost(self, sender: int, step: int) -> bool:
        """Whether the message of a step is lost."""
        return self._sources(sender, step // STEPS_PER_BLOCK)[step % STEPS_PER_BLOCK] != step

    def needed(self, sender: int, step: int) -> int:
        """Step of the message that an agent waits for to make a step in lockstep: it may be lost all the same."""
        return self.source(sender, step) if self._air.holds else max(0, step - self.delay)

    def oldest_needed(self, step: int, peers: Iterable[int]) -> int:
        """First step of which a message between the agent and one of its peers is used in a step from ``step`` on."""
        oldest = max(0, step - self.delay)
        if not self._air.holds:
            return oldest
        block, within = divmod(oldest, STEPS_PER_BLOCK)
        links = [link for j in peers for link in ((self._agent, j), (j, self._agent))]
        return min((int(self._air.sources(*link, block)[within]) for link in links), default=oldest)

    def receive(
        self, senders: Sequence[int], step: int, heard: Sequence[bytes], steps: Sequence[int] | None
    ) -> tuple[list[bytes | None], tuple[int, ...]]:
        """What is received of these senders in a step, None where the own value is used; and ``AgentLaw.heard``."""
        logged: tuple[int, ...] = ()
        if steps is None:
            newest = max(0, step - self.delay)
            block, within = divmod(newest, STEPS_PER_BLOCK)
            steps = [self._sources(sender, block)[within] for sender in senders]
            if steps != [newest] * len(steps):
                logged = tuple([LOST if source == NOTHING else source for source in steps])
        values: list[bytes | None] = [*heard]
        for d, source in enumerate(steps):
            if source == NOTHING:
                values[d] = None
            elif self.link:
                values[d] = self._received(senders[d], source, heard[d])
        return values, logged

    def _received(self, sender: int, step: int, value: bytes) -> bytes:
        """A published value, a payload, with the noise of the link."""
        block, within = divmod(step, STEPS_PER_BLOCK)
        return to_payload(from_payload(value) + self._noise(sender, block)[within])

    def published(self, step: int, value: FloatArray) -> bytes:
        """The payload that is published of a value (replicas,)."""
        return to_payload(self._air.published(self._agent, step, value) if self.broadcast else value)
