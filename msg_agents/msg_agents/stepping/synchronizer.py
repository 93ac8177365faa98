"""When an agent may make its next step: the distributed lockstep. No ROS, no arithmetic.

Agent i makes step k (from x(k) to x(k+1)) when it knows the graph g(k), has x_j(k) from every j that row i of W_g(k)
uses, and no agent that it can ever exchange states with is more than ``window`` steps behind it. There is no barrier
and no master. The last rule bounds every buffer even while the graph is disconnected, and it cannot cause a deadlock:
the agent that is furthest behind is ahead of none, and all that it waits for has been published.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Value = TypeVar("Value")

WINDOW = 64
"""Steps that an agent may be ahead of a peer; small enough for a burst to fit a socket's receive buffer."""

AGAIN = 6000
"""Most steps that an agent keeps, and sends again when another one was killed; older ones are never sent again."""

KEPT = WINDOW
"""Steps for which a value is kept after its use, to notice a different one for the same step: one of the two is forged.
The true one may come second, when its sender, up to a window behind, makes that step."""


class Refusal:
    """Why a state or a sojourn was not taken."""

    STRANGER = "not a peer"
    OLD = "a step already done or already here"
    PAST = "a step long past"
    FAR = "a step that a peer cannot have reached"
    SEQUENCE = "a sojourn out of sequence"
    KNOWN = "a sojourn known already"
    EARLY = "a sojourn before its time"
    CONTRADICTION = "contradicts an earlier copy"


@dataclass(frozen=True, slots=True)
class _Known:
    """Mode of the steps up to ``last``."""

    mode: int
    last: int


class Synchronizer(Generic[Value]):
    """The lockstep of one agent. Steps count from 0; x(0) is the start, the run ends at x(steps)."""

    def __init__(
        self,
        *,
        agent: int,
        steps: int,  # N
        inputs: Sequence[Sequence[int]],  # per mode, the other agents that the agent's row uses, ascending
        peers: Collection[int],  # every other agent that it ever hears or is heard by; includes ``inputs``
        window: int = WINDOW,  # steps that it may be ahead of a peer, >= 0
        start: int = 0,  # the current step, after a takeover
    ) -> None:
        self.agent = agent
        self.step = start
        self.steps = steps
        self._inputs = [tuple(row) for row in inputs]
        self._window = window
        self._buffers: dict[int, dict[int, Value]] = {j: {} for j in sorted(peers)}
        self._newest = dict.fromkeys(self._buffers, -1)
        self._limit = window - 1 if peers else steps
        self._known: deque[_Known] = deque()
        # Of the next sojourn; None: after a takeover, when the sojourn that contains the step counts as the first.
        self._sequence: int | None = 0 if start == 0 else None
        self._unplanned = start  # first step whose graph is not known
        self._mode = 0  # of the next step, if its graph is known
        self._needed: tuple[int, ...] = ()  # by the next step
        self._missing = 1  # of them; never 0 while the graph is not known
        missing = {j for row in inputs for j in row} - self._buffers.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, who are not among its peers {sorted(peers)}")

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take a sojourn (steps ``first_step`` to ``last_step``); None if taken, else a ``Refusal``.

        Sojourns must come in sequence, each where the last one ended.
        """
        if self._sequence is None:
            if last_step < self.step:
                return Refusal.KNOWN
            if not first_step <= self.step:
                return Refusal.SEQUENCE
        elif sequence < self._sequence:
            return Refusal.KNOWN
        elif sequence != self._sequence or first_step != self._unplanned or last_step < first_step:
            return Refusal.SEQUENCE
        self._sequence = sequence + 1
        self._unplanned = last_step + 1
        self._known.append(_Known(mode, last_step))
        if len(self._known) == 1:
            self._plan()
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step); None if taken, else a ``Refusal``."""
        buffer = self._buffers.get(agent)
        if buffer is None:
            return Refusal.STRANGER
        if step < self.step or step in buffer:
            # Also of a peer that is behind: its value is of no use, but it shows the progress of the peer.
            if step in buffer and buffer[step] != value:
                return Refusal.CONTRADICTION
            if step < self.step - self._window - AGAIN:
                return Refusal.PAST
            if step <= self._newest[agent]:
                return Refusal.OLD
            self._newest[agent] = step
            return None
        if step > self.step + self._window + 1:
            return Refusal.FAR
        buffer[step] = value
        if step > self._newest[agent]:
            self._newest[agent] = step
        if step == self.step and agent in self._needed:
            self._missing -= 1
        return None

    def ready(self) -> bool:
        """Whether the next step can be made now."""
        return not self._missing and (self.step <= self._limit or self._within_window())

    def inputs(self) -> tuple[int, list[Value]]:
        """Mode of the step that is ready, and the states x_j(step) of the agents that its row uses, j ascending."""
        step, buffers = self.step, self._buffers
        return self._mode, [buffers[j][step] for j in self._needed]

    def advance(self) -> None:
        """Move on to x(step + 1): the step that was ready has been made."""
        step = self.step
        for buffer in self._buffers.values():
            buffer.pop(step - KEPT, None)
        self.step = step + 1
        if self._known[0].last <= step:
            self._known.popleft()
        self._plan()

    def _plan(self) -> None:
        """Find out which agents the next step needs, and count those whose state is missing."""
        if not self._known or self.step >= self.steps:
            self._needed, self._missing = (), 1
            return
        self._mode = self._known[0].mode
        self._needed = self._inputs[self._mode]
        self._missing = 0
        for j in self._needed:
            if self.step not in self._buffers[j]:
                self._missing += 1

    def _within_window(self) -> bool:
        self._limit = min(self._newest.values()) + self._window
        return self.step <= self._limit

    @property
    def finished(self) -> bool:
        """Whether x(steps) has been reached."""
        return self.step >= self.steps

    def waiting_for(self) -> str:
        """What keeps the agent from its next step, as text (agents from 1)."""
        if self.finished:
            return "nothing, it has finished"
        if not self._known:
            return f"the graph of step {self.step}"
        inputs = self._inputs[self._known[0].mode]
        missing = [j for j in inputs if self.step not in self._buffers[j]]
        if missing:
            return f"step {self.step} of " + ", ".join(f"agent {j + 1}" for j in missing)
        behind = [j for j, newest in self._newest.items() if newest + self._window < self.step]
        if behind:
            return "agents too far behind: " + ", ".join(f"{j + 1}" for j in behind)
        return "nothing"

    @property
    def buffered(self) -> int:
        """Most values held of any one peer for steps to come; never more than window + 2."""
        return max((sum(k >= self.step for k in buffer) for buffer in self._buffers.values()), default=0)
