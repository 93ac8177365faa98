"""The recorder node: every message of the run, as it came, into an MCAP bag."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import AgentState as AgentStateMsg
from std_msgs.msg import String

from msg_agents.node import EXPERIMENT_TOPIC, GRAPH_TOPIC, NetworkNode, state_topic
from msg_agents.qos import LOSSLESS
from msg_analysis.bags.cdr import ActiveGraph, CdrError, StateFrame, stamp_ns
from msg_analysis.bags.schemas import network_topics
from msg_analysis.bags.writer import BagWriter
from msg_analysis.errors import BagError
from msg_analysis.model.record import RunRecord

FLUSH_PERIOD = 1.0
"""s of wall time. What a killed recorder loses at most, where a chunk takes longer to fill."""


class Recorder(NetworkNode):
    """Records a run and knows when it has all of it.

    Messages are stamped with simulated time, so that equal runs give equal bags whatever the machine was doing.

    Parameters
    ----------
    record : of the run
    directory : of the bag; must not exist
    """

    def __init__(self, *, record: RunRecord, directory: Path) -> None:
        super().__init__("recorder", record=record)
        experiment = record.experiment
        topics = network_topics(experiment.agents, self.get_namespace())
        self.bag = BagWriter(directory, topics, record=record.to_json())
        self._last = experiment.steps
        self._frame = StateFrame(self.run, experiment.run.replicas)
        self._awaiting = experiment.agents + 2  # last states, last sojourn, experiment
        self.create_subscription(String, EXPERIMENT_TOPIC, self._record_experiment, LOSSLESS, raw=True)
        self.create_subscription(ActiveGraphMsg, GRAPH_TOPIC, self._record_graph, LOSSLESS, raw=True)
        for agent in range(experiment.agents):
            self.create_subscription(
                AgentStateMsg, state_topic(agent), self._recorder(agent), LOSSLESS, raw=True
            )
        self.create_timer(FLUSH_PERIOD, self._guarded(self.bag.flush))

    def finish(self, *, complete: bool) -> None:  # noqa: ARG002  an interrupted bag is closed just as well
        """Close the bag: it is complete only if the recorder saw the end of the run."""
        self.bag.close(complete=self._awaiting == 0)

    def _recorder(self, agent: int) -> Callable[[bytes], None]:
        """The callback for one agent's states: this is the hot path."""
        topic = self.resolve_topic_name(state_topic(agent))
        write = self.bag.write
        last = struct.pack("<Q", self._last)
        frame_size = self._frame.size

        def record(data: bytes) -> None:
            try:
                write(topic, data, stamp_ns(data))
            except (BagError, CdrError) as error:
                self.fail(error)
                return
            # Bytes 44..52 of the agents' own layout are the step.
            if data[44:52] == last and len(data) == frame_size:
                self._came()

        return record

    def _record_graph(self, data: bytes) -> None:
        self._write(GRAPH_TOPIC, data, stamp_ns(data))
        if ActiveGraph.decode(data).last_step == self._last - 1:
            self._came()

    def _record_experiment(self, data: bytes) -> None:
        self._write(EXPERIMENT_TOPIC, data, 0)
        self._came()

    def _write(self, topic: str, data: bytes, time: int) -> None:
        self._guarded(lambda: self.bag.write(self.resolve_topic_name(topic), data, time))()

    def _guarded(self, action: Callable[[], None]) -> Callable[[], None]:
        def guarded() -> None:
            try:
                action()
            except BagError as error:
                self.fail(error)

        return guarded

    def _came(self) -> None:
        self._awaiting -= 1
        if self._awaiting == 0 and not self.done.done():
            self.done.set_result(None)
