# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The recorder node: writes every message of the run, unchanged, into an MCAP bag."""

from __future__ import annotations

import contextlib
import ctypes
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from msg_agents.nodes.base import NOT_AN_AGENT, Health, NetworkNode
from msg_agents.nodes.ros import every
from msg_agents.stepping.state_receiver import StateReceiver
from msg_analysis.bags.stored_file import DEFAULT_STORAGE, Storage
from msg_analysis.bags.writing import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.topics import Topic, agent_node_name, network_topics
from msg_analysis.model.run_record import RunRecord

# Bytes of states after which they are written: 16 kB for each agent, within these bounds. Many at once cost a fraction
# of one by one, but in longer turns the recorder delays agents on the same core.
LEAST_WRITE, MOST_WRITE = 2**15, 2**20
WRITE_PERIOD = 0.1  # s of wall time after which fewer are written, in slow runs and at the end
UNNAMED = "_NODE_NAME_UNKNOWN_"  # node of a writer that ROS 2 does not know yet: of our agents, too, at first
UNNAMED_TIME = 5.0  # s after which such a writer is taken for one of another node
LOOK_PERIOD = 0.5  # s of wall time between two looks for other nodes that publish states
KEPT_MEMORY, LARGEST_KEPT = 2**26, 2**25  # bytes: of all that is free, and of one array (the most that glibc takes)
FLUSH_PERIOD = 1.0  # s of wall time: a killed recorder loses at most so much, even if a chunk takes longer to fill


class Recorder(NetworkNode):
    """Records a run into ``directory`` (new or empty), and detects when the run is complete."""

    # Messages are stamped with simulated time, so that equal runs give equal bags whatever the load of the machine.
    def __init__(self, *, record: RunRecord, directory: Path, storage: Storage = DEFAULT_STORAGE) -> None:
        super().__init__("recorder", record=record)
        experiment = record.experiment
        # In the bag topics keep their own names, even if they are remapped: readers of bags look for these.
        self._root = self.get_namespace().rstrip("/") + "/"
        recorded = network_topics(experiment.agents, self._root, truth=experiment.truth, stop=record.until is not None)
        self._last = experiment.steps
        self._kinds = [StateReceiver(record, topics.STATES, topics.STATE, self._root)]
        if experiment.truth:
            self._kinds.append(StateReceiver(record, topics.TRUTHS, topics.TRUTH, self._root))
        self._newest = [np.full(experiment.agents, -1) for _ in self._kinds]  # steps of each kind that have come
        self._known_graph = -1  # last step of the newest holding period that has come
        self._next_holding = 0  # the first one that has not been written
        self._holding_periods: dict[int, int] = {}  # of those written after it: last step by number
        # Topics whose last message (last state, last holding period, experiment) has not arrived.
        self._awaiting = {topic.name for topic in recorded} - {self._root + topics.STOP.name}
        self._stopped = False  # whether it is known that the run ends early
        if record.until:
            self.subscribe(topics.STOP, self._record_stop)
        self.subscribe(topics.EXPERIMENT, self._record_experiment)
        self.subscribe(topics.GRAPH, self._record_graph)
        for kind in self._kinds:
            self.subscribe(kind.topic, self._collector(kind.add))
        self._reads_single = False  # also the agents' own topics
        self._unnamed_since: float | None = None  # since when a writer of states has had no name
        self._progress = self.publisher_of(topics.PROGRESS)
        self.finish_at_end()
        self.bag = BagWriter(directory, recorded, record=record.to_json(), storage=storage)
        every(self, WRITE_PERIOD, self._guarded(self._write_states))
        every(self, FLUSH_PERIOD, self._guarded(self.bag.flush))
        every(self, LOOK_PERIOD, self._look_for_others)

    def health(self) -> Health:
        """Number of recorded messages. One that has everything reports so again, as stalled agents do."""
        self._report_if_complete()
        values = {"messages": str(self.bag.messages), "topics without their last message": str(len(self._awaiting))}
        return Health(f"{self.bag.messages} messages recorded", values=values)

    def finish(self, *, complete: bool, deadline: float) -> None:  # noqa: ARG002
        """Close the bag; it is complete only if the recorder saw the end of the run."""
        self._guarded(self._write_states)()
        self.bag.close(complete=not self._awaiting)

    def _look_for_others(self) -> None:
        """Read the agents' own topics, too, as soon as another node publishes there: a player has no batches."""
        if self._reads_single:
            return
        for kind in self._kinds:
            name = kind.of.of(0)
            if self.count_publishers(name):
                names = {w.node_name for w in self.get_publishers_info_by_topic(self.resolve_topic_name(name))}
                if UNNAMED not in names:
                    self._unnamed_since = None
                elif self._unnamed_since is None:
                    self._unnamed_since = time.monotonic()
                nameless = self._unnamed_since is not None and time.monotonic() > self._unnamed_since + UNNAMED_TIME
                self._reads_single |= nameless or bool(names - {agent_node_name(0), UNNAMED})
        for kind in self._kinds if self._reads_single else ():
            for agent in range(self.record.experiment.agents):
                self.subscribe(kind.of, self._collector(partial(kind.add_single, agent)), agent=agent)

    def _collector(self, add: Callable[[bytes], int]) -> Callable[[bytes], None]:
        """The callback for a topic of states; ``add`` gives the number of bytes that wait."""
        write_states, size = self._guarded(self._write_states), write_size(self.record.experiment.agents)

        def collect(data: bytes) -> None:
            if add(data) >= size:
                write_states()

        return collect

    def _write_states(self) -> None:
        for kind, newest in zip(self._kinds, self._newest, strict=True):
            found = kind.take()
            for topic, reason in found.refused:
                self.refuse(reason, topic)
            if len(found.agent):
                self.bag.write_many(kind.names, found.agent, found.time, found.data, found.start, found.size)
            np.maximum.at(newest, found.agent, found.step)
            for agent in found.agent[found.step == self._last].tolist():
                self._received_last(kind.names[agent])

    def _record_graph(self, data: bytes) -> None:
        graph = self.accepted(self.rules.graph(data), topics.GRAPH)
        if graph is None:
            return
        if graph.sequence in self._holding_periods:
            self.refuse(Refusal.REPEATED, topics.GRAPH.name)
            return
        self._holding_periods[graph.sequence] = graph.last_step
        while self._next_holding in self._holding_periods:
            self.rules.forget(self._holding_periods.pop(self._next_holding) + 1)
            self._next_holding += 1
        until = self._step_clock.nanoseconds(graph.last_step + 1)
        self._known_graph = max(self._known_graph, graph.last_step)
        self._write(topics.GRAPH, data, graph.stamp, until, last=graph.last_step >= self._last - 1)

    def _record_stop(self, data: bytes) -> None:
        """The run ends early: what agents do after that step, before they know of it, is not awaited."""
        stop = self.decode_progress(data, topics.STOP)
        if stop is None:
            return
        if self._stopped:
            self.refuse(Refusal.REPEATED, topics.STOP.name)
            return
        self._guarded(self._write_states)()
        self._stopped, self._last = True, stop.step
        self._write(topics.STOP, data, stop.stamp, None, last=False)
        there = [self._root + topics.GRAPH.name] if self._known_graph >= self._last - 1 else []
        for kind, newest in zip(self._kinds, self._newest, strict=True):
            there += [kind.names[agent] for agent in np.flatnonzero(newest >= self._last).tolist()]
        self._awaiting.difference_update(there)
        self._report_if_complete()

    def _record_experiment(self, data: bytes) -> None:
        known = self._root + topics.EXPERIMENT.name not in self._awaiting
        reason = self.rules.experiment(data) or (Refusal.REPEATED if known else None)
        if reason:
            self.refuse(reason, topics.EXPERIMENT.name)
        else:
            self._write(topics.EXPERIMENT, data, 0, None, last=True)

    def _write(self, topic: Topic, data: bytes, time: int, until: int | None, *, last: bool) -> None:
        name = self._root + topic.name
        self._guarded(lambda: self.bag.write(name, data, time, until))()
        if last:
            self._received_last(name)

    def _guarded(self, action: Callable[[], None]) -> Callable[[], None]:
        def guarded() -> None:
            try:
                action()
            except BagError as error:
                self.fail(error)

        return guarded

    def _received_last(self, topic: str) -> None:
        if topic in self._awaiting:
            self._awaiting.remove(topic)
            self._report_if_complete()

    def _report_if_complete(self) -> None:
        if not self._awaiting:
            self.publish(self._progress, self.progress(topics.PROGRESS, NOT_AN_AGENT, self._last))


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, in which the next states are written (glibc; else no effect)."""
    # The C library would give it back after every write and ask for it again: a fifth of the recorder's CPU time.
    trim_threshold, mmap_threshold = -1, -3  # of <malloc.h>
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(trim_threshold, KEPT_MEMORY)
        ctypes.CDLL(None).mallopt(mmap_threshold, LARGEST_KEPT)


def write_size(agents: int) -> int:
    """Bytes of states after which the recorder of so many agents writes them."""
    return min(max(2**14 * agents, LEAST_WRITE), MOST_WRITE)
