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

"""Brings the faults of a plan about while a network runs, and ends a network that stands still."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence

from msg_agents.doctor.networks.fault_plan import Fault, FaultPlan
from msg_agents.watching.view import View
from msg_analysis.common.forked_processes import Process

PATIENCE = 60.0  # s without a step or a restart: three leases of the middleware, or twice the time of discovery


class FaultInjection(View):
    """Kills, stops and continues processes of the run that it views."""

    def __init__(self, plan: FaultPlan, patience: float = PATIENCE) -> None:
        super().__init__(lambda _: None, lambda _: None)
        self._pending = list(plan.faults)
        self._patience = patience
        self._processes: Mapping[str, Process] = {}
        self._reached: dict[int, float] = {}  # when each step of the plan was seen to have been reached
        self._stopped: list[tuple[float, Process]] = []  # until when
        self._newest: list[int] = []
        self._moved = time.monotonic()
        self.delivered: list[Fault] = []  # the others found their process ended
        self.notes: list[str] = []  # of restarts and stalls
        self.process_count = 0
        self.standstill: str | None = None  # why the run was ended

    def started(self, processes: Mapping[str, Process]) -> None:
        """See View."""
        self._processes = processes
        self._moved = time.monotonic()
        self.process_count = len({process.pid for process in processes.values()})

    def note(self, line: str) -> None:
        """See View."""
        self.notes.append(line)

    def look(self, steps: Sequence[int]) -> None:
        """See View."""
        now, reached = time.monotonic(), min(steps, default=-1)
        self._go_on(lambda until: until <= now)
        for fault in list(self._pending):
            if fault.step <= reached and now >= self._reached.setdefault(fault.step, now) + fault.wait:
                self._pending.remove(fault)
                self._deliver(fault, now)
        if list(steps) != self._newest:
            self._newest, self._moved = list(steps), now
        if now > self._moved + self._patience and self.standstill is None:
            cause = f": {self.notes[-1]}" if self.notes else ""
            self.standstill = f"ended after {self._patience:g} s without a step{cause}"
            signal.raise_signal(signal.SIGINT)  # so that the run ends in order, and its logs are kept

    def end(self) -> None:
        """Continue what is stopped: it could not end."""
        self._go_on(lambda _: True)

    def _deliver(self, fault: Fault, now: float) -> None:
        process = self._processes[fault.node]
        if process.poll() is not None:
            return
        self.delivered.append(fault)
        if fault.stopped is None:
            process.send_signal(signal.SIGKILL)
        else:
            process.send_signal(signal.SIGSTOP)
            self._stopped.append((now + fault.stopped, process))

    def _go_on(self, due: Callable[[float], bool]) -> None:
        for until, process in self._stopped:
            if due(until):
                process.send_signal(signal.SIGCONT)
        self._stopped = [(until, process) for until, process in self._stopped if not due(until)]
