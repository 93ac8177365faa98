"""Follows a run beside it: its errors up to now, from what the agents keep, in a thread that goes last."""

from __future__ import annotations

import math
import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from msg_agents.watching.checkpoint_reader import Tap
from msg_analysis.errors import InputError
from msg_analysis.model.run.record import RunRecord

if TYPE_CHECKING:
    from msg_analysis.inference.online.running_errors import LiveEstimate, LiveReport

PERIOD = 0.5  # s between two looks
FAREWELL = 2.0  # s for what has not been looked at when the run ends
NICE = 10  # of the thread: on a machine that has nothing left, the network goes first
MOST_NODES = 20
"""Agents up to which each gets a standard error; beyond, that would take the network's time."""


class Observer:
    """Works out the errors of a run while it goes on.

    Parameters
    ----------
    record
        of the run
    checkpoints
        directory in which its agents keep their states

    Attributes
    ----------
    report
        the newest numbers; None before the first
    note
        why there are none; None where there are
    """

    def __init__(self, record: RunRecord, checkpoints: Path) -> None:
        self.report: LiveReport | None = None
        self.note: str | None = None
        self._record, self._tap = record, Tap(record, checkpoints)
        self._reached = -1
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def look(self, reached: int) -> None:
        """Tell which state all agents have published.

        Parameters
        ----------
        reached
            its step; -1: none
        """
        self._reached = reached

    def end(self) -> None:
        """Take in what is there by now, as far as that does not take long, and stop; the last report stays."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        from threadpoolctl import threadpool_limits

        from msg_analysis.inference.online.running_errors import (
            LiveEstimate,  # takes long to import, while the network starts
        )

        with suppress(OSError, AttributeError):  # each thread has its own on Linux
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        try:
            with threadpool_limits(1):
                estimate = LiveEstimate(self._record, nodes=self._record.experiment.agents <= MOST_NODES)
                while not self._over.wait(PERIOD):
                    self._follow(estimate, math.inf)
                self._follow(estimate, time.monotonic() + FAREWELL)
        except InputError as error:
            self.note = str(error)

    def _follow(self, estimate: LiveEstimate, deadline: float) -> None:
        if not self._tap.ready():
            return
        while time.monotonic() < deadline and not (deadline == math.inf and self._over.is_set()):
            found = self._tap.take(self._reached)
            if not len(found[0]):
                break
            estimate.add_whole(*found)
        self.report = estimate.report()
