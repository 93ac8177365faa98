"""When may an agent make its next step? The distributed lockstep, without ROS and without arithmetic.

Agent i makes step k (from x(k) to x(k+1)) when it knows the graph g(k), has x_j(k) from every j that row i of W_g(k)
uses, and nobody whom it can ever exchange states with is more than ``window`` steps behind it. There is no barrier
and no master. The last rule bounds every buffer even while the graph is disconnected, and it cannot deadlock: whoever
is furthest behind is ahead of nobody, and all that it waits for has been published.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Value = TypeVar("Value")

WINDOW = 64
"""Steps that an agent may be ahead of a peer. Small enough for a burst to fit a socket's receive buffer."""

AGAIN = 6000
"""Steps that agents keep, and send again when one of them was killed. What is older nobody sends."""

KEPT = WINDOW
"""Steps for which a value is kept after its use. Whoever is given another one for the same step notices: one of the two
is forged, and as the true one may be the second, it comes when its sender, up to a window behind, makes that step."""


class Refusal:
    """Why something offered was not taken."""

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
    """Steps up to the last one use this mode."""

    mode: int
    last: int


class Synchronizer(Generic[Value]):
    """The lockstep of one agent. Steps count from 0; x(0) is the start, the run ends at x(steps).

    Parameters
    ----------
    agent
        index of the agent
    steps
        N, steps of the run
    inputs
        for each mode, the other agents whose states the agent's row uses, ascending
    peers
        every other agent that the agent ever hears or is heard by (of which ``inputs`` are some)
    window
        steps that the agent may be ahead of a peer, >= 0
    start
        step that the agent is at already, where it takes over from a process that has gone

    Raises
    ------
    ValueError
        numbers that do not go together: a mistake of the caller
    """

    def __init__(
        self,
        *,
        agent: int,
        steps: int,
        inputs: Sequence[Sequence[int]],
        peers: Collection[int],
        window: int = WINDOW,
        start: int = 0,
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
        # Of the next sojourn. Who takes over comes into the middle, and takes the sojourn of its step for the first.
        self._sequence: int | None = 0 if start == 0 else None
        self._unplanned = start  # first step whose graph is not known
        self._mode = 0  # of the next step, if its graph is known
        self._needed: tuple[int, ...] = ()  # by the next step
        self._missing = 1  # of them; never 0 while the graph is not known
        missing = {j for row in inputs for j in row} - self._buffers.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, who are not among its peers {sorted(peers)}")

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take note of a sojourn of the graph.

        Parameters
        ----------
        sequence
            of the sojourn, from 0
        mode
            graph, from 0
        first_step
            that uses it
        last_step
            that uses it

        Returns
        -------
        str | None
            None if taken, else the reason (a ``Refusal``). Sojourns must come in sequence, each where the last one
            ended.
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
        """Take x_agent(step).

        Parameters
        ----------
        agent
            index from 0
        step
            k
        value
            x_agent(k), as the law takes it

        Returns
        -------
        str | None
            None if taken, else the reason (a ``Refusal``).
        """
        buffer = self._buffers.get(agent)
        if buffer is None:
            return Refusal.STRANGER
        if step < self.step or step in buffer:
            # A peer that is behind is heard of here too: its value is of no use, its progress is.
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
        """What the step that is ready needs.

        Returns
        -------
        tuple[int, list[Value]]
            mode and the states x_j(step), j ascending, of the agents that the row of this mode uses, and of nobody else
        """
        step, buffers = self.step, self._buffers
        return self._mode, [buffers[j][step] for j in self._needed]

    def advance(self) -> None:
        """The step that was ready has been made: move on to x(step + 1)."""
        step = self.step
        for buffer in self._buffers.values():
            buffer.pop(step - KEPT, None)
        self.step = step + 1
        if self._known[0].last <= step:
            self._known.popleft()
        self._plan()

    def _plan(self) -> None:
        """Find out whom the next step needs, and count who of them has not been heard."""
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
        """What keeps the agent from its next step, for people (agents from 1)."""
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
