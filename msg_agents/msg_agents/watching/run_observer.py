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

"""Errors of a run while it goes on, from the states that its agents keep, in a thread of low priority."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from msg_agents.watching.checkpoint_reader import CheckpointReader
from msg_analysis.common.blas_threads import one_blas_thread
from msg_analysis.errors import InputError
from msg_analysis.model.run.graph_path import Sojourn, sojourns
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.step_model import first_graph
from msg_analysis.types import IntArray

if TYPE_CHECKING:
    from msg_analysis.inference.online.running_errors import LiveEstimate, LiveReport

PERIOD = 0.5  # s between two updates
FAREWELL = 2.0  # s for the states that are left when the run ends
NICE = 10  # of the thread: on a busy machine the network goes first
MOST_NODES = 20
"""Up to this many agents, each gets a standard error; for more it would cost the network too much CPU time."""


class RunObserver:
    """Estimates the errors of a run; ``checkpoints``: directory in which its agents keep their states.

    Its thread sets ``report`` (the newest numbers; None before the first), ``note`` (why there are none any more) and,
    of a run that may end early, ``reached`` (why it may end now). Whatever happens to it, the run goes on.
    """

    def __init__(self, record: RunRecord, checkpoints: Path) -> None:
        self.report: LiveReport | None = None
        self.note: str | None = None
        self.reached: str | None = None
        self._record, self._reader = record, CheckpointReader(record, checkpoints)
        self._newest = -1
        self._last: int | None = None  # last step, where the run ends early
        self._path: Iterator[Sojourn] | None = None
        if record.experiment.run.pace == "realtime":
            self._path = sojourns(record.experiment, first_graph(record.experiment))
        self._sojourns_until = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def look(self, reached: int) -> None:
        """Set the newest step that all agents have published (-1: none)."""
        self._newest = reached

    def ends_at(self, step: int) -> None:
        """The run ends at this step, before its planned end."""
        self._last = step

    def end(self) -> None:
        """Process what is there by now, for about ``FAREWELL`` s at most, and stop; the last report stays."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        from msg_analysis.inference.online.running_errors import (
            LiveEstimate,  # takes long to import, while the network starts
        )

        with suppress(OSError, AttributeError):  # on Linux each thread has its own priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        try:
            with one_blas_thread():
                estimate = LiveEstimate(self._record, nodes=self._record.experiment.agents <= MOST_NODES)
                if estimate.log is not None:
                    self._reader.keep(estimate.log)
                while not self._over.wait(PERIOD):
                    self._follow(estimate, math.inf)
                self._follow(estimate, time.monotonic() + FAREWELL)
        except InputError as error:
            self.note = str(error)
        except Exception as error:
            self.note = f"the errors cannot be followed any more ({type(error).__name__}: {error})"

    def _follow(self, estimate: LiveEstimate, deadline: float) -> None:
        if not self._reader.ready():
            return
        while time.monotonic() < deadline and not (deadline == math.inf and self._over.is_set()):
            found = self._reader.take(self._newest if self._last is None else min(self._newest, self._last))
            logged = self._reader.logged()
            if logged is not None:
                self._add_sojourns(estimate, int(logged.steps.max(initial=0)))
                estimate.add_logged(logged)
            if not len(found[0]):
                break
            estimate.add_whole(*found)
            if self._record.experiment.run.pace == "realtime":
                self._add_stamps(estimate, found[0])
        if self._last is not None:
            estimate.end_at(self._last)
        self.report = report = estimate.report()
        if self._record.until and self.reached is None:
            from msg_analysis.inference.online.stopping import reached

            self.reached = reached(self._record.until, report)

    def _add_sojourns(self, estimate: LiveEstimate, newest: int) -> None:
        """In real time: the graph of the network up to a step, as the nodes know it; they refuse any other."""
        while self._path is not None and newest >= self._sojourns_until:
            sojourn = next(self._path, None)
            if sojourn is None:
                break
            estimate.add_sojourn(sojourn.first_step, sojourn.last_step, sojourn.mode)
            self._sojourns_until = sojourn.last_step + 1

    def _add_stamps(self, estimate: LiveEstimate, steps: IntArray) -> None:
        from msg_analysis.inference.online.recent_steps import WINDOW

        steps = steps[-WINDOW:]
        stamps = self._reader.stamps(steps)
        for agent in range(stamps.shape[1]):
            there = stamps[:, agent] >= 0
            estimate.add_stamps(agent, steps[there].tolist(), stamps[there, agent].tolist())
