# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Stalls, lags and clocks: when to warn that no steps are made, or fewer than in real time, or that clocks differ."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from msg_analysis.common.text import agent_name

STALL_TIME = 5.0  # s without a step, after which an agent counts as stalled
SILENT = 1.0  # s without a step after which an agent counts as silent in real time; agents report every 0.2 s
CLOCK_STEP = 0.5  # s by which the clock must have been set to be noted


class StallDetector:
    """Measures the rate of a step counter between two calls of ``update``."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._step, self._time = 0, clock()
        self._next_warning = STALL_TIME
        self.rate = self.stalled = 0.0  # steps/s between the last two updates; s without a step

    def update(self, step: int) -> bool:
        """Whether to warn now: after ``STALL_TIME`` s without a step, and again whenever the stall has doubled."""
        now = self._clock()
        elapsed, made = now - self._time, step - self._step
        self._step, self._time = step, now
        self.rate = made / elapsed if elapsed > 0.0 else 0.0
        if made:
            self.stalled, self._next_warning = 0.0, STALL_TIME
            return False
        self.stalled += elapsed
        if self.stalled < self._next_warning:
            return False
        self._next_warning = 2.0 * self.stalled
        return True


STUCK = 120.0  # s
LONGEST_LOOK = 2.0  # s that count at most between two looks: this process may have been stopped with the others


class StuckDetector:
    """Notices that no step is made though nothing excuses it: a process that is stopped may be waited for for ever."""

    def __init__(self, limit: float = STUCK, clock: Callable[[], float] = time.monotonic) -> None:
        self.limit, self._clock = limit, clock
        self._step, self._looked, self._still = -1, clock(), 0.0

    def update(self, step: int, *, excused: bool) -> bool:
        """Whether, for ``limit`` s, the counter has stood still without an excuse; to be called about once a second."""
        now = self._clock()
        elapsed, self._looked = min(now - self._looked, LONGEST_LOOK), now
        self._still = 0.0 if excused or step != self._step else self._still + elapsed
        self._step = step
        return self._still > self.limit


def silence_text(
    agents: Sequence[int], seconds: float, others: int, pids: Mapping[int, int], names: Sequence[str] | None
) -> str:
    """That these agents (from 0) have made no step for so long, while ``others`` have; ``pids`` of those known."""
    shown = [agent_name(i + 1, names) + (f" (PID {pids[i]})" if i in pids else "") for i in agents]
    who = f"agent {shown[0]} has" if len(shown) == 1 else f"agents {', '.join(shown)} have"
    return f"{who} made no step for {seconds:.1f} s; the other {others} {'is' if others == 1 else 'are'} on time"


def silent_after(rate: float) -> float:
    """Seconds without a step after which an agent counts as silent; ``rate``: steps that are due per second."""
    return max(SILENT, 5.0 / rate)


class StepAges:
    """Since when each agent has made its newest step, and which are silent: without one for ``after`` s."""

    def __init__(self, after: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._after, self._clock, self._looked = after, clock, clock()
        self._steps: list[int] = []
        self._moved: list[float] = []  # s
        self._last = inf
        # Since when any agent has made steps [s], and the newest step then; None: all stand still, or wait for the
        # epoch, so that nobody is silent.
        self.going: tuple[float, int] | None = None

    def update(self, steps: Sequence[int], last: float = inf) -> list[int]:
        """Take the newest step of every agent (from 0), and the last of the run; which have moved since then."""
        now, self._last = self._clock(), last
        if len(steps) != len(self._steps):
            self._steps, self._moved = list(steps), [now] * len(steps)
        moved = [agent for agent, (old, new) in enumerate(zip(self._steps, steps, strict=True)) if new > old]
        if now - max(self._moved, default=now) > self._after and max(self._steps) < last:
            self.going = None
        if moved and self.going is None:
            self.going = self._looked, max(self._steps)
        for agent in moved:
            self._steps[agent], self._moved[agent] = steps[agent], now
        self._looked = now
        return moved

    def ages(self) -> list[float]:
        """Seconds since each agent has made its newest step."""
        now = self._clock()
        return [now - moved for moved in self._moved]

    def silent(self) -> dict[int, float]:
        """Seconds without a step of those agents (from 0) that have made none for a while, although others have."""
        if self.going is None:
            return {}
        going_for = self._clock() - self.going[0]
        left = [-1 < step < self._last and going_for > self._after for step in self._steps]
        return {i: age for i, age in enumerate(self.ages()) if left[i] and age > self._after}


@dataclass(frozen=True, slots=True)
class Lag:
    """What to warn of in a run in real time: silent agents, or that the others are behind their clock."""

    behind: float = 0.0  # s, of those that are not silent
    silent: tuple[int, ...] = ()  # agents (from 0)
    quiet: float = 0.0  # s without a step of these


class LagDetector:
    """Notices that a run in real time falls behind its clock; ``rate``: steps that are due per second."""

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._ages = StepAges(silent_after(rate), clock)
        self._limit = self._next_warning = 2.0 * silent_after(rate)  # s
        self._next: dict[int, float] = {}  # s without a step at which a silent agent is told again
        self._patient_until = 0.0  # s; an agent that is back makes the steps that it has missed

    def update(self, steps: Sequence[int], last: float = inf) -> Lag | None:
        """After each look at the newest step of every agent: what to warn of now, and again when it has doubled."""
        self._ages.update(steps, last)
        silent = self._ages.silent()
        now = self._clock()
        if self._next.keys() - silent.keys():
            self._patient_until = now + self._limit
        self._next = {agent: at for agent, at in self._next.items() if agent in silent}
        if self._ages.going is None:
            return None
        if any(quiet >= self._next.get(agent, self._limit) for agent, quiet in silent.items()):
            self._next = dict.fromkeys(silent, 2.0 * max(silent.values()))
            return Lag(silent=tuple(silent), quiet=min(silent.values()))
        since, first = self._ages.going
        slowest = min((step for agent, step in enumerate(steps) if agent not in silent), default=first)
        behind = (min(first + (now - since) * self._rate, last) - slowest) / self._rate
        if behind < self._limit / 2.0:
            self._next_warning = self._limit
        if behind < self._next_warning or now < self._patient_until:
            return None
        self._next_warning = 2.0 * behind
        return Lag(behind)


class ClockDetector:
    """Notices that the clock of this machine has been set, by comparison with the one that nobody sets."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, wall: Callable[[], float] = time.time) -> None:
        self._clock, self._wall = clock, wall
        self._apart = wall() - clock()

    def update(self) -> str | None:
        """What has happened since the last call, in words."""
        before, self._apart = self._apart, self._wall() - self._clock()
        forward = self._apart - before
        if abs(forward) < CLOCK_STEP:
            return None
        if forward > 0.0:
            what = f"forward by {forward:.1f} s, or the machine slept: the steps of that time are made at once, too"
            return f"the clock of this machine was set {what} late"
        what = f"back by {-forward:.1f} s: no step is due until it is there again, since steps in real time follow it"
        return f"the clock of this machine was set {what}; a new run begins at once"


MILLISECOND = 1e6  # ns


@dataclass(slots=True)
class Offset:
    """How far another clock is ahead of ours is between these [ns]; infinite: no message in that direction yet."""

    low: float = -inf
    high: float = inf

    @property
    def least(self) -> float:
        """The smallest distance of the clocks that is possible [ns]."""
        return max(self.low, -self.high, 0.0)


class ClockOffsets:
    """Of the clocks of some nodes, by name."""

    # A message sent at s of its sender's clock and received at r of ours has taken r - s plus how far that clock is
    # ahead, which is not negative: s - r bounds the offset from below, and the other direction from above.
    def __init__(self) -> None:
        self._offsets: dict[str, Offset] = {}

    def add(self, node: str, sent: int, received: int, at_most: float = inf) -> None:
        """Take a message: times of its clock and ours, and how far its own is ahead ``at_most``, by ours to it [ns]."""
        offset = self._offsets.setdefault(node, Offset())
        offset.low = max(offset.low, float(sent - received))
        offset.high = min(offset.high, at_most)

    def warning(self, limit: float) -> str | None:
        """Which clocks are certainly more than ``limit`` [ns] from ours, and how far; None: none is."""
        apart = {node: offset for node, offset in self._offsets.items() if offset.least > limit}
        if not apart:
            return None
        worst = max(apart, key=lambda node: apart[node].least)
        ahead = "ahead of" if apart[worst].low > 0 else "behind"
        return (
            f"the clocks of {', '.join(sorted(apart))} are not that of the switcher: {worst} is at least "
            f"{apart[worst].least / MILLISECOND:.1f} ms {ahead} it, more than dt / speed = {limit / MILLISECOND:g} ms: "
            "synchronise the hosts (NTP, PTP)"
        )

    def to_json(self) -> list[dict[str, Any]]:
        """How far each clock is ahead of ours [ms], for JSON; None: not bounded on that side."""
        return [
            {"node": node, "ahead_ms": [_milliseconds(offset.low), _milliseconds(offset.high)]}
            for node, offset in sorted(self._offsets.items())
        ]


def _milliseconds(value: float) -> float | None:
    return None if abs(value) == inf else value / MILLISECOND
