"""The recorder node: writes every message of the run, unchanged, into an MCAP bag."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.network_node import NOT_AN_AGENT, NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.bags.format.storage_options import DEFAULT_STORAGE, Storage
from msg_analysis.bags.writer import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.model.arithmetic.payload import all_finite
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire import topics
from msg_analysis.wire.messages import ActiveGraph, decode_string, stamp_ns
from msg_analysis.wire.receiving import state_frame, why_refused
from msg_analysis.wire.refusals import Refusal
from msg_analysis.wire.topics import Topic, network_topics

RECORDED_FAULTS = {Refusal.WRONG_LENGTH, Refusal.OTHER_LAYOUT}
"""Faults of states that are recorded nevertheless: they belong to this run, and the reader of the bag reports them."""
BATCH = 16  # states collected before they are written: cheaper than one by one, and the core is not held for long
WRITE_PERIOD = 0.1  # s of wall time after which fewer are written, in slow runs and at the end
FLUSH_PERIOD = 1.0
"""s of wall time: a killed recorder loses at most so much, even if a chunk takes longer to fill."""


class Recorder(NetworkNode):
    """Records a run into ``directory`` (new or empty), and detects when the run is complete.

    Messages are stamped with simulated time, so that equal runs give equal bags whatever the load of the machine.
    """

    def __init__(self, *, record: RunRecord, directory: Path, storage: Storage = DEFAULT_STORAGE) -> None:
        super().__init__("recorder", record=record)
        experiment = record.experiment
        # In the bag topics keep their own names, even if they are remapped: readers of bags look for these.
        self._root = self.get_namespace().rstrip("/") + "/"
        recorded = network_topics(experiment.agents, self._root, truth=experiment.truth)
        self._last = experiment.steps
        kinds = [(topics.STATE, state_frame(record, whole=False))]
        if experiment.truth:
            kinds.append((topics.TRUTH, state_frame(record, whole=True)))
        self._sources = [  # of states: agent (from 0), topic in the bag, layout of its messages
            (agent, self._root + topic.of(agent), frame) for topic, frame in kinds for agent in range(experiment.agents)
        ]
        self._known: list[dict[int, int]] = [{} for _ in self._sources]  # step -> hash of what was written
        self._row = [-1] * len(self._sources)  # newest step up to which none is missing
        self._seen: set[bytes] = set()  # messages written, except for states
        self._pending: list[tuple[int, bytes]] = []  # source and bytes of states not yet written
        # Topics whose last message (last state, last sojourn, experiment) has not arrived.
        self._awaiting = {topic.name for topic in recorded}
        self.subscribe(topics.EXPERIMENT, self._record_experiment)
        self.subscribe(topics.GRAPH, self._record_graph)
        for kind, (topic, _) in enumerate(kinds):
            for agent in range(experiment.agents):
                self.subscribe(topic, self._collector(kind * experiment.agents + agent), agent=agent)
        self._progress = self.publisher_of(topics.PROGRESS)
        self.finish_at_end()
        self.bag = BagWriter(directory, recorded, record=record.to_json(), storage=storage)
        every(self, WRITE_PERIOD, self._guarded(self._write_states))
        every(self, FLUSH_PERIOD, self._guarded(self.bag.flush))

    def health(self) -> Health:
        """Number of recorded messages."""
        values = {"messages": str(self.bag.messages), "topics without their last message": str(len(self._awaiting))}
        return Health(f"{self.bag.messages} messages recorded", values=values)

    def finish(self, *, complete: bool, deadline: float) -> None:  # noqa: ARG002  an interrupted bag is closed just as well
        """Close the bag; it is complete only if the recorder saw the end of the run."""
        self._guarded(self._write_states)()
        self.bag.close(complete=not self._awaiting)

    def _collector(self, source: int) -> Callable[[bytes], None]:
        """The callback for one topic of states. Hot path."""
        pending, write_states = self._pending, self._guarded(self._write_states)

        def collect(data: bytes) -> None:
            pending.append((source, data))
            if len(pending) >= BATCH:
                write_states()

        return collect

    def _write_states(self) -> None:
        """Write the collected states, many at once: a fraction of the time of writing each on arrival."""
        write, last = self.bag.write, self._last
        for source, data in self._pending:
            agent, topic, layout = self._sources[source]
            frame = layout.unwrap(data)
            if frame is None or frame[0] != agent + 1:  # not what the agents of this run send: find out why
                reason = why_refused(data, self.record, agent, layout)
                self.refuse(reason, topic)
                if reason not in RECORDED_FAULTS:
                    continue
            elif refusal := self._refusal(source, frame[1], data):
                self.refuse(refusal, topic)
                continue
            write(topic, data, stamp_ns(data))
            if frame is not None and frame[1] == last and all_finite(frame[3]):
                self._received_last(topic)
        self._pending.clear()

    def _refusal(self, source: int, step: int, data: bytes) -> str | None:
        """Why a state is not written; None if it is.

        After a restart agents send states again, none older than ``RESEND_LIMIT`` steps. Of two different states of one
        step, one is forged: both are written, and the reader of the bag takes neither.
        """
        known, mark, row = self._known[source], hash(data), self._row[source]
        before = known.get(step)
        if before == mark:
            return Refusal.REPEATED
        if step > self._last:
            return Refusal.OUT_OF_RANGE
        if step < row - RESEND_LIMIT:
            return Refusal.TOO_OLD
        if 0 <= row < step - RESEND_LIMIT:
            return Refusal.TOO_NEW
        if before is not None:
            self.refuse(Refusal.CONTRADICTION, self._sources[source][1])
        if step == row + 1:
            self._row[source] = step
        known[step] = mark
        if len(known) > 2 * RESEND_LIMIT:
            self._known[source] = {k: v for k, v in known.items() if k > step - RESEND_LIMIT}
        return None

    def _record_graph(self, data: bytes) -> None:
        graph = self.decode(ActiveGraph, data, topics.GRAPH)
        if graph:
            self._write(topics.GRAPH, data, graph.stamp, last=graph.last_step == self._last - 1)

    def _record_experiment(self, data: bytes) -> None:
        try:
            run = json.loads(decode_string(data))["run"]
        except (ValueError, KeyError, TypeError):  # CdrError and JSON's own among them
            run = None
        if run == str(self.record.run):
            self._write(topics.EXPERIMENT, data, 0, last=True)
        else:
            self.refuse(Refusal.OTHER_RUN, topics.EXPERIMENT.name)

    def _write(self, topic: Topic, data: bytes, time: int, *, last: bool) -> None:
        if data in self._seen:
            self.refuse(Refusal.REPEATED, topic.name)
            return
        self._seen.add(data)
        name = self._root + topic.name
        self._guarded(lambda: self.bag.write(name, data, time))()
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
            if not self._awaiting:
                self.publish(self._progress, self.progress(NOT_AN_AGENT, self._last))
