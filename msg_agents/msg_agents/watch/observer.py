# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Reads the states of a running network from the checkpoint files of its agents: nothing is sent, nothing waits."""

from __future__ import annotations

import math
import mmap
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from msg_agents.recovery import FOOTER, StopFiles, entry_size, published_size, room_for
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from msg_analysis.common.resources import one_blas_thread
from msg_analysis.errors import InputError
from msg_analysis.messages.messages import STATE_HEAD, STATE_MODE
from msg_analysis.messages.topics import agent_node_name
from msg_analysis.model.graph_path import HoldingPeriod, holding_periods
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import first_graph

if TYPE_CHECKING:
    from msg_analysis.inference.online_errors import LiveEstimate, LiveReport
    from msg_analysis.inference.online_steps import LoggedStates, Recent, StateLog


BLOCK = 2000  # steps that are taken at once: limits the memory that a large network needs
PERIOD = 0.5  # s between two updates
SHUTDOWN_TIMEOUT = 2.0  # s for the states that are left when the run ends
NICE = 10  # of the thread: on a busy machine the network goes first
MOST_NODES = 20  # agents up to which each gets a standard error: more would cost the network too much CPU time


class CheckpointReader:
    """Reads whole steps from the checkpoints of the agents, each at most once, in order."""

    def __init__(self, record: RunRecord, directory: Path) -> None:
        experiment = record.experiment
        self._directory, self._agents, self._width = directory, experiment.agents, experiment.width
        size, self._beside = entry_size(record), published_size(record)
        self._total, self._slot = room_for(size), size + FOOTER.size
        self._size, self._capacity = size, self._total // self._slot
        self._rings: list[AnyArray] = []  # (capacity, slot) bytes of each agent
        self._next = 0
        self._log: StateLog | None = None
        self.logged: LoggedStates | None = None  # the steps of the last ``take`` and the one after them, if kept
        self.missed = 0  # steps that were overwritten before or while they were read

    def ready(self) -> bool:
        """Whether every agent has its checkpoint; opens them when they are there."""
        if not self._rings:
            paths = [self._directory / f"{agent_node_name(agent)}.states" for agent in range(self._agents)]
            if not all(path.exists() and path.stat().st_size == self._total for path in paths):
                return False
            for path in paths:
                with path.open("rb") as file:
                    ring = np.frombuffer(mmap.mmap(file.fileno(), self._total, access=mmap.ACCESS_READ), np.uint8)
                self._rings.append(ring.reshape(self._capacity, self._slot))
        return True

    def keep(self, log: StateLog) -> None:
        """From now on, ``logged`` has the steps that are taken."""
        self._log = log

    def take(self, reached: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """The next steps k that all agents have made, up to ``reached``: k, modes (b,), x(k), x(k+1) (b, m, width)."""
        # Modes, from 0, are those of the first agent; in real time others may have used another graph.
        oldest = max(reached - self._capacity // 2, 0)  # older ones may be overwritten while they are read
        if self._next < oldest:
            self.missed += oldest - self._next
            self._next = oldest
        last = min(reached, self._next + BLOCK)
        count = max(last - self._next, 0)
        self.logged = None
        if not count:
            none, nothing = np.empty(0, np.int64), np.empty((0, self._agents, self._width))
            return none, none, nothing, nothing
        steps = np.arange(self._next, last + 1)
        states, modes = np.empty((count + 1, self._agents, self._width)), np.empty(0, np.int64)
        there: BoolArray = np.ones(count + 1, dtype=bool)
        entries, lengths = [], []
        for agent, ring in enumerate(self._rings):
            data, length, whole = self._read(ring, steps)
            states[:, agent] = self._numbers(data, length - self._beside, self._width)
            if agent == 0:
                modes = np.ascontiguousarray(data[:, STATE_MODE : STATE_MODE + 4]).view("<u4")[:, 0].astype(np.int64)
            if self._log is not None:
                entries.append(data)
                lengths.append(length)
            there &= whole
        self._next = last
        if self._log is not None:
            self.logged = self._read_log(steps, entries, lengths, there)
        good = there[:-1] & there[1:] & (modes[1:] >= 1)
        self.missed += int((~good).sum())
        return steps[:-1][good], modes[1:][good] - 1, states[:-1][good], states[1:][good]

    def newest(self, steps: Sequence[int], count: int) -> Recent:
        """The last ``count`` steps that some agent has made, from the newest step of each; NaN where one has not."""
        from msg_analysis.inference.online_steps import Recent

        last = max(steps)
        chosen = np.arange(max(0, last - min(count, self._capacity // 2) + 1), last + 1)
        states, modes = np.full((len(chosen), self._agents), np.nan), np.zeros(len(chosen), np.int64)
        for agent, ring in enumerate(self._rings):
            data, length, whole = self._read(ring, chosen)
            states[whole, agent] = self._numbers(data, length - self._beside, self._width)[whole, 0]
        return Recent(chosen, modes, states)

    def stamps(self, steps: IntArray) -> IntArray:
        """Stamps [ns] of these states of every agent, (b, m); -1 where a slot does not hold its step."""
        slots, found = steps % self._capacity, []
        for ring in self._rings:
            head = np.ascontiguousarray(ring[slots, : STATE_HEAD.itemsize]).view(STATE_HEAD)[:, 0]
            stamp = head["seconds"].astype(np.int64) * SECOND + head["nanoseconds"]
            number = np.ascontiguousarray(ring[slots, self._size :]).view("<u8")[:, 1]
            found.append(np.where(number == steps + 1, stamp, -1))
        return np.stack(found, axis=1)

    def _read(self, ring: AnyArray, steps: IntArray) -> tuple[AnyArray, IntArray, BoolArray]:
        """Slots (b, slot), lengths of the entries in them (b,), and whether they still held these steps (b,)."""
        slots = steps % self._capacity
        data = ring[slots]
        footers = np.ascontiguousarray(data[:, self._size :]).view("<u8")
        again = np.ascontiguousarray(ring[slots, self._size :]).view("<u8")
        whole = (footers[:, 1] == steps + 1) & (again[:, 1] == steps + 1)
        return data, np.where(whole, footers[:, 0], self._size).astype(np.int64), whole

    @staticmethod
    def _numbers(data: AnyArray, end: IntArray, count: int) -> FloatArray:
        """(b, count): the numbers in the slots (b, slot) that end there (b,): messages differ in length."""
        columns = end[:, None] - 8 * count + np.arange(8 * count)
        return np.asarray(np.take_along_axis(data, columns, axis=1).view("<f8"))

    def _read_log(
        self, steps: IntArray, entries: list[AnyArray], lengths: list[IntArray], there: BoolArray
    ) -> LoggedStates:
        """The whole ones of these steps, from the slots (b, slot) of every agent."""
        assert self._log is not None
        data = np.stack([entry[there] for entry in entries], axis=1)  # (b, m, slot)
        length = np.stack([each[there] for each in lengths], axis=1)
        published = b""
        if self._beside:
            flat = data.reshape(-1, self._slot)
            published = self._numbers(flat, length.reshape(-1), self._beside // 8).tobytes()
        start = np.arange(length.size) * self._slot
        return self._log.read(steps[there], data.tobytes(), start, length.reshape(-1) - self._beside, published)


class RunObserver:
    """Estimates the errors of a run, in a thread; ``checkpoints``: directory in which its agents keep their states."""

    def __init__(self, record: RunRecord, checkpoints: Path) -> None:
        self.report: LiveReport | None = None  # the newest numbers
        self.note: str | None = None  # why there are none any more; the run goes on
        self.reached: str | None = None  # why the run may end now, if it may end early
        self._record, self._reader = record, CheckpointReader(record, checkpoints)
        self._newest = -1
        self._last: int | None = None  # last step, where the run ends early
        self._path: Iterator[HoldingPeriod] | None = None
        if record.experiment.run.pace == "realtime":
            self._path = holding_periods(record.experiment, first_graph(record.experiment))
        self._path_until = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def look(self, reached: int) -> None:
        """Set the newest step that all agents have published (-1: none)."""
        self._newest = reached

    def beside(self, steps: Sequence[int]) -> LiveReport | None:
        """The newest numbers, with the newest states of each agent, from its newest step, though another has none."""
        from msg_analysis.inference.online_steps import WINDOW

        report = self.report
        return report and replace(report, recent=self._reader.newest(steps, WINDOW))

    def ends_at(self, step: int) -> None:
        """The run ends at this step, before its planned end."""
        self._last = step

    def end(self) -> None:
        """Process what is there by now, for about ``SHUTDOWN_TIMEOUT`` s at most, and stop; the last report stays."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        from msg_analysis.inference.online_errors import LiveEstimate

        with suppress(OSError, AttributeError):  # on Linux each thread has its own priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        try:
            with one_blas_thread():
                estimate = LiveEstimate(self._record, nodes=self._record.experiment.agents <= MOST_NODES)
                if estimate.log is not None:
                    self._reader.keep(estimate.log)
                while not self._over.wait(PERIOD):
                    self._follow(estimate, math.inf)
                self._follow(estimate, time.monotonic() + SHUTDOWN_TIMEOUT)
        except InputError as error:
            self.note = str(error)
        except Exception as error:
            self.note = f"the errors cannot be followed any more ({type(error).__name__}: {error})"

    def _follow(self, estimate: LiveEstimate, deadline: float) -> None:
        if not self._reader.ready():
            return
        while time.monotonic() < deadline and not (deadline == math.inf and self._over.is_set()):
            found = self._reader.take(self._newest if self._last is None else min(self._newest, self._last))
            if (logged := self._reader.logged) is not None:
                self._add_path(estimate, int(logged.steps.max(initial=0)))
                estimate.add_logged(logged)
            if not len(found[0]):
                break
            estimate.add_whole(*found)
            if self._path is not None:
                self._add_stamps(estimate, found[0])
        if self._last is not None:
            estimate.end_at(self._last)
        self.report = report = estimate.report()
        if self._record.until and self.reached is None:
            from msg_analysis.inference.online_errors import reached

            self.reached = reached(self._record.until, report)

    def _add_path(self, estimate: LiveEstimate, newest: int) -> None:
        """In real time: the graph of the network up to a step, as the nodes know it; they refuse any other."""
        while self._path is not None and newest >= self._path_until:
            holding = next(self._path, None)
            if holding is None:
                break
            estimate.add_holding_period(holding.first_step, holding.last_step, holding.mode)
            self._path_until = holding.last_step + 1

    def _add_stamps(self, estimate: LiveEstimate, steps: IntArray) -> None:
        from msg_analysis.inference.online_steps import WINDOW

        steps = steps[-WINDOW:]
        stamps = self._reader.stamps(steps)
        for agent in range(stamps.shape[1]):
            there = stamps[:, agent] >= 0
            estimate.add_stamps(agent, steps[there].tolist(), stamps[there, agent].tolist())


class EarlyEnd:
    """Follows a run, and asks the switcher to end it when that is enough; a context."""

    # The request is a file, so a killed switcher that is restarted finds it again. Without an answer, the run goes on
    # to its planned end: the observer has failed, or the answer comes too late to end earlier.
    def __init__(self, record: RunRecord, checkpoints: Path) -> None:
        assert record.until is not None
        self._record, self._until = record, record.until
        self._files = StopFiles(checkpoints, record.run)
        self._decided, self._asked, self._given_up = False, False, False
        self.last_step = record.experiment.steps
        self.observer = RunObserver(record, checkpoints)

    def look(self, reached: int, note: Callable[[str], None]) -> bool:
        """Take the newest step that all agents have published; True once: ``last_step`` is now known to be earlier."""
        self.observer.look(reached)
        if not self._asked and self.observer.reached is not None:
            self._asked = True
            self._files.ask()
            note(f"--until {self._until}: {self.observer.reached}: the run ends soon")
        if not self._given_up and self.observer.note is not None:
            self._given_up = True
            note(f"--until {self._until}: {self.observer.note}: the run goes on to step {self.last_step}")
        if not self._asked or self._decided or (step := self._files.decided()) is None:
            return False
        self._decided, self.last_step = True, step
        self.observer.ends_at(step)
        return True

    def to_json(self) -> dict[str, Any]:
        """Key ``until`` of result.json."""
        from msg_analysis.inference.online_errors import precision_words

        observer, reason = self.observer, "not reached"
        if observer.reached is not None:
            reason = observer.reached + ("" if self._decided else ", too late to end earlier")
        elif observer.note is not None:
            reason = f"not known: {observer.note}"
        elif observer.report is not None:
            reason += f": {precision_words(observer.report)}"
        return {
            "rule": str(self._until),
            "planned_steps": self._record.experiment.steps,
            "ended_early": self._decided,
            "step": self.last_step,
            "reason": reason,
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.observer.end()
