# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Received states: checked, and those from before a restart found again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from msg_agents.stepping.synchronizer import HISTORY_STEPS, RESEND_LIMIT, ReceivedSteps, Synchronizer, Value, hashes_of
from msg_analysis.bags.mcap_chunks import gather
from msg_analysis.bags.state_columns import States, own_layout, run_number
from msg_analysis.common.arrays import BoolArray, IntArray
from msg_analysis.messages.acceptance import Refusal, fault_of, state_frame, why_refused
from msg_analysis.messages.cdr import CdrError, decode_batch
from msg_analysis.messages.topics import TRUTHS, Topic
from msg_analysis.model.run_record import RunRecord


class DelayedSynchronizer(Synchronizer[Value]):
    """As Synchronizer, but step k uses x_j(``needed``(j, k)), a step that is at most k and does not fall with k.

    Values may come in any order: those that are sent again after a restart come behind newer ones. A value that is
    older than what is kept anyway, and is still needed, is held.
    """

    def __init__(self, *, needed: Callable[[int, int], int], delay: int, **options: Any) -> None:
        self._needed_step = needed
        self._held: dict[int, tuple[int, Value]] = {}  # by place
        self._oldest: list[int] = []  # by place, the step of the value that the next step would use
        super().__init__(kept=max(HISTORY_STEPS, delay + 1), **options)
        self._look()

    def _look(self) -> None:
        self._oldest = [self._needed_step(j, self.step) for j in self._places]

    def offer(self, agent: int, step: int, value: Value) -> str | None:
        """See Synchronizer."""
        place = self._places.get(agent)
        if place is None:
            return Refusal.NOT_A_PEER
        ahead = step - self.step
        if ahead > self._window + 1:
            return Refusal.TOO_NEW
        known = self._value(place, step)
        if known is not None:
            return Refusal.REPEATED if known == value else Refusal.CONTRADICTION
        if step < self._oldest[place]:  # of no use, but it shows the progress of the peer
            if ahead < -self._window - RESEND_LIMIT:
                return Refusal.TOO_OLD
            if step <= self._newest[agent]:
                return Refusal.REPEATED
        elif ahead >= -self._kept:
            self._row(step)[place] = value
        elif step == self._oldest[place]:  # those between it and the kept ones are never used
            self._held[place] = step, value
        self._newest[agent] = max(self._newest[agent], step)
        if self._needed and self._needed.flags[place] and step == self._oldest[place]:
            self._missing -= 1
        return None

    def known(self, agent: int, step: int) -> Value:
        """See Synchronizer."""
        value = self._value(self._places[agent], step)
        assert value is not None
        return value

    def inputs(self) -> tuple[int, list[Value]]:
        """See Synchronizer: the states x_j(needed(j, step))."""
        assert self._needed is not None
        found = [self._value(place, step) for place, step in enumerate(self._oldest)]
        return self._mode, list(self._needed.pick(found))

    def advance(self) -> None:
        """See Synchronizer."""
        leaving, row = self.step - self._kept, self._row(self.step - self._kept)
        for j, place in self._places.items():
            value = row[place]
            if value is not None and self._needed_step(j, self.step + 1) == leaving:
                self._held[place] = leaving, value
        super().advance()

    def _plan(self) -> None:
        """See Synchronizer."""
        self._look()
        super()._plan()
        if self._needed is not None:
            found = [self._value(place, step) for place, step in enumerate(self._oldest)]
            self._missing = self._needed.pick(found).count(None)

    def _value(self, place: int, step: int) -> Value | None:
        held = self._held.get(place)
        if held is not None and held[0] == step:
            return held[1]
        return self._row(step)[place] if step >= self.step - self._kept else None

    def _next(self, place: int) -> tuple[int, Value | None]:
        """See Synchronizer."""
        return self._oldest[place], self._value(place, self._oldest[place])


_WORD = 4  # bytes; every message in the agents' layout is a multiple of it
_MARK_SHIFT = np.uint64(34)  # the 30 highest bits of a sum are the mark of a message


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """States to be written, in the order in which they came, and what was refused."""

    data: bytes  # in which their messages are
    start: IntArray  # (states,) offsets
    size: IntArray  # (states,) bytes
    agent: IntArray  # (states,) from 0
    step: IntArray  # (states,)
    time: IntArray  # (states,) stamp [ns], at least 0
    refused: list[tuple[str, str]]  # topic and ``Refusal``


class StateReceiver:
    """Takes the batches of a topic (STATES or TRUTHS); ``of``: the topic of the same states, one for each agent.

    ``root``: namespace of the network, with a slash at its end.
    """

    def __init__(self, record: RunRecord, topic: Topic, of: Topic, root: str) -> None:
        experiment = record.experiment
        self.topic, self.of = topic, of
        self.names = [root + of.of(agent) for agent in range(experiment.agents)]  # by agent
        self._record, self._run = record, run_number(record.run.bytes)
        self._frame = state_frame(record, whole=topic is TRUTHS)
        self._graphs = len(experiment.graph_list)
        self._received = [ReceivedSteps(experiment.steps) for _ in range(experiment.agents)]
        self._batches: list[bytes] = []
        self._single: list[bytes] = []
        self._refused: list[tuple[str, str]] = []  # of these
        self._filled = 0
        # Odd numbers, the same in every run: two messages have the same mark with probability 2^-30.
        words = -(-self._frame.size // _WORD)
        self._weights = np.random.Generator(np.random.PCG64(0)).integers(0, 2**63, words, dtype=np.uint64) * 2 + 1

    def add(self, data: bytes) -> int:
        """Take a batch; the number of bytes that wait."""
        self._batches.append(data)
        self._filled += len(data)
        return self._filled

    def add_single(self, agent: int, data: bytes) -> int:
        """The same of a message on the topic of an agent (index from 0)."""
        frame = self._frame.unwrap(data)
        if frame is None or frame[0] != agent + 1:
            self._refused.append((self.names[agent], why_refused(data, self._record, agent, self._frame)))
        else:
            self._single.append(data)
            self._filled += len(data)
        return self._filled

    def take(self) -> Received:
        """What has come since the last call."""
        refused, self._refused = self._refused, []
        data, start, size = self._messages(refused)
        states, _ = own_layout(data, start, size, np.arange(len(start)))
        good = self._possible(states)
        if not good.all() or len(states) < len(start):
            kept = np.zeros(len(start), np.bool_)
            kept[states.position[good]] = True
            for index in np.flatnonzero(~kept).tolist():
                refused.append(self._fault(data[start[index] : start[index] + size[index]]))
            states = states[good]
        agent, step = states.agent - 1, states.step
        new = self._take(agent, step, self._contents(data, states.start, size[states.position]), refused)
        if not new.all():
            states, agent, step = states[new], agent[new], step[new]
        time = np.maximum(states.stamp, 0)
        return Received(data, states.start, size[states.position], agent, step, time, refused)

    def _take(self, agent: IntArray, step: IntArray, contents: IntArray, refused: list[tuple[str, str]]) -> BoolArray:
        """(states,) which of them to write: those that have not come before, and of contradicting ones two."""
        new = np.ones(len(agent), np.bool_)
        if not len(agent):
            return new
        order = np.argsort(agent.astype(np.uint16), kind="stable")  # a radix sort; a bag has fewer topics than 2^16
        agents, steps, marks = agent[order], step[order], hashes_of(contents[order])
        first = np.flatnonzero(np.diff(agents, prepend=-1))  # of each agent
        follows = np.diff(steps, prepend=0) == 1
        follows[first] = True
        in_a_row = np.logical_and.reduceat(follows, first).tolist()
        ends = [*first[1:].tolist(), len(agents)]
        for i, begin, end, row in zip(agents[first].tolist(), first.tolist(), ends, in_a_row, strict=True):
            received = self._received[i]
            if row and received.take_row(int(steps[begin]), marks[begin:end]):
                continue  # as nearly always
            its = order[begin:end]
            for index, k, content in zip(its.tolist(), step[its].tolist(), contents[its].tolist(), strict=True):
                refusal = received.take(k, content)
                if refusal:
                    refused.append((self.names[i], refusal))
                    # Of a contradiction one is forged: the reader of the bag takes neither.
                    new[index] = refusal == Refusal.CONTRADICTION
        return new

    def _messages(self, refused: list[tuple[str, str]]) -> tuple[bytes, IntArray, IntArray]:
        """The messages of all batches: their bytes, (messages,) offsets, and (messages,) sizes."""
        parts, sizes = [], [np.empty(0, np.int64)]
        for batch in self._batches:
            try:
                run, size, messages = decode_batch(batch)
            except CdrError:
                refused.append((self.topic.name, Refusal.UNDECODABLE))
                continue
            if run != self._record.run.bytes:
                refused.append((self.topic.name, Refusal.OTHER_RUN))
                continue
            parts.append(messages)
            sizes.append(size)
        parts += self._single
        sizes.append(np.array([len(message) for message in self._single], dtype=np.int64))
        self._batches.clear()
        self._single.clear()
        self._filled = 0
        size = np.concatenate(sizes)
        return b"".join(parts), np.cumsum(size) - size, size

    def _possible(self, states: States) -> BoolArray:
        """(states,) whether an agent of this run can have sent them."""
        frame, step, mode = self._frame, states.step, states.mode
        good = states.of_run(self._run)
        good &= (states.replicas == frame.replicas) & (states.heard_count <= frame.most_heard)
        good &= (states.agent >= 1) & (states.agent <= len(self.names))
        good &= (mode <= self._graphs) & ((mode == 0) == (step == 0))
        found = states if good.all() else states[good]
        good[good] = np.isfinite(found.state(frame.replicas)).all(axis=1)
        return good

    def _fault(self, data: bytes) -> tuple[str, str]:
        """Topic and ``Refusal`` of a message that is not possible."""
        frame = self._frame.unwrap(data)
        if frame is None or not 1 <= frame[0] <= len(self.names):
            return self.topic.name, why_refused(data, self._record, None, self._frame)
        return self.names[frame[0] - 1], fault_of(*frame[1:], self._graphs) or Refusal.OTHER_LAYOUT

    def _contents(self, data: bytes, start: IntArray, size: IntArray) -> IntArray:
        """(states,) a number of every message: messages with different numbers differ."""
        sums = np.zeros(len(start), np.uint64)
        for length in np.unique(size).tolist():
            alike = np.flatnonzero(size == length)
            words = gather(data, start[alike], length).view("<u4").reshape(len(alike), -1)
            sums[alike] = words.astype(np.uint64) @ self._weights[: words.shape[1]]
        return (sums >> _MARK_SHIFT).astype(np.int64)
