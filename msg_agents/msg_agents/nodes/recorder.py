"""The recorder node: writes every message of the run, unchanged, into an MCAP bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.network_node import NOT_AN_AGENT, NetworkNode
from msg_agents.nodes.ros.timers import every
from msg_agents.stepping.received_steps import ReceivedSteps
from msg_analysis.bags.format.storage_options import DEFAULT_STORAGE, Storage
from msg_analysis.bags.writer import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.model.run.record import RunRecord
from msg_analysis.wire import topics
from msg_analysis.wire.messages import stamp_ns
from msg_analysis.wire.receiving import fault_of, state_frame, why_refused
from msg_analysis.wire.refusals import Refusal
from msg_analysis.wire.topics import Topic, network_topics

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
        self._last, self._graphs = experiment.steps, len(experiment.graph_list)
        kinds = [(topics.STATE, state_frame(record, whole=False))]
        if experiment.truth:
            kinds.append((topics.TRUTH, state_frame(record, whole=True)))
        self._sources = [  # of states: agent (from 0), topic in the bag, layout of its messages
            (agent, self._root + topic.of(agent), frame) for topic, frame in kinds for agent in range(experiment.agents)
        ]
        self._received = [ReceivedSteps(experiment.steps) for _ in self._sources]
        self._next_sojourn = 0  # the first one that has not been written
        self._sojourns: dict[int, int] = {}  # of those written after it: last step by number
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
        write, last, received = self.bag.write, self._last, self._received
        for source, data in self._pending:
            agent, topic, layout = self._sources[source]
            frame = layout.unwrap(data)
            if frame is None or frame[0] != agent + 1:  # not what the agents of this run send: find out why
                self.refuse(why_refused(data, self.record, agent, layout), topic)
                continue
            step, mode, state = frame[1:]
            if refusal := fault_of(step, mode, state, self._graphs) or received[source].take(step, hash(data)):
                self.refuse(refusal, topic)
                if refusal != Refusal.CONTRADICTION:  # one of the two is forged: the reader of the bag takes neither
                    continue
            write(topic, data, max(0, stamp_ns(data)))
            if step == last:
                self._received_last(topic)
        self._pending.clear()

    def _record_graph(self, data: bytes) -> None:
        graph = self.decode_graph(data)
        if graph is None:
            return
        if graph.sequence in self._sojourns:
            self.refuse(Refusal.REPEATED, topics.GRAPH.name)
            return
        self._sojourns[graph.sequence] = graph.last_step
        while self._next_sojourn in self._sojourns:
            self.rules.forget(self._sojourns.pop(self._next_sojourn) + 1)
            self._next_sojourn += 1
        self._write(topics.GRAPH, data, graph.stamp, last=graph.last_step == self._last - 1)

    def _record_experiment(self, data: bytes) -> None:
        known = self._root + topics.EXPERIMENT.name not in self._awaiting
        reason = self.rules.experiment(data) or (Refusal.REPEATED if known else None)
        if reason:
            self.refuse(reason, topics.EXPERIMENT.name)
        else:
            self._write(topics.EXPERIMENT, data, 0, last=True)

    def _write(self, topic: Topic, data: bytes, time: int, *, last: bool) -> None:
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
                self.publish(self._progress, self.progress(topics.PROGRESS, NOT_AN_AGENT, self._last))
