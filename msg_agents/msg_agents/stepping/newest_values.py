# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What an agent uses in real time: the newest values it has. No ROS, no arithmetic, no clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

from msg_agents.stepping.synchronizer import NOTHING, AgentInputs, Value
from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.messages.acceptance import Refusal

CLOCK_MARGIN = 1.0  # s of the clock by which that of another host, or a message from there, may be ahead of ours


class Schedule:
    """Simulated time on a clock: step k, from x(k) to x(k+1), is due at the time (k + phase) dt, 0 <= phase < 1."""

    def __init__(self, *, epoch: int, speed: float, step_length: float, phase: float = 0.0) -> None:
        self.epoch = epoch  # time of the clock [ns] at which simulated time is 0
        self._speed = speed  # units of simulated time per second of the clock
        self._steps = StepClock(step_length, phase)
        self._dt, self._phase = self._steps.step_ns, phase

    def simulated(self, now: int) -> int:
        """Simulated time [ns] when the clock says ``now`` [ns]; negative before the epoch."""
        return math.floor((now - self.epoch) * self._speed)

    def due(self, step: int) -> int:
        """Simulated time [ns] at which a step is due."""
        return self._steps.nanoseconds(step)

    def clock_time(self, step: int) -> int:
        """Time of the clock [ns] at which a step is due, rounded up."""
        return self.epoch + math.ceil(self.due(step) / self._speed)

    def next_step(self, now: int, *, after: int = 0) -> int:
        """The first step, from ``after`` on, that is not yet due when the clock says ``now`` [ns]."""
        simulated = self.simulated(now)
        step = max(after, math.floor(simulated / self._dt - self._phase))
        while step > after and self.due(step - 1) > simulated:  # rounding
            step -= 1
        while self.due(step) <= simulated:
            step += 1
        return step

    def reach(self, now: int) -> int:
        """Newest state that any agent can have when the clock says ``now`` [ns], if clocks agree to the margin."""
        return max(0, math.floor(self.simulated(now + round(CLOCK_MARGIN * SECOND)) / self._dt) + 1)


class NewestValues(AgentInputs[Value]):
    """The newest values of one agent; ``reach``: the newest step that any agent can have by now, newer are refused."""

    # The agent makes each step when it is due: with the newest graph that it knows and the newest value that it has of
    # every neighbour under that graph. Nothing waits, so nothing is buffered.
    def __init__(self, *, reach: Callable[[], int], **options: Any) -> None:
        super().__init__(**options)
        self._reach = reach
        self._reached = NOTHING  # what ``reach`` gave when it was asked last: a clock is not read for every message
        self._values: dict[int, Value] = {}
        self._mode: int | None = None
        self._first_step = NOTHING  # of the newest holding period

    def learn(self, mode: int, first_step: int) -> str | None:
        """Take a holding period of the run's path as the newest; None if taken, else a ``Refusal``."""
        if first_step <= self._first_step:  # one that is missing before it was over before it arrived here
            return Refusal.REPEATED
        if not self._within_reach(first_step):
            return Refusal.TOO_EARLY
        self._mode, self._first_step = mode, first_step
        return None

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """Take x_agent(step) unless a newer one is known; None if taken, else a ``Refusal``."""
        newest = self._newest.get(agent)
        if newest is None:
            return Refusal.NOT_A_PEER
        if step <= newest:
            differs = step == newest and self._values.get(agent, value) != value
            return Refusal.CONTRADICTION if differs else Refusal.REPEATED
        if step > self.steps or not self._within_reach(step):
            return Refusal.TOO_NEW
        self._newest[agent] = step
        self._values[agent] = value
        return None

    def _within_reach(self, step: int) -> bool:
        if step > self._reached:
            self._reached = self._reach()
        return step <= self._reached

    def known(self, agent: int) -> Value:
        """The newest value of an agent."""
        return self._values[agent]

    def review(self) -> None:
        """Drop what is beyond ``reach``: it was taken before the epoch was known."""
        reach = self._reached = self._reach()
        for j, step in self._newest.items():
            if step > reach:
                self._newest[j] = NOTHING
                self._values.pop(j)
        if self._first_step > reach:
            self._mode, self._first_step = None, NOTHING

    def ready(self) -> bool:
        """Whether the next step can be made when it is due."""
        return self._mode is not None and self.step < self.steps

    def inputs(self) -> tuple[int, list[tuple[int, Value | None]]]:
        """Mode of the due step; step and value to use of each agent in its row, NOTHING and None: the own value."""
        assert self._mode is not None, "not ready"
        return self._mode, [self._used(j) for j in self._inputs[self._mode]]

    def _used(self, agent: int) -> tuple[int, Value | None]:
        return self._newest[agent], self._values.get(agent)

    def advance(self) -> None:
        """Count the due step as made."""
        self.step += 1

    def waiting_for(self) -> str:
        """What keeps the agent from making steps when they are due, as text."""
        if self.finished:
            return "nothing, it has finished"
        return "the first graph" if self._mode is None else "nothing"

    @property
    def behind(self) -> dict[int, int]:
        """For each peer, how many steps its newest value is older than the agent's own state."""
        return {j: self.step - newest for j, newest in self._newest.items()}


class NewestReceived(NewestValues[Value]):
    """The same with messages that are lost, or ``delay`` steps old."""

    # Of an agent with a newest state x(n), a step uses the newest of those up to x(n - delay), and the own value where
    # that one is ``lost`` (of agent and step) or nothing came; with ``holds``, the newest of these that is not lost.
    def __init__(self, *, delay: int, lost: Callable[[int, int], bool], holds: bool, **options: Any) -> None:
        super().__init__(**options)
        self._delay, self._lost, self._holds = delay, lost, holds
        self._states: dict[int, deque[tuple[int, Value]]] = {j: deque() for j in self._newest}

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """See NewestValues."""
        refusal = super().offer(agent, step, value)
        if refusal is None and not (self._holds and self._lost(agent, step)):
            self._states[agent].append((step, value))
            self._forget(agent)
        return refusal

    def review(self) -> None:
        """See NewestValues."""
        super().review()
        for j, states in self._states.items():
            if self._newest[j] == NOTHING:
                states.clear()

    def _forget(self, agent: int) -> int:
        """Drop what is older than the state to use; the newest step that may be used."""
        states, usable = self._states[agent], max(0, self._newest[agent] - self._delay)
        while len(states) > 1 and states[1][0] <= usable:
            states.popleft()
        return usable

    def _used(self, agent: int) -> tuple[int, Value | None]:
        usable, states = self._forget(agent), self._states[agent]
        if not states or states[0][0] > usable or (not self._holds and self._lost(agent, states[0][0])):
            return NOTHING, None
        return states[0]
