# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Replay of bags, free of ROS: clock and topics."""

from __future__ import annotations

import fnmatch
import math
import re
import time
from collections.abc import Callable, Iterable, Sequence

from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import show

_TOPIC = re.compile("(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST_TOPIC = 247


def parse_rate(word: object) -> float:
    """A rate as users give it: a positive number, or "max" (inf); ValueError if it is neither."""
    rate = math.inf if word == "max" else float(str(word))
    if not rate > 0 or (isinstance(word, str) and math.isinf(rate) and word != "max"):
        raise ValueError(word)
    return rate


class BagClock:
    """Time of a bag [ns], at ``rate`` seconds of the bag per second of wall time (inf: as fast as possible)."""

    def __init__(
        self, start: int, rate: float, *, paused: bool = False, wall: Callable[[], float] = time.monotonic
    ) -> None:
        self._wall, self.rate, self.paused = wall, rate, paused
        self.jump(start)

    def now(self, limit: int) -> int:
        """Time of the bag [ns], at most ``limit`` (of the next message): no message is older than the clock."""
        if self.paused:
            return self._then
        if math.isinf(self.rate):
            return limit
        return min(limit, self._then + round((self._wall() - self._since) * self.rate * SECOND))

    def until(self, when: int) -> float:
        """Seconds of wall time until a time of the bag [ns]: inf while paused, 0 or less if it has come."""
        if self.paused:
            return math.inf
        if math.isinf(self.rate):
            return 0.0
        return (when - self._then) / (self.rate * SECOND) - (self._wall() - self._since)

    def jump(self, when: int) -> None:
        """Go to a time of the bag [ns]."""
        self._then, self._since = when, self._wall()

    def hold(self, seconds: float) -> None:
        """Do not count the last so many seconds of wall time: nothing was played in them."""
        self._since += seconds

    def pause(self, paused: bool, limit: int) -> None:
        """Pause, or go on from the same time; ``limit`` as in ``now``."""
        if paused != self.paused:
            self.jump(self.now(limit))
            self.paused = paused

    def change_rate(self, factor: float, limit: int) -> None:
        """Multiply the rate by ``factor`` from now on; ``limit`` as in ``now``. The rate inf stays."""
        if not math.isinf(self.rate):
            self.jump(self.now(limit))
            self.rate *= factor


def select_topics(topics: Iterable[str], wanted: Sequence[str], excluded: Sequence[str]) -> list[str]:
    """Names that are wanted (none given: all) and not excluded, by name or pattern such as ``/agent_*/state``."""
    names = list(topics)
    fitting: list[set[str]] = []
    for option, patterns in (("--topics", wanted), ("--exclude", excluded)):
        fitting.append(set())
        for pattern in patterns:
            found = fnmatch.filter(names, pattern if pattern.startswith("/") else f"/{pattern}")
            if not found:
                raise InputError(f"{option}: {pattern}: no such topic in the bag: expected one of {', '.join(names)}")
            fitting[-1].update(found)
    chosen = [name for name in names if (not wanted or name in fitting[0]) and name not in fitting[1]]
    if not chosen:
        raise InputError(f"--exclude: {', '.join(excluded)}: leaves no topic to play: exclude fewer")
    return chosen


def problem_of_name(topic: str) -> str | None:
    """Why ROS 2 has no topic of that name, which is absolute; None where it can have one."""
    if len(topic) <= _LONGEST_TOPIC and _TOPIC.fullmatch(topic):
        return None
    return (
        f"not a name of a topic in ROS 2: expected at most {_LONGEST_TOPIC} letters, digits, _ and /, with no digit "
        "behind a /"
    )


def parse_remaps(remaps: Sequence[str], topics: Sequence[str]) -> dict[str, str]:
    """New names of all topics that are played, by old name; each of ``remaps`` is ``old:=new``."""
    names = {name: name for name in topics}
    for remap in remaps:
        old, separator, new = remap.partition(":=")
        if not separator or not old or not new:
            raise InputError(f"--remap: {remap}: expected old:=new")
        old, new = (name if name.startswith("/") else f"/{name}" for name in (old, new))
        if old not in names:
            raise InputError(f"--remap: {old}: no such topic is played: expected one of {', '.join(topics)}")
        if problem := problem_of_name(new):
            raise InputError(f"--remap: {show(new)}: {problem}")
        names[old] = new
    return names
