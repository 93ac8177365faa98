# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""When an agent may make its next step: the distributed lockstep. No ROS, no arithmetic.

Agent i makes step k (from x(k) to x(k+1)) when it knows the graph g(k), has x_j(k) from every j that row i of W_g(k)
uses, and no agent that it can ever exchange states with is more than ``window`` steps behind it. There is no barrier
and no master. The last rule bounds every buffer even while the graph is disconnected, and it cannot cause a deadlock:
the agent that is furthest behind is ahead of none, and all that it waits for has been published.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from operator import itemgetter
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

from msg_analysis.messages.acceptance import Refusal

Value = TypeVar("Value")
NOTHING = -1  # in place of a step: no state received yet


class AgentInputs(Generic[Value]):
    """Steps count from 0; x(0) is the start, the run ends at x(steps). Agents count from 0, in texts from 1."""

    def __init__(
        self,
        *,
        agent: int,
        steps: int,  # N
        inputs: Sequence[Sequence[int]],  # per mode, the other agents that the agent's row uses, ascending
        peers: Collection[int],  # every other agent with which it ever exchanges states; includes ``inputs``
        start: int = 0,  # the current step, after a takeover
    ) -> None:
        self.agent, self.step, self.steps = agent, start, steps
        self._inputs = [tuple(row) for row in inputs]
        self._newest = dict.fromkeys(sorted(peers), NOTHING)  # newest step received of each peer
        missing = {j for row in inputs for j in row} - self._newest.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, which are not among its peers {sorted(peers)}")

    def end_at(self, steps: int) -> None:
        """The run ends early, at x(steps); not before the current step."""
        self.steps = max(steps, self.step)

    @property
    def finished(self) -> bool:
        """Whether x(steps) has been reached."""
        return self.step >= self.steps


TURN_SLICE = 0.02  # s of steps without a break, after which the executor gets its turn: messages, timers, signals


class Member(Protocol):
    """What takes turns."""

    def advance(self) -> None:
        """Make every step that can be made now."""


class TurnQueue:
    """Gives turns in the order of the requests, once all ``members`` (a number) have joined."""

    # A step of one agent lets others step, and theirs others again: the queue replaces nested calls, which would go as
    # deep as the run is long.
    def __init__(
        self,
        members: int,
        defer: Callable[[Callable[[], None]], object],  # runs a callback after what is already waiting in the executor
        after: Callable[[], None],  # is called when turns have been given
        turn: float = TURN_SLICE,  # s
    ) -> None:
        self._absent, self._defer, self._after, self._turn = members, defer, after, turn
        self._queue: deque[Member] = deque()
        self._given = True  # turns are being given, or will be: ``ask`` need not start that

    def join(self, member: Member) -> None:
        """Add a member, which gets a turn as soon as all have joined: before, some may not be ready for messages."""
        self._absent -= 1
        self._queue.append(member)
        if not self._absent:
            self._give()

    def ask(self, member: Member) -> None:
        """Get a turn: now, or after the members that asked before."""
        self._queue.append(member)
        if not self._given:
            self._give()

    def _give(self) -> None:
        self._given = True
        queue, until = self._queue, time.monotonic() + self._turn
        while queue:
            queue.popleft().advance()
            if time.monotonic() > until and queue:
                self._after()
                self._defer(self._give)
                return
        self._after()
        self._given = False


LOCKSTEP_WINDOW = 64  # steps that an agent may be ahead of a peer; a burst of so many fits a socket's receive buffer
RESEND_LIMIT = 6000  # most steps that an agent keeps, and sends again when another one was killed
# Steps for which a used value is stored, to notice a different one for the same step: one of the two is forged. The
# true one may come second, when its sender, up to a window behind, makes that step.
HISTORY_STEPS = LOCKSTEP_WINDOW


class _Uses(NamedTuple):
    """The places in a row of the values that a step uses."""

    flags: tuple[bool, ...]  # by place, whether it is one of them
    pick: Callable[[list[Any]], Sequence[Any]]  # the values of a row that are used

    @classmethod
    def of(cls, places: Sequence[int], peers: int) -> Self:
        """These places, ascending, of so many."""
        flags = tuple(place in set(places) for place in range(peers))
        if len(places) > 1:
            return cls(flags, itemgetter(*places))
        return cls(flags, itemgetter(slice(places[0], places[0] + 1) if places else slice(0)))  # a list, too


class Synchronizer(AgentInputs[Value]):
    """The lockstep of one agent; it may be ``window`` steps (>= 0) ahead of a peer. Other options as in AgentInputs."""

    # With ``needed``, step k uses x_j(needed(j, k)) instead of x_j(k): an earlier one, which does not decrease with k,
    # and is at least ``delay`` steps old. Values may come in any order: those that are sent again after a restart come
    # behind newer ones.
    def __init__(
        self,
        *,
        window: int = LOCKSTEP_WINDOW,
        needed: Callable[[int, int], int] | None = None,
        delay: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._window, self._needed_step = window, needed
        self._history = max(HISTORY_STEPS, delay)
        self._places = {j: place for place, j in enumerate(self._newest)}  # of the peers in a row
        # The values of a step are in the row (step modulo the number of rows): None where there is none. The rows are
        # those of the last steps, for which values are kept, and of those to come.
        self._number_of_rows = self._history + window + 2
        self._rows: list[list[Value | None]] = [[None] * len(self._places) for _ in range(self._number_of_rows)]
        self._held: dict[int, tuple[int, Value]] = {}  # by place: step and value, older than the rows and still needed
        self._uses = [_Uses.of([self._places[j] for j in row], len(self._places)) for row in self._inputs]
        self._limit = NOTHING if self._newest else self.steps  # no step up to this one is too far ahead of a peer
        self._known: deque[tuple[int, int]] = deque()  # mode, and the last step with it
        # Number of the next holding period; None: any, since a process that takes over starts in the middle.
        self._sequence: int | None = 0 if self.step == 0 else None
        self._unplanned = self.step  # first step whose graph is not known
        self._needed: _Uses | None  # by the next step, if its graph is known
        self._missing: int  # of them; never 0 while the graph is not known
        self._oldest: list[int]  # by place, the step of the value that the next step uses
        self._prepare()

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take the next holding period (steps ``first_step`` to ``last_step``); None if taken, else a ``Refusal``."""
        if self._sequence is None:
            if last_step < self.step:
                return Refusal.REPEATED
            if first_step > self.step:
                return Refusal.OUT_OF_SEQUENCE
        elif sequence < self._sequence:
            return Refusal.REPEATED
        elif sequence != self._sequence or first_step != self._unplanned or last_step < first_step:
            return Refusal.OUT_OF_SEQUENCE
        self._sequence = sequence + 1
        self._unplanned = last_step + 1
        self._known.append((mode, last_step))
        if len(self._known) == 1:
            self._prepare()
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step); None if taken, else a ``Refusal``."""
        place = self._places.get(agent)
        if place is None:
            return Refusal.NOT_A_PEER
        if step > self.step + self._window + 1:
            return Refusal.TOO_NEW
        known, oldest = self._value(place, step), self._oldest[place]
        if known is not None:
            return Refusal.REPEATED if known == value else Refusal.CONTRADICTION
        if step < oldest:  # of no use, but it shows the progress of a peer that is behind
            if step < self.step - self._window - RESEND_LIMIT:
                return Refusal.TOO_OLD
            if step <= self._newest[agent]:
                return Refusal.REPEATED
        elif step >= self.step - self._history:
            self._row(step)[place] = value
        elif step == oldest:  # those between it and the rows are never used
            self._held[place] = step, value
        self._newest[agent] = max(self._newest[agent], step)
        if step == oldest and self._needed and self._needed.flags[place]:
            self._missing -= 1
        return None

    def known(self, agent: int, step: int) -> Value:
        """x_agent(step), which was taken not long ago."""
        value = self._value(self._places[agent], step)
        assert value is not None
        return value

    def ready(self) -> bool:
        """Whether the next step can be made now."""
        if self._missing:
            return False
        if self.step > self._limit:  # the peers may have moved on
            self._limit = min(self._newest.values()) + self._window
        return self.step <= self._limit

    @property
    def awaits_graph(self) -> bool:
        """Whether it cannot go on because the graph of the next step is not known."""
        return self._needed is None and not self.finished

    def inputs(self) -> tuple[int, list[Value]]:
        """Mode of the step that is ready, and the values of the agents that its row uses, ascending."""
        assert self._needed is not None
        return self._known[0][0], list(self._needed.pick(self._next_values()))

    def advance(self) -> None:
        """Move on to x(step + 1): the step that was ready has been made."""
        leaving, needed = self.step - self._history, self._needed_step
        row = self._row(leaving)
        if needed is not None:
            for j, place in self._places.items():
                value = row[place]
                if value is not None and needed(j, self.step + 1) == leaving:
                    self._held[place] = leaving, value
        row[:] = [None] * len(row)
        if self._known[0][1] <= self.step:
            self._known.popleft()
        self.step += 1
        self._prepare()

    def end_at(self, steps: int) -> None:
        """See AgentInputs."""
        super().end_at(steps)
        self._prepare()

    def _prepare(self) -> None:
        """Find out what the next step needs, and count what is missing."""
        if self._needed_step is None:
            self._oldest = [self.step] * len(self._places)
        else:
            self._oldest = [self._needed_step(j, self.step) for j in self._places]
        if not self._known or self.finished:
            self._needed, self._missing = None, 1
            return
        self._needed = self._uses[self._known[0][0]]
        self._missing = self._needed.pick(self._next_values()).count(None)

    def _row(self, step: int) -> list[Value | None]:
        return self._rows[step % self._number_of_rows]

    def _value(self, place: int, step: int) -> Value | None:
        held = self._held.get(place)
        if held is not None and held[0] == step:
            return held[1]
        return self._row(step)[place] if step >= self.step - self._history else None

    def _next_values(self) -> list[Value | None]:
        """By place, what the next step would use of an agent, if it is there."""
        if self._needed_step is None:
            return self._row(self.step)
        return [self._value(place, step) for place, step in enumerate(self._oldest)]

    def waiting_for(self) -> str:
        """What keeps the agent from its next step, as text (agents from 1)."""
        if self.finished:
            return "nothing, it has finished"
        if not self._known:
            return f"the graph of step {self.step}"
        if missing := self._without_value():
            if len(set(missing.values())) > 1:
                return ", ".join(f"step {step} of agent {j + 1}" for j, step in missing.items())
            return f"step {min(missing.values())} of " + ", ".join(f"agent {j + 1}" for j in missing)
        if behind := self._behind():
            return "too far behind: " + ", ".join(f"agent {j + 1}" for j in behind)
        return "nothing"

    def lacking(self) -> list[int]:
        """Peers of which it lacks a state, as far as it knows what the next step needs."""
        return sorted({*self._without_value(), *self._behind()})

    def _without_value(self) -> dict[int, int]:
        """The agents whose value the next step needs and does not have, and the step of that value."""
        needed, values = self._needed.flags if self._needed else (), self._next_values()
        rows = zip(self._places, self._oldest, needed, values, strict=False)
        return {j: step for j, step, flag, value in rows if flag and value is None}

    def _behind(self) -> list[int]:
        return [j for j, newest in self._newest.items() if newest + self._window < self.step]
