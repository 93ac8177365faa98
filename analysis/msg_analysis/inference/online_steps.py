# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Steps of a network that runs, as they are logged."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from msg_analysis.arithmetic.reproducible import StepClock
from msg_analysis.bags.states import own_layout
from msg_analysis.common.arrays import AnyArray, FloatArray, IntArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.model.run import LoggedInputs
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import phases


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStates:
    """Whole steps, in any order: what led to x(k) is that of the step k-1 -> k, with graphs from 0; -1 at step 0."""

    steps: IntArray  # (b,) k
    states: FloatArray  # (b, m, R) x(k)
    published: FloatArray | None  # (b, m, R) what was published of x(k); None: x(k)
    graphs: IntArray  # (b, m) that the agents used
    used: IntArray  # (b, m, D) as in ``Run``

    def __getitem__(self, chosen: AnyArray | slice) -> LoggedStates:
        published = None if self.published is None else self.published[chosen]
        return LoggedStates(self.steps[chosen], self.states[chosen], published, self.graphs[chosen], self.used[chosen])


class StateLog:
    """Reads the messages of a run; ``impossible`` counts the states with an impossible graph or ``heard``."""

    def __init__(self, record: RunRecord) -> None:
        experiment = record.experiment
        self._inputs = LoggedInputs(record.model, experiment)
        self._agents, self._replicas, self._width = experiment.agents, experiment.run.replicas, experiment.width
        self._graphs = len(experiment.graph_list)
        self.truth = experiment.truth  # whether what is published is something else than the state
        self.impossible = 0

    def read(self, steps: IntArray, data: bytes, start: IntArray, size: IntArray, published: bytes) -> LoggedStates:
        """Steps (b,) whose messages (b m,), agent by agent, are ``data``; what was ``published``, if not the states."""
        b, m = len(steps), self._agents
        found, own = own_layout(data, start, size, np.arange(len(start)))
        assert own.all(), "checked when they came"
        step, agent, mode = np.repeat(steps, m), np.tile(np.arange(m), b), np.minimum(found.mode, self._graphs + 1)
        possible = (mode <= self._graphs) & ((mode == 0) == (step == 0))
        known, heard, count = np.where(possible, mode, 0), found.heard(self._inputs.most), found.heard_count
        possible &= self._inputs.fit(step, known, agent, heard, count)
        self.impossible += int((~possible).sum())
        values = None
        if self.truth:
            values = np.frombuffer(published, "<f8").reshape(b, m, self._replicas)
        states = found.state(self._width).reshape(b, m, self._width)[:, :, : self._replicas]
        good = possible.reshape(b, m).all(axis=1) & np.isfinite(states).all(axis=(1, 2))
        if values is not None:
            good &= np.isfinite(values).all(axis=(1, 2))
        used = self._inputs.used(step, known, agent, heard, count)
        every = LoggedStates(steps, states, values, (known - 1).reshape(b, m), used.reshape(b, m, -1))
        return every if good.all() else every[good]

    def of_messages(
        self, steps: Sequence[int], messages: Sequence[Sequence[bytes]], published: Sequence[Sequence[bytes]]
    ) -> LoggedStates:
        """The same of the messages of every step, one of each agent."""
        each = list(chain.from_iterable(messages))
        size = np.array([len(message) for message in each], dtype=np.int64)
        values = b"".join(chain.from_iterable(published))
        return self.read(np.array(steps, dtype=np.int64), b"".join(each), np.cumsum(size) - size, size, values)


WINDOW = 240  # steps that are kept


@dataclass(frozen=True, slots=True, eq=False)
class Recent:
    """The newest whole steps, at least one, ascending; some may be missing between them."""

    steps: IntArray  # (b,)
    modes: IntArray  # (b,) graph k -> k+1 from 0; in real time that of the first agent, or 0 where it is not known
    states: FloatArray  # (b, m) first replica

    def newest(self) -> Recent:
        """The last ``WINDOW`` of any steps, in order, as a copy."""
        order = np.argsort(self.steps, kind="stable")[-WINDOW:]
        return Recent(self.steps[order], self.modes[order], self.states[order])


class RecentSteps:
    """Keeps the last ``WINDOW`` whole steps."""

    def __init__(self) -> None:
        self._kept: Recent | None = None

    def add(self, steps: IntArray, modes: IntArray, states: FloatArray) -> None:
        """Add whole steps k (b,): graphs from 0 (b,), x(k) (b, m, width)."""
        new = Recent(steps, modes, states[:, :, 0]).newest()
        if self._kept is not None:
            new = Recent(
                np.concatenate([self._kept.steps, new.steps]),
                np.concatenate([self._kept.modes, new.modes]),
                np.concatenate([self._kept.states, new.states]),
            ).newest()
        self._kept = new

    def newest(self) -> Recent | None:
        """What is kept; None before the first step."""
        return self._kept


class Lateness:
    """Real time: how long after they were due the agents made their newest steps, as in ``timing``."""

    def __init__(self, experiment: Experiment) -> None:
        self._clocks = [StepClock(experiment.step_length, phase) for phase in phases(experiment).tolist()]
        self._speed = experiment.run.speed
        self._late: list[deque[int]] = [deque(maxlen=WINDOW) for _ in self._clocks]  # [ns] of simulated time

    def add(self, agent: int, step: int, stamp: int) -> None:
        """Take the stamp [ns] of x(step) of an agent (from 0)."""
        if step > 0:  # x(0) is there before the time begins
            self._late[agent].append(stamp - self._clocks[agent].nanoseconds(step - 1))

    def medians(self) -> list[float | None]:
        """Of each agent, over its last ``WINDOW`` steps that were added [s of wall time]; None: none was."""
        return [float(np.median(late)) / 1e9 / self._speed if late else None for late in self._late]


SPREAD = 64  # steps that neighbours can be apart in lockstep
WRITER_HISTORY = 5_000  # states of one agent that may arrive late, after they were sent again
MOST_WAITING = 20_000  # incomplete steps kept, at most


@dataclass(slots=True)
class _Row:
    """What has arrived of one step."""

    payloads: list[bytes | None]  # of the states, and with a log of what was published of them
    left: int  # payloads that are missing
    mode: int  # graph that led to the step, from 1
    messages: list[bytes]  # of the states, where the log is kept; else empty
    usable: bool = True  # False after a contradiction
    used: bool = False
    states: bytes | None = None


class StepCollector:
    """Collects the states of m agents, in any order, into whole steps; ``logged``: with their messages."""

    def __init__(
        self, agents: int, modes: int, last: int, *, lockstep: bool, logged: bool = False, truth: bool = False
    ) -> None:
        self._agents, self._modes, self._last, self._lockstep = agents, modes, last, lockstep
        self._logged, self._expected = logged, agents * (2 if truth else 1)
        self._window = min(SPREAD * (agents + 1) + WRITER_HISTORY, MOST_WAITING)
        self._rows: dict[int, _Row] = {}
        self._low = 0  # earlier steps are no longer kept
        self._ready: list[tuple[int, int, bytes, bytes]] = []  # step, mode, states, those after it
        self._log: list[tuple[int, list[bytes], list[bytes]]] = []  # step, messages, what was published
        self._over: int | None = None  # last step of a run that ends early
        self.refused: Counter[str] = Counter()  # states or steps that do not count, by reason
        self.newest = self.whole = -1  # largest step with any state, and with all states; -1: none

    def end_at(self, step: int) -> None:
        """The run ends at this step: what comes after it is not a part of it."""
        self._over = step
        self._rows = {k: row for k, row in self._rows.items() if k <= step}

    def add(
        self, agent: int, step: int, mode: int, payload: bytes, message: bytes = b"", *, published: bool = False
    ) -> None:
        """Take x(step) of an agent (from 0), or what was published of it, and the graph that led to it, from 1."""
        if published:
            agent += self._agents
        row = self._rows.get(step)
        if row is None:
            if self._over is not None and step > self._over:
                return
            if not self._low <= step <= self._last:
                self.refused[Refusal.TOO_LATE if step < self._low else Refusal.OUT_OF_RANGE] += 1
                return
            if step > self.newest:
                self.newest = step
                self._forget(step - self._window)
            messages = [b""] * self._agents if self._logged else []
            row = self._rows[step] = _Row([None] * self._expected, self._expected, mode, messages)
        before = row.payloads[agent]
        if before is not None:
            self.refused[Refusal.REPEATED] += 1
            differs = before != payload or (self._lockstep and mode != row.mode)
            differs |= self._logged and not published and row.messages[agent] != message
            if differs and row.usable:
                row.usable = False  # which copy is genuine is unknown
                self.refused[Refusal.CONTRADICTION] += 1
            return
        row.payloads[agent] = payload
        if self._logged and not published:
            row.messages[agent] = message
        row.left -= 1
        if mode != row.mode and self._lockstep and row.usable:
            row.usable = False
            self.refused[Refusal.OTHER_MODES] += 1
        if not row.left:
            self._complete(step, row)

    def take(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Steps that have become ready: k (b,), their graphs from 0 (b,), x(k) and x(k+1) (b, m, width)."""
        # Outside lockstep the graphs are 0, and x(k) takes the place of x(k+1).
        ready, self._ready = self._ready, []
        steps = np.array([entry[0] for entry in ready], dtype=np.int64)
        modes = np.array([entry[1] - 1 for entry in ready], dtype=np.int64)
        shape = len(ready), self._agents, -1 if ready else 0
        states = np.frombuffer(b"".join([entry[2] for entry in ready]), "<f8").reshape(shape)
        after = np.frombuffer(b"".join([entry[3] for entry in ready]), "<f8").reshape(shape)
        good = np.isfinite(states).all(axis=(1, 2)) & np.isfinite(after).all(axis=(1, 2))
        self.refused[Refusal.NOT_FINITE] += int((~good).sum())
        return steps[good], modes[good], states[good], after[good]

    def take_log(self) -> list[tuple[int, list[bytes], list[bytes]]]:
        """Whole steps since the last call: k, the messages of its states, and what was published of them."""
        log, self._log = self._log, []
        return log

    def _complete(self, step: int, row: _Row) -> None:
        payloads = [payload for payload in row.payloads if payload is not None]
        row.states = b"".join(payloads[: self._agents])
        if self._logged and row.usable:
            self._log.append((step, row.messages, payloads[self._agents :]))
        self.whole = max(self.whole, step)
        if self._lockstep:
            self._pair(step - 1)
            self._pair(step)
        elif row.usable:
            self._ready.append((step, 1, row.states, row.states))
            row.used = True
        while (first := self._rows.get(self._low)) is not None and first.used:
            del self._rows[self._low]
            self._low += 1

    def _pair(self, step: int) -> None:
        """Make a step ready once it and its successor are whole."""
        here, after = self._rows.get(step), self._rows.get(step + 1)
        if here is None or after is None or here.states is None or after.states is None or here.used:
            return
        if here.usable and after.usable and 1 <= after.mode <= self._modes:
            self._ready.append((step, after.mode, here.states, after.states))
        here.used = True

    def _forget(self, low: int) -> None:
        if low - self._low > len(self._rows):  # after a jump: a late reader begins in the middle of the run
            self._rows = {step: row for step, row in self._rows.items() if step >= low}
        else:
            for step in range(self._low, low):
                self._rows.pop(step, None)
        self._low = max(self._low, low)
