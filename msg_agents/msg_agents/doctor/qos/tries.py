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

"""Several tries of one cell side by side: each has a topic of its own, in the same processes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from msg_agents.doctor.qos.cells import Cell
from msg_agents.doctor.qos.semantics import Action, Demand, demands_of, steps_of
from msg_agents.doctor.qos.tally import Received, Try, tally_reader
from msg_agents.doctor.qos.workers import Worker, Workers

DISCOVERY = 10.0  # s for writer and readers to find each other
PATIENCE = 20.0  # s for messages that must come; Fast DDS repeats what was lost after 3 s, more than once if need be
QUIET = 0.1  # s without a message, after which no more are expected of those that may come
LINGER = 0.1  # s for copies
LONGEST_STOP = 8.0  # s; the middleware may take a process for dead: Cyclone DDS after 10 s, Fast DDS after 20 s
PERIOD = 0.004  # s between two messages of a topic that has readers
SLOWNESS = 10  # a slow reader takes one message of a topic while so many are published


@dataclass(slots=True)
class _Readers:
    """From the time they join until they are killed, or to the end."""

    workers: list[Worker]
    demands: list[Demand] = field(default_factory=list)
    received: list[list[Received]] = field(default_factory=list)  # of each worker, by topic

    def ask(self, command: str, **arguments: Any) -> list[dict[str, Any]]:
        """Let all do it at the same time."""
        for worker in self.workers:
            worker.tell(command, **arguments)
        return [worker.answer() for worker in self.workers]

    def meet(self, demand: Demand) -> None:
        """Wait until they have got what they must get, or do not get it."""
        self.demands.append(demand)
        must, may = ((messages.start, messages.stop) for messages in (demand.must, demand.may))
        self.ask("await", must=must, may=may, seconds=PATIENCE, quiet=QUIET)

    def report(self) -> None:
        """Take what they have got."""
        for answer in self.ask("report"):
            self.received.append([Received(*pair) for pair in answer["received"]])


class _Batch:
    def __init__(self, workers: Workers, cell: Cell, topics: Sequence[str]) -> None:
        self._workers, self._cell, self._topics = workers, cell, topics
        (self._writer,) = workers.start("writer")  # a new one, which remembers no reader of other tries
        self._qos = asdict(cell.qos)
        self._all: list[_Readers] = []  # those of now are the last
        self._counts = [True for _ in topics]
        self._stopped = 0.0  # when the readers were stopped

    def make(self) -> list[Try]:
        """Carry out all steps, and count."""
        self._writer.ask("create", topics=self._topics, qos=self._qos)
        steps = steps_of(self._cell.reader, self._cell.qos.depth)
        for step, demand in zip(steps, demands_of(self._cell.qos, steps), strict=True):
            match step:
                case Action.JOIN:
                    self._join()
                case Action.KILL:
                    self._kill()
                case Action.STOP:
                    self._stopped = time.monotonic()
                    for worker in self._all[-1].workers:
                        worker.stop()
                case Action.CONTINUE:
                    if time.monotonic() - self._stopped > LONGEST_STOP:
                        self._counts = [False for _ in self._topics]
                    for worker in self._all[-1].workers:
                        worker.resume()
                case range():
                    self._publish(step, paced=demand is not None)
            if demand is not None:
                self._all[-1].meet(demand)
        readers = self._all[-1]
        readers.ask("linger", seconds=LINGER)
        readers.report()
        sent = [dict(zip(*pair, strict=True)) for pair in self._writer.ask("report")["sent"]]
        for worker in (*readers.workers, self._writer):
            worker.leave()
        count = sum(len(step) for step in steps if isinstance(step, range))
        return [self._count(topic, sent[topic], count) for topic in range(len(self._topics))]

    def _join(self) -> None:
        readers = _Readers(self._workers.start("reader", self._cell.readers))
        self._all.append(readers)
        for worker in readers.workers:
            worker.tell("join", topics=self._topics, qos=self._qos, seconds=DISCOVERY)
        answers = [
            self._writer.ask("await_readers", count=len(readers.workers), seconds=DISCOVERY),
            *(worker.answer() for worker in readers.workers),
        ]
        found = zip(*(answer["discovered"] for answer in answers), strict=True)
        self._counts = [before and all(now) for before, now in zip(self._counts, found, strict=True)]

    def _kill(self) -> None:
        readers = self._all[-1]
        readers.report()
        for worker in readers.workers:
            worker.kill()

    def _publish(self, numbers: range, *, paced: bool) -> None:
        """Where no reader takes messages, nothing has to be paced."""
        slow = self._cell.reader == "slow"
        if slow:
            self._all[-1].ask("pace", period=SLOWNESS * PERIOD)
        self._writer.ask("publish", numbers=(numbers.start, numbers.stop), period=PERIOD if paced else 0.0)
        if slow:
            self._all[-1].ask("pace", period=0.0)

    def _count(self, topic: int, sent: dict[int, int], count: int) -> Try:
        found = Try(sent=len(sent), refused=count - len(sent), counts=self._counts[topic])
        for readers in self._all:
            for received in readers.received:
                found.tally.add(tally_reader(received[topic], sent, readers.demands))
        return found


def make_tries(workers: Workers, cell: Cell, topics: Sequence[str]) -> list[Try]:
    """One try on each of these topics, which nothing else has used."""
    return _Batch(workers, cell, topics).make()
