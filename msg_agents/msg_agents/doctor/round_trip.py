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

"""Two processes exchange messages, started as those of any run."""

from __future__ import annotations

import time
from collections.abc import Sequence

from msg_agents.doctor.check import Check
from msg_agents.running.runner import run_network
from msg_agents.terminal.interruption import raise_for
from msg_agents.watching.view import View
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment

LIMIT = 12.0  # s for both agents to make steps: long enough for a machine that is busy
MEASURED = 0.5  # s of steps: some thousand
PAIR = {
    "name": "doctor",
    "graphs": {"pair": {"path": [1, 2]}},
    "run": {"dt": 0.01, "duration": 1000, "start": "zero", "processes": 2},
}
PER_ROUND_TRIP = 2  # steps: an agent waits in each for a message that the other one sent in the step before


class _EnoughError(Exception):
    """The run is to end now."""


class _Stopwatch(View):
    """Measures the steps of a run, and ends it."""

    def __init__(self) -> None:
        super().__init__(lambda _: None, lambda _: None)
        self._start = time.monotonic()
        self._reports: list[tuple[float, int]] = []  # times at which the newest step was another one, and which
        self.rate = 0.0  # steps/s

    def look(self, steps: Sequence[int]) -> None:
        """The newest step of every agent; _EnoughError when they have been measured, or will not come any more."""
        now, reached = time.monotonic(), min(steps, default=-1)
        if reached >= 0 and (not self._reports or reached > self._reports[-1][1]):
            self._reports.append((now, reached))
            (began, first), (then, last) = self._reports[0], self._reports[-1]
            self.rate = (last - first) / (then - began) if then > began else 0.0
            if then - began >= MEASURED:
                raise _EnoughError
        if now - self._start > LIMIT:
            raise _EnoughError


def check_round_trip() -> Check:
    """Whether two processes of a run hear each other, and how long a message takes there and back."""
    name, watch = "round_trip", _Stopwatch()
    try:
        result = run_network(ValidExperiment.parse(PAIR), None, restarts=0, view=watch)
    except InputError as error:
        return Check(name, "error", str(error))
    except OSError as error:  # too few files or processes, a full disk
        return Check(name, "error", f"two processes could not be started: {error}: raise that limit")
    except _EnoughError:
        failures = []
    else:
        raise_for(result.interrupted_by)
        failures = result.failures
    if failures or not watch.rate:
        what = failures[0] if failures else f"not within {LIMIT:g} s"
        remedy = "do what the warnings above say, and see docs/troubleshooting.md"
        return Check(name, "error", f"two processes exchange messages: {what}: {remedy}")
    duration = PER_ROUND_TRIP / watch.rate
    return Check(name, "ok", f"{duration * 1e3:.2g} ms between two processes, computing included", duration)
