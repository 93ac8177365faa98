# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Which runs of a list are shown, and in which order."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from fnmatch import fnmatchcase
from typing import Any, Literal

from msg_analysis.errors import InputError
from msg_analysis.runs.run_list import RunEntry

SortKey = Literal["date", "name", "seed", "verdict", "error"]
NO_VERDICT = "none"

_AGE = re.compile(r"(\d{1,6})([mhd])")
_UNITS = {"m": "minutes", "h": "hours", "d": "days"}
_SORT_KEYS: dict[SortKey, Callable[[RunEntry], Any]] = {
    "date": lambda run: (run.date, run.folder),
    "name": lambda run: (run.name is None, run.name),
    "seed": lambda run: (run.seed is None, run.seed),
    "verdict": lambda run: (run.verdict is None, run.verdict),
    "error": lambda run: math.inf if run.measured is None else run.measured,
}


@dataclass(frozen=True, slots=True)
class RunFilter:
    """What a run must have; empty or None: anything."""

    name: str | None = None  # of the experiment, or a pattern such as line_*
    verdicts: tuple[str, ...] = ()  # one of them; ``NO_VERDICT``: none
    since: datetime | None = None
    until: datetime | None = None  # not included
    seed: int | None = None
    last: int | None = None  # how many at most: the newest

    def choose(self, runs: Sequence[RunEntry], sort: SortKey = "date") -> list[RunEntry]:
        """Those that have it, sorted; runs without the key come last, equal ones are in the order of their dates."""
        chosen = sorted(filter(self._has, runs), key=_SORT_KEYS["date"])
        if self.last is not None:
            chosen = chosen[max(0, len(chosen) - self.last) :]
        return sorted(chosen, key=_SORT_KEYS[sort])

    def _has(self, run: RunEntry) -> bool:
        return (
            (self.name is None or (run.name is not None and fnmatchcase(run.name, self.name)))
            and (not self.verdicts or (run.verdict or NO_VERDICT) in self.verdicts)
            and (self.since is None or run.date >= self.since)
            and (self.until is None or run.date < self.until)
            and (self.seed is None or run.seed == self.seed)
        )


def moment(text: str, option: str, now: datetime, *, end: bool = False) -> datetime:
    """A date, a date with a time, or an age before ``now``, as a time with its zone; without one it is local.

    A date alone is its beginning, or with ``end`` its end. InputError: ``text`` of the ``option`` is none of these.
    """
    age = _AGE.fullmatch(text)
    try:
        if age:
            return now - timedelta(**{_UNITS[age[2]]: int(age[1])})
        found = datetime.fromisoformat(text)
        if end and not re.search(r"[T: ]", text):
            found += timedelta(days=1)
        return found if found.tzinfo else found.astimezone()
    except (ValueError, OverflowError):
        raise InputError(
            f"{option} {text}: expected a date (2026-11-25), a date and a time (2026-11-25T14:30), or an age in "
            "minutes, hours or days (30m, 12h, 7d)"
        ) from None
