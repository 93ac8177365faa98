# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Order of the steps of a run in real time, the state at the sampling times, and what every step used.

All is computed in blocks, and stored in arrays that are in a file where they are large.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.common.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    LargeRows,
    column,
    large_zeros,
    pieces,
    release,
)
from msg_analysis.inference.observation import Observation, Timers
from msg_analysis.model.reception import neighbour_tables
from msg_analysis.model.step_model import StepModel

TIES_AT_ONCE = 100_000  # pairs of events at equal times that are put in order together


@dataclass(frozen=True, slots=True, eq=False)
class EventOrder:
    """The steps of all agents as one sequence of events. Event (k, i) is the one in which agent i makes x_i(k+1)."""

    position: IntArray  # (N, m) place of the events
    newest: IntArray  # (N + 1, m) step of each agent's newest state that was made at simulated time <= k dt
    contradiction: str | None = None  # why the times in the log contradict cause and effect; None where they do not

    @classmethod
    def of_lockstep(cls, steps: int, agents: int) -> EventOrder:
        """Of a run in which all agents make each step at the same time."""
        position, newest = _zeros(steps, agents), _zeros(steps + 1, agents)
        for piece in pieces(newest):
            newest[piece] = np.arange(*piece.indices(steps + 1))[:, None]
        for piece in pieces(position):
            position[piece] = agents * np.arange(*piece.indices(steps))[:, None] + np.arange(agents)
        return cls(position, newest)

    def events(self, first: int, last: int) -> tuple[IntArray, IntArray]:
        """Steps and agents (e,) of the events after sampling time first - 1 and up to last - 1 (0 and N + 2: all)."""
        m = self.newest.shape[1]
        begin = self.newest[first - 1] if first else np.zeros(m, dtype=np.int64)
        end = self.newest[last - 1] if last <= len(self.newest) else np.full(m, len(self.position))
        return spread(begin, end - 1)


def _zeros(rows: int, columns: int) -> IntArray:
    """One of several arrays like the times in the log."""
    return large_zeros((rows, columns), np.int64, total=8 * 8 * rows * columns)


def order_events(observation: Observation, ties_at_once: int = TIES_AT_ONCE) -> EventOrder:
    """Order the events of a run in real time by time; at equal times, a value comes before the steps that use it."""
    # Equal times are common where the agents' clock moves in jumps, and when a late agent catches up.
    timers = observation.timed
    newest = newest_steps(observation)
    contradiction, ties = _early_and_equal(observation, timers)
    turn, circular = _turns_of(timers, ties, ties_at_once)
    if circular:
        contradiction = contradiction or "agents used new values of each other at the same time"
    order = EventOrder(_zeros(*timers.graphs.shape), newest, contradiction)
    placed = 0
    numbers = (4 + observation.step.most_neighbours) * observation.step.agents
    ends = [last for _, last in observation.blocks(numbers, "order of the steps")]
    for first, last in pairwise([0, *ends[:-1], observation.steps + 2]):  # so that all events are in one of the blocks
        steps, agents = order.events(first, last)
        chosen = np.lexsort((agents, steps, turn[steps + 1, agents], timers.made[steps + 1, agents]))
        order.position[steps[chosen], agents[chosen]] = np.arange(placed, placed + len(chosen))
        placed += len(chosen)
        for array in (order.position, order.newest, turn):
            release(array)
    return order


def _early_and_equal(observation: Observation, timers: Timers) -> tuple[str | None, IntArray]:
    """What contradicts cause and effect; (t, 4) pairs of states of one time, the first one first: step and agent."""
    tables, agents = neighbour_tables(observation.step), np.arange(observation.step.agents)
    early, text, decreasing = 0, "", False
    ties = [np.empty((0, 4), dtype=np.int64)]
    for first, last in observation.blocks(4 * timers.used[:1].size, "order of the steps"):
        senders = tables.senders[timers.graphs[first:last], agents]
        used, made = timers.used[first:last], timers.made[first : last + 1]
        after = made[1:]
        received = np.where(used >= 0, timers.made[used, senders], np.int64(-1))
        wrong = np.argwhere(received > after[:, :, None])
        if len(wrong) and not early:
            k, i, d = wrong[0].tolist()
            text = (
                f"in step {first + k} agent {i + 1} used a value that agent {senders[k, i, d] + 1} computed "
                f"{(received[k, i, d] - after[k, i]) / 1e9:.3g} units of time later"
            )
        early += len(wrong)
        decreasing = decreasing or bool((np.diff(made, axis=0) < 0).any() or (after <= 0).any())
        k, i = np.nonzero(after == made[:-1])
        ties.append(np.column_stack([first + k, i, first + k + 1, i])[first + k > 0])
        k, i, d = np.nonzero((received == after[:, :, None]) & (used > 0))
        ties.append(np.column_stack([used[k, i, d], senders[k, i, d], first + k + 1, i]))
    if early:
        return f"{text} ({early} such cases): their clocks disagree", np.concatenate(ties)
    return ("the times of an agent's states decrease: its clock was set back" if decreasing else None), np.concatenate(
        ties
    )


def _turns_of(timers: Timers, ties: IntArray, ties_at_once: int) -> tuple[IntArray, bool]:
    """(N + 1, m): of states with equal times, which comes first; and whether there is a circle."""
    turn, m, circular = _zeros(*timers.made.shape), timers.made.shape[1], False
    times = timers.made[ties[:, 2], ties[:, 3]]
    order = np.argsort(times, kind="stable")
    ties, times = ties[order], times[order]
    begin = 0
    while begin < len(ties):  # all pairs of one time together
        last = times[min(begin + ties_at_once, len(ties)) - 1]
        end = int(np.searchsorted(times, last, side="right"))
        cells, place = np.unique(ties[begin:end].reshape(-1, 2) @ [m, 1], return_inverse=True)
        source, target = place.reshape(-1, 2).T
        found, circle = _turns(source, target, len(cells))
        turn[cells // m, cells % m] = found
        circular = circular or circle
        begin = end
    return turn, circular


def _turns(source: IntArray, target: IntArray, count: int) -> tuple[IntArray, bool]:
    """A place for each of ``count`` items, every source before its target; and whether there is a cycle."""
    turn = np.zeros(count, dtype=np.int64)
    order = np.lexsort((target, source))
    ends = np.searchsorted(source[order], np.arange(count + 1)).tolist()
    targets = target[order].tolist()
    waits_for = np.bincount(target, minlength=count)
    ready = np.setdiff1d(source, target).tolist()
    waiting = waits_for.tolist()
    for one in ready:  # grows during the loop
        for other in targets[ends[one] : ends[one + 1]]:
            waiting[other] -= 1
            if not waiting[other]:
                ready.append(other)
    turn[ready] = np.arange(1, len(ready) + 1)
    return turn, any(waiting)


def newest_steps(observation: Observation) -> IntArray:
    """``EventOrder.newest`` of a run in real time."""
    made, times = observation.timed.made, sampling_times(observation)
    newest = _zeros(*made.shape)
    for i in range(made.shape[1]):
        found = np.searchsorted(np.maximum.accumulate(column(made, i)), times, side="right") - 1
        for piece in pieces(newest):
            newest[piece, i] = found[piece]
    return newest


def sampled(observation: Observation, order: EventOrder) -> FloatArray:
    """(N + 1, m, R): the newest states at simulated time k dt, which are compared in real time."""
    shape, agents = observation.states.shape, np.arange(observation.step.agents)
    states = large_zeros(shape, np.float64, total=observation.states.nbytes)
    for first, last in observation.blocks(observation.states[0].size, "states at the sampling times"):
        rows = slice(first, last + 1)  # the last one again in the next block
        states[rows] = observation.states[order.newest[rows], agents]
        release(states)
        release(order.newest)
    return states


def spread(first: IntArray, last: IntArray) -> tuple[IntArray, IntArray]:
    """All integers first..last of many ranges, and the index of each one's range."""
    lengths = np.maximum(last - first + 1, 0)
    which = np.repeat(np.arange(len(first)), lengths)
    starts = np.cumsum(lengths) - lengths
    return first[which] + np.arange(len(which)) - starts[which], which


def sampling_times(observation: Observation) -> IntArray:
    """(N + 1,): k dt [ns of simulated time]."""
    return StepClock(observation.step.dt).times(np.arange(observation.steps + 1))


OWN = int(np.iinfo(np.int32).min)  # stands for a value that was never received; the agent's own value takes its place


@dataclass(frozen=True, slots=True, eq=False)
class PeriodTable:
    """Rows of the periods, of period K those from ends[K] to ends[K + 1]."""

    rows: IntArray
    ends: IntArray

    def __getitem__(self, number: int) -> IntArray:
        return self.rows[self.ends[number] : self.ends[number + 1]]


class Entries:
    """Numbers of what may be stacked: states of m agents, m sources of noise, what m agents sent, and links brought."""

    def __init__(self, step: StepModel) -> None:
        self.agents = step.agents
        pairs = np.argwhere(step.listens())
        self.owners = np.concatenate([np.tile(np.arange(step.agents), 3), pairs[:, 1]])  # agent whose value it is
        self.links = np.full((step.agents, step.agents), -1)  # (m, m) by receiver and sender
        self.links[pairs[:, 0], pairs[:, 1]] = 3 * step.agents + np.arange(len(pairs))
        # (m,): whether more than one agent feels a source of noise, in any graph
        self.shared: BoolArray = np.asarray((step.noise_gain != 0.0).any(axis=0).sum(axis=0) > 1)


def period_tables(observation: Observation, order: EventOrder) -> tuple[PeriodTable, PeriodTable]:
    """All that the maps of the periods of a run in real time depend on: events, in their order, and what is stacked."""
    # Events: agent, graph, step - K of the noise that is shared, own step, steps of the values used, and whether a
    # message is used once (0), for the first of several times (1) or again (2): steps from the newest ones at K - 1.
    # What is stacked at K after the newest states: entry, step from the newest one (of a source of noise: from K).
    return _Maker(observation, observation.timed, order).tables()


class _Maker:
    """Makes the tables."""

    def __init__(self, observation: Observation, timers: Timers, order: EventOrder) -> None:
        self._observation, self._timers, self._order = observation, timers, order
        self._step, self._entries = observation.step, Entries(observation.step)
        self._senders = neighbour_tables(observation.step).senders
        self._times = sampling_times(observation)[: observation.steps]
        self._begun: AnyArray | None = None
        if observation.step.link:
            self._begun = self._first_uses()

    def tables(self) -> tuple[PeriodTable, PeriodTable]:
        """Of all periods."""
        steps, most = self._observation.steps, self._step.most_neighbours
        lives, parts = self._lives()
        events, extras = LargeRows(4 + 2 * most, np.int32), LargeRows(2, np.int32)
        event_ends, extra_ends = np.zeros(steps + 1, np.int64), np.zeros(steps + 1, np.int64)
        for first, last in self._blocks():
            found = self._events(first, last)
            events.append(found[:, 1:])
            event_ends[first + 1 : last + 1] = np.bincount(found[:, 0] - first, minlength=last - first)
            found = self._stacked(lives, parts, first, last)
            release(lives)
            extras.append(found[:, 1:])
            extra_ends[first + 1 : last + 1] = np.bincount(found[:, 0] - first, minlength=last - first)
        return PeriodTable(events.array(), np.cumsum(event_ends)), PeriodTable(extras.array(), np.cumsum(extra_ends))

    def _blocks(self) -> Iterator[tuple[int, int]]:
        numbers = 4 * (4 + 2 * self._step.most_neighbours) * self._step.agents
        for block in self._observation.blocks(numbers, "values in use"):
            yield block
            for array in (self._order.position, self._order.newest, self._begun):
                if array is not None:
                    release(array)

    def _period(self, made: IntArray) -> IntArray:
        """Number of the period in which something was made, of any shape; N: after the last one."""
        return np.searchsorted(self._times, made, side="left")

    def _first_uses(self) -> AnyArray:
        """(N, m, D): of messages that an agent uses several times, the step of the first use; else -1."""
        used, graphs = self._timers.used, self._timers.graphs
        begun = large_zeros(used.shape, np.int32, total=8 * used.size)
        for first, last in self._blocks():
            begun[first:last] = -1
        for i in range(self._step.agents):
            seen = int(self._order.newest[self._observation.steps - 1, i])
            senders, received = self._senders[column(graphs, i)[:seen], i], column(used, i)[:seen]
            k, d = np.nonzero(received >= 0)
            by = np.lexsort((received[k, d], senders[k, d]))  # uses of a message stay in the order of the agent's steps
            k, d = k[by], d[by]
            new = (np.diff(received[k, d], prepend=-1) != 0) | (np.diff(senders[k, d], prepend=-1) != 0)
            start = np.flatnonzero(new)
            count = np.diff(start, append=len(k))
            again = np.repeat(count > 1, count)
            begun[k[again], i, d[again]] = np.repeat(k[start], count)[again]
            release(begun)
        return begun

    def _events(self, first: int, last: int) -> IntArray:
        """Rows of the period and of its events."""
        k, i = self._order.events(first, last)
        by = np.argsort(self._order.position[k, i])
        k, i = k[by], i[by]
        period = self._period(self._timers.made[k + 1, i])
        graphs, used = self._timers.graphs[k, i], self._timers.used[k, i]
        newest = self._order.newest[period[:, None] - 1, self._senders[graphs, i]]  # an event is later than 0
        again = np.zeros_like(used)
        if self._begun is not None:
            begun = self._begun[k, i]
            again = np.where(begun < 0, 0, np.where(begun == k[:, None], 1, 2))
        lag = k - period if self._entries.shared.any() else np.zeros_like(k)
        own = k - self._order.newest[period - 1, i]
        offsets = np.where(used >= 0, used - newest, OWN)
        return np.column_stack([period, i, graphs, lag, own, offsets, again])

    def _lives(self) -> tuple[AnyArray, list[tuple[int, int, slice]]]:
        """Values that are stacked: entry, step, first and last sampling time; and the first and last one by part."""
        rows, parts = LargeRows(4, np.int32), []
        for first, last in self._blocks():
            found = np.concatenate([*self._lives_of_values(first, last), *self._lives_of_noise(first, last)])
            found = found[found[:, 3] >= found[:, 2]]
            begin = rows.append(found)
            if len(found):
                parts.append((int(found[:, 2].min()), int(found[:, 3].max()), slice(begin, begin + len(found))))
        return rows.array(), parts

    def _lives_of_values(self, begin: int, end: int) -> Iterator[IntArray]:
        """Of the values used in some steps."""
        timers, step, m = self._timers, self._step, self._step.agents
        graphs, used, made = timers.graphs[begin:end], timers.used[begin:end], timers.made
        senders = self._senders[graphs, np.arange(m)]
        period = self._period(made[begin + 1 : end + 1])
        received = (used >= 0) & (period < self._observation.steps)[:, :, None]
        again = np.zeros_like(received)
        if self._begun is not None:
            first_use = self._begun[begin:end]
            again = received & (first_use >= 0) & (first_use != np.arange(begin, end)[:, None, None])
        k, i, d = np.nonzero(received & ~again)
        sender, message, last = senders[k, i, d], used[k, i, d], period[k, i] - 1
        if step.broadcast:  # from the first sampling time at which it has been published
            first = np.where(message > 0, self._period(made[message, sender]), 0)
            yield np.column_stack([2 * m + sender, message, first, last])
        else:  # from the first one at which that agent has a newer state
            chosen = message < self._order.newest[last, sender]
            sender, message, last = sender[chosen], message[chosen], last[chosen]
            yield np.column_stack([sender, message, self._period(made[message + 1, sender]), last])
        k, i, d = np.nonzero(again)
        if len(k):
            assert self._begun is not None
            first = self._period(made[self._begun[begin + k, i, d] + 1, i])
            yield np.column_stack([self._entries.links[i, senders[k, i, d]], used[k, i, d], first, period[k, i] - 1])

    def _lives_of_noise(self, begin: int, end: int) -> Iterator[IntArray]:
        """Of the shared noise of some steps, which some agents have made and others not yet."""
        sources = np.flatnonzero(self._entries.shared)
        if not len(sources):
            return
        period = self._period(self._timers.made[begin + 1 : end + 1])
        first, last = period.min(axis=1), np.minimum(period.max(axis=1), self._observation.steps) - 1
        for source in sources.tolist():
            entry = np.full(end - begin, self._step.agents + source)
            yield np.column_stack([entry, np.arange(begin, end), first, last])

    def _stacked(self, lives: AnyArray, parts: list[tuple[int, int, slice]], first: int, last: int) -> IntArray:
        """Rows of the sampling time and of what is stacked there, each once, sorted."""
        chosen = [lives[rows].astype(np.int64) for low, high, rows in parts if low < last and high >= first]
        entry, step, begin, end = np.concatenate([np.empty((0, 4), np.int64), *chosen]).T
        at, which = spread(np.maximum(begin, first), np.minimum(end, last - 1))
        entry, step = entry[which], step[which]
        m, owner = self._step.agents, self._entries.owners[entry]
        noise = (entry >= m) & (entry < 2 * m)
        offset = step - np.where(noise, at, self._order.newest[at, owner])
        by = np.lexsort((offset, entry, at))
        rows = np.column_stack([at, entry, offset])[by]
        new = np.ones(len(rows), dtype=np.bool_)
        new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
        return np.asarray(rows[new])
