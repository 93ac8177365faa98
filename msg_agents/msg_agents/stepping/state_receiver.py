# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""States received by a recorder: batches are checked, and each step is taken once."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np

from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.bags.states import States, own_layout, run_number
from msg_analysis.bags.stored_file import gather
from msg_analysis.common.arrays import BoolArray, IntArray
from msg_analysis.messages.acceptance import Refusal, fault_of, state_frame, why_refused
from msg_analysis.messages.cdr import CdrError, decode_batch
from msg_analysis.messages.topics import TRUTHS, Topic
from msg_analysis.model.run_record import RunRecord

_MASK = 0x3FFFFFFF  # of the bits of a content that are in its hash
CONSECUTIVE = 64  # steps in a row after which those before them are taken for lost: the reader came late, for example
_WORD = 4  # bytes; every message in the agents' layout is a multiple of it
_HASH_SHIFT = np.uint64(34)  # the 30 highest bits of a sum are the hash of a message


def hashes_of(contents: IntArray) -> array[int]:
    """Hashes of so many contents: numbers of 30 bits, not 0."""
    return array("i", ((contents & _MASK) + 1).astype(np.int32).tobytes())


class ReceivedSteps:
    """The steps 0 to ``last`` of one agent, in any order: after a restart some come again."""

    # A hash of 4 bytes per step shows whether a repeated one is the same, up to RESEND_LIMIT steps around ``row``.
    def __init__(self, last: int) -> None:
        self.row = -1  # the newest step up to which none is to come any more
        self._last = last
        self._chain = (0, 0)  # the step that would continue the newest ones beyond ``row``, and how many these are
        # 0: not received. Negative: two different ones were.
        self._hashes = array("i", bytes(4 * min(2 * RESEND_LIMIT, last + 1)))

    def take(self, step: int, content: int) -> str | None:
        """Take a step with a hash of its content; None if it is new, else a ``Refusal``."""
        if step > self._last:
            return Refusal.OUT_OF_RANGE
        if step <= self.row - RESEND_LIMIT:
            return Refusal.TOO_OLD
        if step > self.row + 1:
            following, count = self._chain
            self._chain = (step + 1, count + 1 if step == following else 1)
            if self._chain[1] >= CONSECUTIVE:
                self._move(step - 1)
        if step > self.row + RESEND_LIMIT:
            return Refusal.TOO_NEW
        slot, value = step % len(self._hashes), (content & _MASK) + 1
        known = self._hashes[slot]
        if not known:
            self._hashes[slot] = value
            while self.row < self._last and self._hashes[(self.row + 1) % len(self._hashes)]:
                self._move(self.row + 1)
            return None
        if known == value or known < 0:  # of different ones of one step, the second is a contradiction, no further ones
            return Refusal.REPEATED
        self._hashes[slot] = -known
        return Refusal.CONTRADICTION

    def take_row(self, first: int, hashes: array[int]) -> bool:
        """Take the steps from ``first`` on at once, if they follow ``row`` and all are new; else False, and none."""
        size, last = len(self._hashes), first + len(hashes) - 1
        slot = first % size
        end = slot + len(hashes)
        if first != self.row + 1 or last > self._last or end > size or any(self._hashes[slot:end]):
            return False
        self._hashes[slot:end] = hashes
        self._move(last)
        while self.row < self._last and self._hashes[(self.row + 1) % size]:
            self._move(self.row + 1)
        return True

    def _move(self, row: int) -> None:
        """Set ``row``; the steps that are then within reach take the places of old ones."""
        size = len(self._hashes)
        step = max(self.row, row - size) + RESEND_LIMIT + 1
        end = min(row + RESEND_LIMIT, self._last) + 1
        if end - step == 1:  # in order, one after the other
            self._hashes[step % size] = 0
            step = end
        while step < end:
            slot = step % size
            count = min(end - step, size - slot)
            self._hashes[slot : slot + count] = array("i", bytes(4 * count))
            step += count
        self.row = row


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
    """Takes the batches of a topic (STATES or TRUTHS); ``of``: the topic of the same states, one for each agent."""

    def __init__(self, record: RunRecord, topic: Topic, of: Topic, root: str) -> None:  # root: namespace and slash
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
        # Odd numbers, the same in every run: two messages have the same hash with probability 2^-30.
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
            accepted = np.zeros(len(start), np.bool_)
            accepted[states.position[good]] = True
            for index in np.flatnonzero(~accepted).tolist():
                refused.append(self._fault(data[start[index] : start[index] + size[index]]))
            states = states[good]
        agent, step = states.agent - 1, states.step
        new = self._take(agent, step, self._contents(data, states.start, size[states.position]), refused)
        if not new.all():
            states, agent, step = states[new], agent[new], step[new]
        return Received(data, states.start, size[states.position], agent, step, np.maximum(states.stamp, 0), refused)

    def _take(self, agent: IntArray, step: IntArray, contents: IntArray, refused: list[tuple[str, str]]) -> BoolArray:
        """(states,) which of them to write: those that have not come before, and of contradicting ones two."""
        new = np.ones(len(agent), np.bool_)
        if not len(agent):
            return new
        order = np.argsort(agent.astype(np.uint16), kind="stable")  # a radix sort; a bag has fewer topics than 2^16
        agents, steps, hashes = agent[order], step[order], hashes_of(contents[order])
        first = np.flatnonzero(np.diff(agents, prepend=-1))  # of each agent
        follows = np.diff(steps, prepend=0) == 1
        follows[first] = True
        in_a_row = np.logical_and.reduceat(follows, first).tolist()
        ends = [*first[1:].tolist(), len(agents)]
        for i, begin, end, row in zip(agents[first].tolist(), first.tolist(), ends, in_a_row, strict=True):
            received = self._received[i]
            if row and received.take_row(int(steps[begin]), hashes[begin:end]):
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
            if run == self._record.run.bytes:
                parts.append(messages)
                sizes.append(size)
            else:
                refused.append((self.topic.name, Refusal.OTHER_RUN))
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
        return (sums >> _HASH_SHIFT).astype(np.int64)
