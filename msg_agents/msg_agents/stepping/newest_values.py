"""Newest value wins: what an agent goes by in real time, without ROS, without arithmetic, without a clock.

The agent makes a step when its time has come, whatever has come until then: with the newest graph that it knows, and of
every neighbour under that graph the newest value that it has. Nothing waits, so nothing is buffered.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Generic, TypeVar

from msg_agents.stepping.synchronizer import Refusal

Value = TypeVar("Value")

NOTHING = -1
"""In place of a step: nothing has been heard yet."""


class Newest(Generic[Value]):
    """What one agent knows of the others. Steps count from 0; x(0) is the start, the run ends at x(steps).

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
    reach
        gives the newest step that anybody can have reached by now; what claims to be newer is refused
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
        reach: Callable[[], int],
        start: int = 0,
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
        # Of the next sojourn; None: any. Who takes over comes into the middle.
        self._sequence: int | None = 0 if start == 0 else None
        self._unplanned = 0  # first step that no sojourn covers
        missing = {j for row in inputs for j in row} - self._steps_of.keys()
        if missing:
            raise ValueError(f"agent {agent} uses {sorted(missing)}, who are not among its peers {sorted(peers)}")

    def learn(self, sequence: int, mode: int, first_step: int, last_step: int) -> str | None:
        """Take note of a sojourn of the graph: from now on it is the newest.

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
            ended, and not before their time.
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
            self._sequence = None  # should it have been a genuine one after all, the next does not follow what we have
            return Refusal.EARLY
        self._sequence = sequence + 1
        self._unplanned = last_step + 1
        self._mode, self._first_step = mode, first_step
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step), if there is nothing newer.

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
        """Drop what is out of reach: of what came before anybody could say."""
        reach = self._reach()
        for j, step in self._steps_of.items():
            if step > reach:
                self._steps_of[j] = NOTHING
                self._values.pop(j)
        if self._first_step > reach:
            self._mode, self._sequence, self._unplanned, self._first_step = None, None, 0, NOTHING

    def ready(self) -> bool:
        """Whether the next step can be made when its time has come."""
        return self._mode is not None and self.step < self.steps

    def inputs(self) -> tuple[int, list[tuple[int, Value | None]]]:
        """What the step that is due is made with.

        Returns
        -------
        tuple[int, list[tuple[int, Value | None]]]
            mode, and of the agents that the row of this mode uses, ascending, and of nobody else: step and value of the
            newest state that has been heard, (``NOTHING``, None) where there is none
        """
        assert self._mode is not None, "not ready"
        return self._mode, [(self._steps_of[j], self._values.get(j)) for j in self._inputs[self._mode]]

    def advance(self) -> None:
        """The step that was due has been made."""
        self.step += 1

    @property
    def finished(self) -> bool:
        """Whether x(steps) has been reached."""
        return self.step >= self.steps

    def waiting_for(self) -> str:
        """What keeps the agent from making steps when they are due, for people."""
        if self.finished:
            return "nothing, it has finished"
        return "the first graph" if self._mode is None else "nothing"

    @property
    def behind(self) -> dict[int, int]:
        """For each peer, how many steps older than the agent's own state the newest value of it is."""
        return {j: self.step - newest for j, newest in self._steps_of.items()}
