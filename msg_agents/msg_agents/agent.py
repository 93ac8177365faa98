"""The agent node: one row of the MJLS on topics."""

from __future__ import annotations

import time
from collections.abc import Callable

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import AgentState as AgentStateMsg
from msg_agents_interfaces.msg import Progress as ProgressMsg

from msg_agents.node import GRAPH_TOPIC, OTHER_RUN, PROGRESS_TOPIC, NetworkNode, agent_name, state_topic
from msg_agents.qos import LATCHED, STREAM
from msg_agents.synchronizer import Synchronizer
from msg_analysis.bags.cdr import ActiveGraph, CdrError, StateCodec, StateFrame
from msg_analysis.model.agent import AgentLaw
from msg_analysis.model.payload import all_finite
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import StepModel

PROGRESS_PERIOD = 0.2  # s of wall time between two Progress messages
NOT_FINITE = "a state that is not finite"


class Agent(NetworkNode):
    """Moves numbers between topics, the synchronizer and the law.

    Parameters
    ----------
    record : of the run
    model : its step model
    agent : index from 0
    readers : names of the nodes, besides the other agents, that must read the states before the run starts
    """

    def __init__(self, *, record: RunRecord, model: StepModel, agent: int, readers: list[str]) -> None:
        super().__init__(agent_name(agent), record=record)
        experiment = record.experiment
        self._law = AgentLaw(record, model, agent)
        listens = model.listens()
        peers = [j for j in range(model.agents) if listens[agent, j] or listens[j, agent]]
        self._synchronizer: Synchronizer[bytes] = Synchronizer(
            agent=agent,
            steps=experiment.steps,
            inputs=[self._law.neighbours(mode) for mode in range(model.modes)],
            peers=peers,
        )
        self._codec = StateCodec(self.run, agent + 1, experiment.run.replicas, experiment.step_length)
        self._frame = StateFrame(self.run, experiment.run.replicas)
        self._expected = [agent_name(j) for j in peers] + readers
        self._next_progress = 0.0
        self._states = self.create_publisher(AgentStateMsg, state_topic(agent), STREAM)
        self._progress = self.create_publisher(ProgressMsg, PROGRESS_TOPIC, LATCHED)
        self.create_subscription(ActiveGraphMsg, GRAPH_TOPIC, self._receive_graph, LATCHED, raw=True)
        for j in peers:
            self.create_subscription(AgentStateMsg, state_topic(j), self._receiver(j), STREAM, raw=True)
        self.leave_at_end()

    def awaited(self) -> list[str]:
        """See NetworkNode."""
        return self.missing_readers(self._states, self._expected)

    def begin(self) -> None:
        """Publish x(0)."""
        self.publish(self._states, self._codec.wrap(0, 0, self._law.state))
        self._report()
        self._advance()

    def _receiver(self, peer: int) -> Callable[[bytes], None]:
        """The callback for one peer's states: this is the hot path."""
        unwrap = self._frame.unwrap
        offer = self._synchronizer.offer
        ready = self._synchronizer.ready
        topic = state_topic(peer)

        def receive(data: bytes) -> None:
            frame = unwrap(data)
            if frame is None or frame[0] != peer + 1:
                self.refuse(OTHER_RUN, topic)
                return
            state = frame[3]
            reason = offer(peer, frame[1], state) if all_finite(state) else NOT_FINITE
            if reason:
                self.refuse(reason, topic)
            elif ready():
                self._advance()

        return receive

    def _receive_graph(self, data: bytes) -> None:
        try:
            graph = ActiveGraph.decode(data)
        except CdrError as error:
            self.refuse(str(error), GRAPH_TOPIC)
            return
        if graph.run != self.run:
            self.refuse(OTHER_RUN, GRAPH_TOPIC)
            return
        reason = self._synchronizer.learn(graph.sequence, graph.mode - 1, graph.first_step, graph.last_step)
        if reason:
            self.refuse(reason, GRAPH_TOPIC)
        else:
            self._advance()

    def _advance(self) -> None:
        """Make every step that can be made."""
        synchronizer, law = self._synchronizer, self._law
        while synchronizer.ready():
            mode, heard = synchronizer.inputs()
            state = law.advance(mode, heard)
            synchronizer.advance()
            self.publish(self._states, self._codec.wrap(law.step, mode + 1, state))
            if time.monotonic() >= self._next_progress or synchronizer.finished:
                self._report()

    def _report(self) -> None:
        self.publish(self._progress, self.progress(self._law.agent + 1, self._law.step))
        self._next_progress = time.monotonic() + PROGRESS_PERIOD
