"""What an agent uses in real time: the newest values it has. No ROS, no arithmetic, no clock.

The agent makes each step when it is due: with the newest graph that it knows and the newest value that it has of every
neighbour under that graph. Nothing waits, so nothing is buffered.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Generic, TypeVar

from msg_agents.stepping.synchronizer import Refusal

Value = TypeVar("Value")

NOTHING = -1  # in place of a step: no state received yet


class Newest(Generic[Value]):
    """What one agent knows of the others. Steps count from 0; x(0) is the start, the run ends at x(steps)."""

    def __init__(
        self,
        *,
        agent: int,
        steps: int,  # N
        inputs: Sequence[Sequence[int]],  # per mode, the other agents that the agent's row uses, ascending
        peers: Collection[int],  # every other agent that it ever hears or is heard by; includes ``inputs``
        reach: Callable[[], int],  # newest step that any agent can have reached by now; newer ones are refused
        start: int = 0,  # the current step, after a takeover
    ) -> None:
        self.agent = agent
        self.step = start
        self.steps = steps
        self._inputs = [tuple(row) for row in inputs]
        self._reach = reach
        self._steps_of = dict.fromkeys(sorted(peers), NOTHING)
        self._values: dict[int, Value] = {}
        self._mode: int | None = None
        self._first_step = NOTHING  # of the newest sojourn
        # Of the next sojourn; None: any, since a process that takes over starts in the middle.
        self._sequence: int | None = 0 if start == 0 else None
        self._unplanned = 0  # first step that no sojourn covers
        missing = {j for row in inputs for j in row} - self._steps_of.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, who are not among its peers {sorted(peers)}")

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take a sojourn (steps ``first_step`` to ``last_step``) as the newest; None if taken, else a ``Refusal``.

        Sojourns must come in sequence, each where the last one ended, and not before their time.
        """
        if not 0 <= first_step <= last_step < self.steps:
            return Refusal.SEQUENCE
        if self._sequence is not None:
            if sequence < self._sequence:
                return Refusal.KNOWN
            if sequence != self._sequence or first_step != self._unplanned:
                return Refusal.SEQUENCE
        elif first_step < self._unplanned:
            return Refusal.KNOWN
        if first_step > self._reach():
            self._sequence = None  # if it is genuine after all, the next one does not follow what we have
            return Refusal.EARLY
        self._sequence = sequence + 1
        self._unplanned = last_step + 1
        self._mode, self._first_step = mode, first_step
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step) unless a newer one is known; None if taken, else a ``Refusal``."""
        newest = self._steps_of.get(agent)
        if newest is None:
            return Refusal.STRANGER
        if step <= newest:
            return Refusal.OLD
        if step > self.steps or step > self._reach():
            return Refusal.FAR
        self._steps_of[agent] = step
        self._values[agent] = value
        return None

    def review(self) -> None:
        """Drop what is beyond ``reach``: it was taken before the epoch was known."""
        reach = self._reach()
        for j, step in self._steps_of.items():
            if step > reach:
                self._steps_of[j] = NOTHING
                self._values.pop(j)
        if self._first_step > reach:
            self._mode, self._sequence, self._unplanned, self._first_step = None, None, 0, NOTHING

    def ready(self) -> bool:
        """Whether the next step can be made when it is due."""
        return self._mode is not None and self.step < self.steps

    def inputs(self) -> tuple[int, list[tuple[int, Value | None]]]:
        """Mode of the due step; step and value of the newest state of each agent that its row uses, ascending.

        ``(NOTHING, None)`` for an agent of which no state has been received.
        """
        assert self._mode is not None, "not ready"
        return self._mode, [(self._steps_of[j], self._values.get(j)) for j in self._inputs[self._mode]]

    def advance(self) -> None:
        """Count the due step as made."""
        self.step += 1

    @property
    def finished(self) -> bool:
        """Whether x(steps) has been reached."""
        return self.step >= self.steps

    def waiting_for(self) -> str:
        """What keeps the agent from making steps when they are due, as text."""
        if self.finished:
            return "nothing, it has finished"
        return "the first graph" if self._mode is None else "nothing"

    @property
    def behind(self) -> dict[int, int]:
        """For each peer, how many steps its newest value is older than the agent's own state."""
        return {j: self.step - newest for j, newest in self._steps_of.items()}
