# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The states of a run: decoded a batch at a time, and put in their places in the arrays of the result, in any order.

Beside the arrays of the result only a few numbers per state are held, whatever the length of the bag.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.bags.stored_file import Batch, gather
from msg_analysis.common.arrays import AnyArray, BoolArray, FloatArray, IntArray, column, large_zeros, pieces, release
from msg_analysis.common.resources import available_memory
from msg_analysis.common.text import amount
from msg_analysis.errors import BagError
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.cdr import LITTLE_ENDIAN, CdrError
from msg_analysis.messages.messages import STATE_HEAD, STATE_SIZE, AgentState
from msg_analysis.model.reception import LOST
from msg_analysis.model.run import LoggedInputs
from msg_analysis.model.run_record import RunRecord

_ENCAPSULATION = struct.unpack("<I", LITTLE_ENDIAN)[0]


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States in the order of the bag, still in the bytes of their batch, from which the columns are taken on demand."""

    data: bytes  # messages in the agents' own layout
    start: IntArray  # (messages,) offset of the CDR bytes
    head: AnyArray  # (messages,) of type ``STATE_HEAD``
    replicas: IntArray  # (messages,) length of ``state``
    position: IntArray  # (messages,) place among the bag's messages of this kind, from 0

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, index: AnyArray | slice) -> States:
        """Some of them, by an array of indices or of bools, or by a slice."""
        return States(self.data, self.start[index], self.head[index], self.replicas[index], self.position[index])

    def of_run(self, run: tuple[int, int]) -> BoolArray:
        """(messages,) whether they are of the run with this :func:`run_number`."""
        found = self.head["run"]
        return np.asarray((found[:, 0] == run[0]) & (found[:, 1] == run[1]))

    @property
    def agent(self) -> IntArray:
        """(messages,) as sent, from 1."""
        return np.asarray(self.head["agent"].astype(np.int64))

    @property
    def mode(self) -> IntArray:
        """(messages,) as sent, from 1; 0 at step 0."""
        return np.asarray(self.head["mode"].astype(np.int64))

    @property
    def heard_count(self) -> IntArray:
        """(messages,) length of ``heard``."""
        return np.asarray(self.head["heard_count"].astype(np.int64))

    @property
    def step(self) -> IntArray:
        """(messages,) clipped to the range of int64."""
        return np.asarray(np.minimum(self.head["step"], np.uint64(2**63 - 1)).astype(np.int64))

    @property
    def stamp(self) -> IntArray:
        """(messages,) [ns]."""
        return np.asarray(self.head["seconds"].astype(np.int64) * SECOND + self.head["nanoseconds"])

    def heard(self, most: int) -> AnyArray:
        """(messages, most) the first entries of ``heard``, uint64; 0 beyond its end."""
        out = np.zeros((len(self), most), np.uint64)
        length = np.minimum(self.heard_count, most)
        for size in np.unique(length[length > 0]).tolist():
            alike = length == size
            values = gather(self.data, self.start[alike] + STATE_HEAD.itemsize, 8 * size).view("<u8")
            out[alike, :size] = values.reshape(-1, size)
        return out

    def state(self, width: int) -> FloatArray:
        """(messages, width) of states that all have this length."""
        if not width:
            return np.empty((len(self), 0))
        values = gather(self.data, self.start + STATE_SIZE + 8 * self.heard_count, 8 * width).view("<f8")
        return np.asarray(values.reshape(len(self), width), dtype=np.float64)

    def alone(self) -> States:
        """The same with bytes of their own, so that those of the batch can be freed."""
        size = STATE_SIZE + 8 * (self.heard_count + self.replicas)
        ranges = zip(self.start.tolist(), (self.start + size).tolist(), strict=True)
        data = b"".join([self.data[first:end] for first, end in ranges])
        return States(data, np.cumsum(size) - size, self.head, self.replicas, self.position)


def run_number(run: bytes) -> tuple[int, int]:
    """The 16 bytes of a run id as two little-endian uint64, by which :class:`States` tells runs apart."""
    first, second = struct.unpack("<QQ", run)
    return first, second


def decode_states(batch: Batch, chosen: IntArray, position: int) -> tuple[States, int]:
    """The messages ``chosen``, (k,), of a batch, the first at ``position`` in the bag; how many are no AgentState."""
    start, size = batch.start[chosen], batch.size[chosen]
    place = position + np.arange(len(chosen))
    states, fixed = own_layout(batch.data, start, size, place)
    if fixed.all():
        return states, 0
    pieces, end = [batch.data], len(batch.data)
    for index in np.flatnonzero(~fixed).tolist():
        try:
            piece = _in_own_layout(batch.message(int(chosen[index])))
        except CdrError:
            continue
        fixed[index], start[index], size[index] = True, end, len(piece)
        pieces.append(piece)
        end += len(piece)
    states, _ = own_layout(b"".join(pieces), start[fixed], size[fixed], place[fixed])
    return states, len(chosen) - len(states)


def own_layout(data: bytes, start: IntArray, size: IntArray, position: IntArray) -> tuple[States, BoolArray]:
    """The messages that have the agents' own layout, and (messages,) which have: by places in ``data`` and the bag."""
    fixed = size >= STATE_SIZE
    long = start if fixed.all() else np.where(fixed, start, 0)
    if len(data) < STATE_SIZE:
        return States(data, start[:0], np.empty(0, STATE_HEAD), start[:0], start[:0]), np.zeros(len(start), np.bool_)
    head = gather(data, long, STATE_HEAD.itemsize).view(STATE_HEAD)
    fixed &= (head["encapsulation"] == _ENCAPSULATION) & (head["frame_size"] == 1) & (head["frame_end"] == 0)
    numbers, count = size - STATE_SIZE, head["heard_count"].astype(np.int64)
    fixed &= numbers & 7 == 0
    replicas = (numbers >> 3) - count
    fixed &= replicas >= 0
    behind = np.where(fixed, start + STATE_HEAD.itemsize + 8 * count, 0)
    fixed &= gather(data, behind, 4).view("<u4") == replicas
    states = States(data, start, head, replicas, position)
    return states if fixed.all() else states[fixed], fixed


def _in_own_layout(data: bytes) -> bytes:
    """The same message as the agents would have written it; CdrError where it is not an AgentState."""
    message = AgentState.decode(data)
    own = AgentState(
        *(message.stamp, message.run, message.agent, message.step, message.mode, message.state, message.heard)
    )
    try:
        return own.encode().ljust(STATE_SIZE + 8 * len(message.heard), b"\x00")  # no padding before an empty state
    except struct.error as error:
        raise CdrError("AgentState.header: a time out of range") from error


_NEVER = np.zeros(1, dtype=np.bool_)
RELEASED_AT_ONCE = 2**22  # numbers of states after which the memory of large arrays is given back
_CELLS = 2**20  # states that are looked at together at the end
_OTHER_COLUMNS = 4  # numbers of 8 bytes per state beside its own values, some only while it is processed


class Collector:
    """Takes the states of one kind of topic (`state` or `truth`), of any runs."""

    def __init__(self) -> None:
        self._undecodable = 0
        self._position = 0
        self._expected: dict[tuple[int, int], tuple[RunRecord, int]] = {}
        self._counts: Counter[tuple[int, int]] = Counter()  # of the expected runs
        self._collected: dict[tuple[int, int], Collected] = {}
        # For the record of their run, as bytes: in most bags the record comes first.
        self._waiting: list[States] = []

    def add(self, batch: Batch, chosen: IntArray) -> None:
        """Take from a batch the states: the messages with the indices ``chosen``, (k,)."""
        states, undecodable = decode_states(batch, chosen, self._position)
        self._undecodable += undecodable
        self._position += len(chosen)
        for run in self._expected:
            states = self._take(run, states)
        if len(states):
            self._waiting.append(states.alone())

    def _take(self, run: tuple[int, int], states: States) -> States:
        """Take those of a run; the others."""
        its = states.of_run(run)
        if its.any():
            self._counts[run] += int(its.sum())
            if run not in self._collected:  # made for its first state: a bag may have records of runs without states
                self._collected[run] = Collected(*self._expected[run])
            self._collected[run].add(states if its.all() else states[its])
        return states[~its]

    def expect(self, record: RunRecord, width: int) -> None:
        """From now on collect the states, of this length, of a run; BagError: they do not fit into the memory."""
        run = run_number(record.run.bytes)
        if run not in self._expected:
            self._expected[run] = record, width
            self._waiting = [others for states in self._waiting if len(others := self._take(run, states))]

    def count(self, run: bytes) -> int:
        """Number of states of an expected run, given the 16 bytes of its id."""
        return self._counts[run_number(run)]

    def finish(self, record: RunRecord, width: int) -> Collected:
        """All that was collected of a run; call it after the last batch. Arguments and errors as of ``expect``."""
        self.expect(record, width)
        run = run_number(record.run.bytes)
        collected = self._collected.get(run) or Collected(record, width)
        collected.refused[Refusal.UNDECODABLE] += self._undecodable
        collected.refused[Refusal.OTHER_RUN] += self._position - self._undecodable - self._counts[run]
        collected.cut(record.experiment.steps)
        collected.finish()
        return collected


class Collected:
    """The states of a run on one kind of topic, each once, by step and agent. BagError: too large for the memory."""

    def __init__(self, record: RunRecord, width: int) -> None:
        experiment = record.experiment
        self._shape = experiment.steps + 1, experiment.agents
        self._width = width
        self._graphs = experiment.steps if experiment.links else len(experiment.graph_list)  # most that it may have
        self._realtime = experiment.run.pace == "realtime"
        self._record = record
        self._holds = experiment.noise.holds and not self._realtime
        self._lossy = experiment.noise.loss.any or self._realtime
        self._steps_used = self._realtime or self._holds  # whether the log has steps that cannot be known before
        # In lockstep, whether values of other steps than the newest are used, which the log mostly leaves out.
        self._late = not self._realtime and bool(experiment.noise.delay or self._holds)
        most = self._links.most if self._lossy or self._late else 0
        cells = self._shape[0] * self._shape[1]
        # The result has the size that the record states, however little of it the bag holds.
        needed, available = 8 * cells * (width + _OTHER_COLUMNS + most), available_memory()

        def zeros(shape: tuple[int, ...], dtype: type[np.generic]) -> AnyArray:
            return large_zeros(shape, dtype, total=needed)

        try:
            if needed > available:  # a small bag may claim to be of a huge run, whose missing states are all written
                raise MemoryError
            # 0 means missing: position (of the first copy), modes, used and made are one more than that until `finish`.
            self._states: FloatArray = zeros((cells, width), np.float64)
            self._position = zeros((cells,), np.int64)
            self._modes = zeros((cells,), np.int64)
            self._used = zeros((cells, most if self._realtime or self._late else 0), np.int64)
            self._made = zeros((cells if self._realtime else 0,), np.int64)
            self._lost = zeros((cells, most if self._lossy and not self._realtime else 0), np.bool_)
            self._listed = np.zeros(cells if self._lossy else 0, dtype=np.bool_)  # whether ``heard`` was not empty
        except (MemoryError, ValueError) as error:
            raise BagError(
                f"run {record.run}: {experiment.steps} steps of {experiment.agents} agents need {amount(needed)}, "
                f"expected at most {amount(available)}, the memory available: read it on a larger machine"
            ) from error
        self._unreleased = 0  # states since the last release
        self._contradicted: list[IntArray] = []
        self._clock = None if self._realtime else StepClock(experiment.step_length)
        self.wrong_stamp: tuple[int, int, int] | None = None  # see ``Run.wrong_stamp``
        self.lost: BoolArray | None = None
        self.used: IntArray | None = None
        self.made: IntArray | None = None
        self.received = self.duplicates = self.out_of_order = 0
        self.refused: Counter[str] = Counter()

    def add(self, states: States) -> None:
        """Put states of this run in their places; they come in the order of the bag, from call to call too."""
        self._unreleased += len(states)
        states, values = self._good(states)
        cell = states.step * self._shape[1] + states.agent - 1
        if self._clock is not None:
            wrong = states.stamp != self._clock.times(states.step)
            if wrong.any():
                first = states[wrong & (cell == cell[wrong].min())]
                found = int(first.step[0]), int(first.agent[0]) - 1, int(first.stamp.min())
                self.wrong_stamp = min(self.wrong_stamp or found, found)
        place = states.position + 1
        before = self._position[cell]
        fresh = not before.any()
        if fresh:
            self._position[cell] = place
        if fresh and np.array_equal(self._position[cell], place):  # no two are of the same agent and step
            self._write(cell, states, values)
        else:
            _, first = np.unique(cell, return_index=True)
            new = first[before[first] == 0]  # of several copies, the first in the bag
            self._position[cell[new]] = place[new]
            self._write(cell[new], states[new], values[new])
            again = np.delete(np.arange(len(cell)), new)
            differs = self._differ(cell[again], states[again], values[again])
            self.duplicates += len(again)
            self.refused[Refusal.CONTRADICTION] += int(differs.sum())
            self._contradicted.append(np.unique(cell[again[differs]]))
        if self._unreleased * self._width > RELEASED_AT_ONCE:
            self._release()

    def _release(self) -> None:
        self._unreleased = 0
        for array in (self._states, self._position, self._modes, self._used, self._made, self._lost):
            release(array)

    @cached_property
    def _links(self) -> LoggedInputs:
        """Made when the first ``heard`` has to be interpreted: most runs have none."""
        return LoggedInputs(self._record.model, self._record.experiment)

    def _good(self, states: States) -> tuple[States, FloatArray]:
        """Those that can be states of this run, and their values; the others are counted by reason."""
        right = states.replicas == self._width
        if not right.all():
            self.refused[Refusal.WRONG_LENGTH] += int((~right).sum())
            states = states[right]
        values = states.state(self._width)
        finite = np.isfinite(values)
        good = np.ones(len(states), dtype=np.bool_)
        for reason, bad in (
            (Refusal.UNKNOWN_AGENT, (states.agent < 1) | (states.agent > self._shape[1])),
            (Refusal.OUT_OF_RANGE, states.step >= self._shape[0]),
            (Refusal.UNKNOWN_MODE, states.mode > self._graphs),
            (Refusal.NOT_FINITE, _NEVER if finite.all() else ~finite.all(axis=1)),
            (Refusal.BEFORE_START, states.stamp < 0 if self._realtime else _NEVER),
        ):
            if bad.any():
                self.refused[reason] += int((good & bad).sum())
                good &= ~bad
        if not good.all():
            states, values = states[good], values[good]
        if self._lossy or states.heard_count.any():
            heard, count = states.heard(self._links.most), states.heard_count
            fits = self._links.fit(states.step, states.mode, states.agent - 1, heard, count)
            self.refused[Refusal.BAD_HEARD] += int((~fits).sum())
            states, values = states[fits], values[fits]
        return states, values

    def _write(self, cell: IntArray, states: States, values: FloatArray) -> None:
        self._states[cell] = values
        self._modes[cell] = states.mode
        if not self._lossy:
            return
        heard = states.heard(self._links.most)
        self._listed[cell] = states.heard_count > 0
        if self._steps_used:
            listed = np.arange(self._links.most) < states.heard_count[:, None]
            self._used[cell] = np.where(listed & (heard != LOST), heard.astype(np.int64) + 1, 0)
        if self._realtime:
            self._made[cell] = states.stamp + 1
        elif not self._holds:
            self._lost[cell] = heard == LOST

    def _differ(self, cell: IntArray, states: States, values: FloatArray) -> BoolArray:
        """(copies,) whether these copies differ from the first ones, which are in their places."""
        differs = (values != self._states[cell]).any(axis=1) | (states.mode != self._modes[cell])
        if self._lossy:
            differs |= (states.heard(self._links.most) != self._heard(cell)).any(axis=1)
        if self._realtime:
            differs |= states.stamp + 1 != self._made[cell]
        return np.asarray(differs)

    def _heard(self, cell: IntArray) -> AnyArray:
        """(cells, D) ``heard`` of the first copies; 0 beyond its end."""
        step, agent = np.divmod(cell, self._shape[1])
        count = self._links.neighbours(self._modes[cell], agent) * self._listed[cell]
        if self._steps_used:
            used = self._used[cell]
            heard = np.where(used > 0, used.astype(np.uint64) - np.uint64(1), LOST)
        else:
            heard = np.where(self._lost[cell], LOST, self._links.newest(step).astype(np.uint64)[:, None])
        return np.where(np.arange(self._links.most) < count[:, None], heard, np.uint64(0))

    def cut(self, steps: int) -> None:
        """Leave out what comes after this step, of a run that ended there: agents may learn of that a little later."""
        cells = (steps + 1) * self._shape[1]
        self._shape = steps + 1, self._shape[1]
        for name in ("_states", "_position", "_modes", "_used", "_made", "_lost", "_listed"):
            setattr(self, name, getattr(self, name)[:cells])
        self._contradicted = [found[found < cells] for found in self._contradicted]
        if self.wrong_stamp and self.wrong_stamp[0] > steps:
            self.wrong_stamp = None
        if self._realtime:
            for piece in pieces(self._used):
                beyond = (self._used[piece] > steps + 1).any(axis=1)  # of values that are left out
                self.refused[Refusal.BAD_HEARD] += int(beyond.sum())
                self._position[piece][beyond] = 0

    def finish(self) -> None:
        """Mark what is missing; call it after the last state."""
        for cells in self._contradicted:
            # One of the copies is wrong and it is not known which: the state counts as missing.
            for array in (self._position, self._modes, self._used, self._made, self._lost):
                if len(array):
                    array[cells] = 0
        for first in range(0, len(self._position), _CELLS):  # in pieces: a run may be long
            piece = slice(first, first + _CELLS)
            missing = self._position[piece] == 0
            self._states[piece][missing] = np.nan
            self._modes[piece] -= 1
            self._used[piece] -= 1
            if self._late:
                self._complete(piece)
            self._made[piece] -= 1
            self.received += len(missing) - int(missing.sum())
            self._release()
        self.out_of_order = _out_of_order(self._position.reshape(self._shape))
        self.states = self._states.reshape(*self._shape, self._width)  # NaN where missing
        self.modes = self._modes.reshape(self._shape)  # from 0; -1 where missing
        if self._realtime or self._late:
            self.used = self._used.reshape(*self._shape, self._used.shape[1])[1:]
        if self._realtime:
            self.made = self._made.reshape(self._shape)
        elif self._lossy:
            self.lost = self._lost.reshape(*self._shape, self._lost.shape[1])[1:]

    def _complete(self, piece: slice) -> None:
        """Put in the steps of values that the log leaves out, because no message was lost; and which were lost."""
        step, agent = np.divmod(np.arange(piece.start, min(piece.stop, len(self._position))), self._shape[1])
        newest = self._links.newest(step)[:, None]
        there = np.arange(self._links.most) < self._links.neighbours(self._modes[piece] + 1, agent)[:, None]
        if self._holds:
            used = np.where(self._listed[piece, None], self._used[piece], newest)
            self._lost[piece] = there & (used < newest)
        else:
            used = np.where(self._lost[piece], -1, newest) if self._lossy else newest
        self._used[piece] = np.where(there, used, -1)


def _out_of_order(position: IntArray) -> int:
    """How many states came after a later one of their agent, by (N + 1, m) place in the bag, from 1; 0: missing."""
    late = 0
    for agent in range(position.shape[1]):  # one agent at a time: less memory
        its = column(position, agent)
        came = np.where(its > 0, its, np.iinfo(np.int64).max)
        first_of_later = np.minimum.accumulate(came[::-1])[::-1]
        late += int((first_of_later[1:] < its[:-1]).sum())
    return late
