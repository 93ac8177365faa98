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
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Generic, Protocol, Self, TypeVar

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


TURN_SLICE = 0.02
"""s of steps without a break, after which the executor gets its turn: messages, timers, signals."""


class Member(Protocol):
    """What takes turns."""

    def advance(self) -> None:
        """Make every step that can be made now."""


class TurnQueue:
    """Gives turns in the order of the requests, once all ``members`` (a number) have joined.

    A step of one agent lets others step, and theirs others again: the queue replaces nested calls, which would go as
    deep as the run is long.
    """

    def __init__(
        self,
        members: int,
        defer: Callable[[Callable[[], None]], object],  # runs a callback after what is already waiting in the executor
        after: Callable[[], None] = lambda: None,  # is called when turns have been given
        turn: float = TURN_SLICE,  # s
    ) -> None:
        self._absent = members
        self._defer = defer
        self._after = after
        self._turn = turn
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


LOCKSTEP_WINDOW = 64
"""Steps that an agent may be ahead of a peer; small enough for a burst to fit a socket's receive buffer."""

RESEND_LIMIT = 6000
"""Most steps that an agent keeps, and sends again when another one was killed; older ones are never sent again."""

HISTORY_STEPS = LOCKSTEP_WINDOW
"""Steps for which a used value is stored, to notice a different one for the same step: one of the two is forged.
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

    ``history``: steps for which values are kept after they became the newest.
    """

    def __init__(self, *, window: int = LOCKSTEP_WINDOW, history: int = HISTORY_STEPS, **options: Any) -> None:
        super().__init__(**options)
        self._window, self._history = window, history
        self._places = {j: place for place, j in enumerate(self._newest)}  # of the peers in a row
        # The values of a step are in the row (step modulo the number of rows): None where there is none. The rows are
        # those of the last steps, for which values are kept, and of those to come.
        self._number_of_rows = history + window + 2
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
            self._prepare()
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
        known = row[place] if ahead >= -self._history else None
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
        self._rows[(step - self._history) % self._number_of_rows] = [None] * len(self._places)
        self.step = step + 1
        if self._known[0].last <= step:
            self._known.popleft()
        self._prepare()

    def _prepare(self) -> None:
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
        self._prepare()

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


class DelayedSynchronizer(Synchronizer[Value]):
    """As Synchronizer, but step k uses x_j(``needed``(j, k)): an earlier step, which does not decrease with k.

    Values may come in any order: those that are sent again after a restart come behind newer ones. A value that is
    older than what is kept anyway, and is still needed, is held.
    """

    def __init__(self, *, needed: Callable[[int, int], int], delay: int, **options: Any) -> None:
        self._needed_step = needed
        self._held: dict[int, tuple[int, Value]] = {}  # by place
        self._oldest: list[int] = []  # by place, the step of the value that the next step would use
        super().__init__(history=max(HISTORY_STEPS, delay + 1), **options)
        self._find_oldest()

    def _find_oldest(self) -> None:
        self._oldest = [self._needed_step(j, self.step) for j in self._places]

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """See Synchronizer."""
        place = self._places.get(agent)
        if place is None:
            return Refusal.NOT_A_PEER
        ahead = step - self.step
        if ahead > self._window + 1:
            return Refusal.TOO_NEW
        known = self._value(place, step)
        if known is not None:
            return Refusal.REPEATED if known == value else Refusal.CONTRADICTION
        if step < self._oldest[place]:  # of no use, but it shows the progress of the peer
            if ahead < -self._window - RESEND_LIMIT:
                return Refusal.TOO_OLD
            if step <= self._newest[agent]:
                return Refusal.REPEATED
        elif ahead >= -self._history:
            self._row(step)[place] = value
        elif step == self._oldest[place]:  # those between it and the kept ones are never used
            self._held[place] = step, value
        self._newest[agent] = max(self._newest[agent], step)
        if self._needed and self._needed.flags[place] and step == self._oldest[place]:
            self._missing -= 1
        return None

    def known(self, agent: int, step: int) -> Value:
        """See Synchronizer."""
        value = self._value(self._places[agent], step)
        assert value is not None
        return value

    def inputs(self) -> tuple[int, list[Value]]:
        """See Synchronizer: the states x_j(needed(j, step))."""
        assert self._needed is not None
        found = [self._value(place, step) for place, step in enumerate(self._oldest)]
        return self._mode, list(self._needed.pick(found))

    def advance(self) -> None:
        """See Synchronizer."""
        leaving, row = self.step - self._history, self._row(self.step - self._history)
        for j, place in self._places.items():
            value = row[place]
            if value is not None and self._needed_step(j, self.step + 1) == leaving:
                self._held[place] = leaving, value
        super().advance()

    def _prepare(self) -> None:
        """See Synchronizer."""
        self._find_oldest()
        super()._prepare()
        if self._needed is not None:
            found = [self._value(place, step) for place, step in enumerate(self._oldest)]
            self._missing = self._needed.pick(found).count(None)

    def _value(self, place: int, step: int) -> Value | None:
        held = self._held.get(place)
        if held is not None and held[0] == step:
            return held[1]
        return self._row(step)[place] if step >= self.step - self._history else None

    def _next(self, place: int) -> tuple[int, Value | None]:
        """See Synchronizer."""
        return self._oldest[place], self._value(place, self._oldest[place])
