# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Order of the steps of a run in real time, and the state of the network at the sampling times.

All is computed in blocks, and kept in arrays that are in a file where they are large.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from msg_analysis.arithmetic.step_clock import StepClock
from msg_analysis.common.arrays import FloatArray, IntArray, column, large_zeros, pieces, release
from msg_analysis.inference.observation import Observation, Timers
from msg_analysis.model.reception import neighbour_tables

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
        """Steps and agents (e,) of the events after sampling time first - 1 and up to last - 1, agent after agent.

        ``first``: 0 for the beginning; ``last``: N + 2 for the end.
        """
        m = self.newest.shape[1]
        begin = self.newest[first - 1] if first else np.zeros(m, dtype=np.int64)
        end = self.newest[last - 1] if last <= len(self.newest) else np.full(m, len(self.position))
        return spread(begin, end - 1)


def _zeros(rows: int, columns: int) -> IntArray:
    """One of several arrays like the times in the log."""
    return large_zeros((rows, columns), np.int64, total=8 * 8 * rows * columns)


def order_events(observation: Observation) -> EventOrder:
    """Order the events of a run in real time by time; at equal times, a value comes before the steps that use it.

    Equal times are common where the agents' clock moves in jumps, and when a late agent catches up.
    """
    timers = _timers(observation)
    newest = newest_steps(observation)
    contradiction, ties = _early_and_equal(observation, timers)
    turn, circular = _turns_of(timers, ties)
    if circular:
        contradiction = contradiction or "agents used new values of each other at the same time"
    order = EventOrder(_zeros(*timers.graphs.shape), newest, contradiction)
    placed = 0
    for first, last in _blocks_of_periods(observation):
        steps, agents = order.events(first, last)
        chosen = np.lexsort((agents, steps, turn[steps + 1, agents], timers.made[steps + 1, agents]))
        order.position[steps[chosen], agents[chosen]] = np.arange(placed, placed + len(chosen))
        placed += len(chosen)
        for array in (order.position, order.newest, turn):
            release(array)
    return order


def _blocks_of_periods(observation: Observation) -> Iterator[tuple[int, int]]:
    """As for ``EventOrder.events``, so that all events are in one of the blocks."""
    numbers = (4 + observation.step.most_neighbours) * observation.step.agents
    ends = [last for _, last in observation.blocks(numbers, "order of the steps")]
    return pairwise([0, *ends[:-1], observation.steps + 2])


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


def _turns_of(timers: Timers, ties: IntArray) -> tuple[IntArray, bool]:
    """(N + 1, m): of states with equal times, which comes first; and whether there is a circle."""
    turn, m, circular = _zeros(*timers.made.shape), timers.made.shape[1], False
    times = timers.made[ties[:, 2], ties[:, 3]]
    order = np.argsort(times, kind="stable")
    ties, times = ties[order], times[order]
    begin = 0
    while begin < len(ties):  # all pairs of one time together
        last = times[min(begin + TIES_AT_ONCE, len(ties)) - 1]
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
    made, times = _timers(observation).made, sampling_times(observation)
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


def _timers(observation: Observation) -> Timers:
    assert observation.timers is not None
    return observation.timers
