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
from array import array
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from msg_analysis.common.arrays import IntArray
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
        peers: Collection[int],  # every other agent that it ever hears or is heard by; includes ``inputs``
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


TURN_SLICE = 0.02
"""s of steps without a break, after which the executor gets its turn: messages, timers, signals."""


class Member(Protocol):
    """What takes turns."""

    def advance(self) -> None:
        """Make every step that can be made now."""


class TurnQueue:
    """Gives turns in the order in which they were asked for, once all ``members`` (a number) have joined.

    A step of one agent lets others step, and theirs others again: the queue replaces nested calls, which would go as
    deep as the run is long.
    """

    def __init__(
        self,
        members: int,
        defer: Callable[[Callable[[], None]], object],  # runs a callback after what is already waiting in the executor
        after: Callable[[], None] = lambda: None,  # is called when turns have been given
    ) -> None:
        self._absent = members
        self._defer = defer
        self._after = after
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
        queue, until = self._queue, time.monotonic() + TURN_SLICE
        while queue:
            queue.popleft().advance()
            if time.monotonic() > until and queue:
                self._after()
                self._defer(self._give)
                return
        self._after()
        self._given = False


LOCKSTEP_WINDOW = 64
"""Steps that an agent may be ahead of a peer; small enough for a burst to fit a socket's receive buffer."""

RESEND_LIMIT = 6000
"""Most steps that an agent keeps, and sends again when another one was killed; older ones are never sent again."""

HISTORY_STEPS = LOCKSTEP_WINDOW
"""Steps for which a value is kept after its use, to notice a different one for the same step: one of the two is forged.
The true one may come second, when its sender, up to a window behind, makes that step."""


@dataclass(frozen=True, slots=True)
class _Known:
    """Mode of the steps up to ``last``."""

    mode: int
    last: int


@dataclass(frozen=True, slots=True)
class _Uses:
    """The places in a row of the values that a step uses."""

    flags: tuple[bool, ...]  # by place, whether it is one of them
    pick: Callable[[list[Any]], Sequence[Any]] = field(compare=False)  # the values of a row that are used

    @classmethod
    def of(cls, places: Sequence[int], peers: int) -> Self:
        """These places, ascending, of so many."""
        flags = tuple(place in set(places) for place in range(peers))
        if len(places) > 1:
            return cls(flags, itemgetter(*places))
        first = places[0] if places else 0
        return cls(flags, itemgetter(slice(first, first + len(places))))  # a list, too, of none or one


class Synchronizer(AgentInputs[Value]):
    """The lockstep of one agent; it may be ``window`` steps (>= 0) ahead of a peer. Other options as in AgentInputs.

    ``kept``: steps for which values are kept after they became the newest.
    """

    def __init__(self, *, window: int = LOCKSTEP_WINDOW, kept: int = HISTORY_STEPS, **options: Any) -> None:
        super().__init__(**options)
        self._window, self._kept = window, kept
        self._places = {j: place for place, j in enumerate(self._newest)}  # of the peers in a row
        # The values of a step are in the row (step modulo the number of rows): None where there is none. The rows are
        # those of the last steps, for which values are kept, and of those to come.
        self._number_of_rows = kept + window + 2
        self._rows: list[list[Value | None]] = [[None] * len(self._places) for _ in range(self._number_of_rows)]
        self._uses = [_Uses.of([self._places[j] for j in row], len(self._places)) for row in self._inputs]
        self._limit = window - 1 if self._newest else self.steps
        self._known: deque[_Known] = deque()
        # Number of the next sojourn; None: any, since a process that takes over starts in the middle.
        self._sequence: int | None = 0 if self.step == 0 else None
        self._unplanned = self.step  # first step whose graph is not known
        self._mode = 0  # of the next step, if its graph is known
        self._needed: _Uses | None = None  # by the next step
        self._missing = 1  # of them; never 0 while the graph is not known

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take a sojourn (steps ``first_step`` to ``last_step``); None if taken, else a ``Refusal``.

        Sojourns must come in sequence, each where the last one ended.
        """
        if self._sequence is None:
            if last_step < self.step:
                return Refusal.REPEATED
            if not first_step <= self.step:
                return Refusal.OUT_OF_SEQUENCE
        elif sequence < self._sequence:
            return Refusal.REPEATED
        elif sequence != self._sequence or first_step != self._unplanned or last_step < first_step:
            return Refusal.OUT_OF_SEQUENCE
        self._sequence = sequence + 1
        self._unplanned = last_step + 1
        self._known.append(_Known(mode, last_step))
        if len(self._known) == 1:
            self._plan()
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step); None if taken, else a ``Refusal``."""
        place = self._places.get(agent)
        if place is None:
            return Refusal.NOT_A_PEER
        ahead = step - self.step
        if ahead > self._window + 1:
            return Refusal.TOO_NEW
        row = self._rows[step % self._number_of_rows]
        known = row[place] if ahead >= -self._kept else None
        if ahead < 0 or known is not None:
            # Also of a peer that is behind: its value is of no use, but it shows the progress of the peer.
            if known is not None and known != value:
                return Refusal.CONTRADICTION
            if ahead < -self._window - RESEND_LIMIT:
                return Refusal.TOO_OLD
            if step <= self._newest[agent]:
                return Refusal.REPEATED
            self._newest[agent] = step
            return None
        row[place] = value
        if step > self._newest[agent]:
            self._newest[agent] = step
        if not ahead and self._needed and self._needed.flags[place]:
            self._missing -= 1
        return None

    def known(self, agent: int, step: int) -> Value:
        """x_agent(step), which was taken not long ago."""
        value = self._row(step)[self._places[agent]]
        assert value is not None
        return value

    def ready(self) -> bool:
        """Whether the next step can be made now."""
        return not self._missing and (self.step <= self._limit or self._within_window())

    @property
    def awaits_graph(self) -> bool:
        """Whether it cannot go on because the graph of the next step is not known."""
        return self._needed is None and not self.finished

    def inputs(self) -> tuple[int, list[Value]]:
        """Mode of the step that is ready, and the states x_j(step) of the agents that its row uses, j ascending."""
        assert self._needed is not None
        return self._mode, list(self._needed.pick(self._rows[self.step % self._number_of_rows]))

    def advance(self) -> None:
        """Move on to x(step + 1): the step that was ready has been made."""
        step = self.step
        self._rows[(step - self._kept) % self._number_of_rows] = [None] * len(self._places)
        self.step = step + 1
        if self._known[0].last <= step:
            self._known.popleft()
        self._plan()

    def _plan(self) -> None:
        """Find out which agents the next step needs, and count those whose state is missing."""
        if not self._known or self.step >= self.steps:
            self._needed, self._missing = None, 1
            return
        self._mode = self._known[0].mode
        self._needed = self._uses[self._mode]
        self._missing = self._needed.pick(self._rows[self.step % self._number_of_rows]).count(None)

    def _row(self, step: int) -> list[Value | None]:
        return self._rows[step % self._number_of_rows]

    def _next(self, place: int) -> tuple[int, Value | None]:
        """Step and value, if it is there, of what the next step would use of the agent in a place."""
        return self.step, self._row(self.step)[place]

    def _within_window(self) -> bool:
        self._limit = min(self._newest.values()) + self._window
        return self.step <= self._limit

    def end_at(self, steps: int) -> None:
        """See AgentInputs."""
        super().end_at(steps)
        self._plan()

    def waiting_for(self) -> str:
        """What keeps the agent from its next step, as text (agents from 1)."""
        if self.finished:
            return "nothing, it has finished"
        if not self._known:
            return f"the graph of step {self.step}"
        inputs = self._inputs[self._known[0].mode]
        missing = [(j, step) for j in inputs for step, value in [self._next(self._places[j])] if value is None]
        if missing:
            steps = {step for _, step in missing}
            if len(steps) > 1:
                return ", ".join(f"step {step} of agent {j + 1}" for j, step in missing)
            return f"step {min(steps)} of " + ", ".join(f"agent {j + 1}" for j, _ in missing)
        if behind := self._behind():
            return "too far behind: " + ", ".join(f"agent {j + 1}" for j in behind)
        return "nothing"

    def lacking(self) -> list[int]:
        """Peers of which it lacks a state, as far as it knows what the next step needs."""
        needed = self._needed.flags if self._needed else ()
        places = [place for place, flag in enumerate(needed) if flag and self._next(place)[1] is None]
        missing = [j for j, place in self._places.items() if place in places]
        return sorted({*missing, *self._behind()})

    def _behind(self) -> list[int]:
        return [j for j, newest in self._newest.items() if newest + self._window < self.step]

    @property
    def buffered(self) -> int:
        """Most values held of any one peer for steps to come; never more than window + 2."""
        to_come = [self._row(self.step + ahead) for ahead in range(self._window + 2)]
        return max((sum(value is not None for value in values) for values in zip(*to_come, strict=True)), default=0)


_MASK = 0x3FFFFFFF  # of the bits of a content that are in its mark
CONSECUTIVE = 64
"""Steps in a row after which those before them are taken for lost: the reader came late, for example."""


def hashes_of(contents: IntArray) -> array[int]:
    """Marks of so many contents: numbers of 30 bits, not 0."""
    return array("i", ((contents & _MASK) + 1).astype(np.int32).tobytes())


class ReceivedSteps:
    """The steps 0 to ``last`` of one agent, in any order: after a restart some come again.

    A mark of 4 bytes per step tells whether a repeated one is the same, up to RESEND_LIMIT steps before and after
    ``row``, the newest step up to which none is to come any more.
    """

    def __init__(self, last: int) -> None:
        self.row = -1
        self._last = last
        self._chain = (0, 0)  # the step that would continue the newest ones beyond ``row``, and how many these are
        # 0: not received. Negative: two different ones were.
        self._marks = array("i", bytes(4 * min(2 * RESEND_LIMIT, last + 1)))

    def take(self, step: int, content: int) -> str | None:
        """Take a step with a hash of its content; None if it is new, else a ``Refusal``.

        Of two different ones of one step, the second is a contradiction; further ones count as repeated.
        """
        if step > self._last:
            return Refusal.OUT_OF_RANGE
        if step <= self.row - RESEND_LIMIT:
            return Refusal.TOO_OLD
        if step > self.row + 1:
            following, count = self._chain
            self._chain = (step + 1, count + 1 if step == following else 1)
            if self._chain[1] >= CONSECUTIVE:
                self._move(step - 1)
        if step > self.row + RESEND_LIMIT:
            return Refusal.TOO_NEW
        slot, mark = step % len(self._marks), (content & _MASK) + 1
        known = self._marks[slot]
        if not known:
            self._marks[slot] = mark
            while self.row < self._last and self._marks[(self.row + 1) % len(self._marks)]:
                self._move(self.row + 1)
            return None
        if known == mark or known < 0:
            return Refusal.REPEATED
        self._marks[slot] = -known
        return Refusal.CONTRADICTION

    def take_row(self, first: int, marks: array[int]) -> bool:
        """Take the steps from ``first`` on at once, if they follow ``row`` and all are new; else False, and none."""
        size, last = len(self._marks), first + len(marks) - 1
        slot = first % size
        end = slot + len(marks)
        if first != self.row + 1 or last > self._last or end > size or any(self._marks[slot:end]):
            return False
        self._marks[slot:end] = marks
        self._move(last)
        while self.row < self._last and self._marks[(self.row + 1) % size]:
            self._move(self.row + 1)
        return True

    def _move(self, row: int) -> None:
        """Set ``row``; the steps that are then within reach take the places of old ones."""
        size = len(self._marks)
        step = max(self.row, row - size) + RESEND_LIMIT + 1
        end = min(row + RESEND_LIMIT, self._last) + 1
        if end - step == 1:  # in order, one after the other
            self._marks[step % size] = 0
            step = end
        while step < end:
            slot = step % size
            count = min(end - step, size - slot)
            self._marks[slot : slot + count] = array("i", bytes(4 * count))
            step += count
        self.row = row
