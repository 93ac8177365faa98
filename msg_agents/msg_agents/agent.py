"""The agent node: one row of the MJLS on topics."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import AgentState as AgentStateMsg
from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.publisher import Publisher

from msg_agents.checkpoint import Checkpoint
from msg_agents.health import Health, Pace
from msg_agents.node import (
    GRAPH_TOPIC,
    OTHER_RUN,
    PROGRESS_TOPIC,
    NetworkNode,
    agent_name,
    resend_topic,
    state_topic,
)
from msg_agents.qos import LATCHED, STREAM
from msg_agents.synchronizer import WINDOW, Synchronizer
from msg_analysis.bags.cdr import ActiveGraph, CdrError, StateCodec, StateFrame
from msg_analysis.errors import InputError
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
    checkpoints : directory that keeps what it has published, from which it goes on if it has been there before
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: StepModel,
        agent: int,
        readers: list[str],
        checkpoints: Path | None = None,
    ) -> None:
        super().__init__(agent_name(agent), record=record)
        experiment = record.experiment
        self._law = AgentLaw(record, model, agent)
        self._codec = StateCodec(self.run, agent + 1, experiment.run.replicas, experiment.step_length)
        self._frame = StateFrame(self.run, experiment.run.replicas)
        self._published = Checkpoint(checkpoints and checkpoints / f"{agent_name(agent)}.states", self._frame.size)
        self._take_over()
        listens = model.listens()
        self._peers = [j for j in range(model.agents) if listens[agent, j] or listens[j, agent]]
        self._synchronizer: Synchronizer[bytes] = Synchronizer(
            agent=agent,
            steps=experiment.steps,
            inputs=[self._law.neighbours(mode) for mode in range(model.modes)],
            peers=self._peers,
            start=self._law.step,
        )
        self._expected = [agent_name(j) for j in self._peers] + readers
        self._next_progress = 0.0
        self._pace = Pace()
        self._resend: dict[int, Publisher] = {}
        self._states = self.create_publisher(AgentStateMsg, state_topic(agent), STREAM)
        self._progress = self.create_publisher(ProgressMsg, PROGRESS_TOPIC, LATCHED)
        self.create_subscription(ActiveGraphMsg, GRAPH_TOPIC, self._receive_graph, LATCHED, raw=True)
        self.create_subscription(ProgressMsg, resend_topic(agent), self._receive_resend, LATCHED, raw=True)
        for j in self._peers:
            self.create_subscription(AgentStateMsg, state_topic(j), self._receiver(j), STREAM, raw=True)
        self.leave_at_end()

    def awaited(self) -> list[str]:
        """See NetworkNode."""
        return self.missing_readers(self._states, self._expected)

    def begin(self) -> None:
        """Publish x(0), or, after another process, all that may have been under way when that one went."""
        if self._law.step:
            for _, message in self._published.read():
                self.publish(self._states, message)
            self._ask_again()
        else:
            self._publish_state(0)
        self._report()
        self._advance()

    def _take_over(self) -> None:
        """Go on where a process before this one has been, if there was one."""
        published = self._published.read()
        if published:
            step, message = published[-1]
            frame = self._frame.unwrap(message)
            if frame is None or frame[:2] != (self._law.agent + 1, step):
                raise InputError(
                    f"--checkpoint: what is kept for {self.get_name()} is of another run than the run record: remove "
                    "it, or give another directory"
                )
            self._law.resume(step, frame[3])

    def _publish_state(self, mode: int) -> None:
        message = self._codec.wrap(self._law.step, mode, self._law.state)
        self._published.write(self._law.step, message)
        self.publish(self._states, message)

    def _ask_again(self) -> None:
        """Ask every peer for what it sent since the last step at which it can have been behind."""
        since = max(0, self._law.step - WINDOW - 1)
        for j in self._peers:
            if j not in self._resend:  # hardly ever needed; latched, so that it does not matter when it is matched
                self._resend[j] = self.create_publisher(ProgressMsg, resend_topic(j), LATCHED)
            self.publish(self._resend[j], self.progress(j + 1, since))

    def _receive_resend(self, data: bytes) -> None:
        request = self.decode_progress(data, resend_topic(self._law.agent))
        if request is not None and request.agent == self._law.agent + 1:
            for _, message in self._published.read(request.step):
                self.publish(self._states, message)

    def health(self) -> Health:
        """See NetworkNode. Whoever does not get on says what he waits for, and asks for it again."""
        step, pace = self._law.step, self._pace
        overdue = pace.look(step)
        values = {"step": str(step), "steps per second": f"{pace.rate:.1f}"}
        if self._synchronizer.finished:
            return Health("has made all steps", values=values)
        if not pace.stalled:
            return Health(f"at step {step}", values=values)
        waiting = self._synchronizer.waiting_for()
        if overdue:
            self.get_logger().warning(f"no step for {pace.stalled:.0f} s at step {step}: waiting for {waiting}")
            self._ask_again()
        return Health(f"at step {step}, waiting for {waiting}", waiting=True, values=values | {"waiting for": waiting})

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
            law.advance(mode, heard)
            synchronizer.advance()
            self._publish_state(mode + 1)
            if time.monotonic() >= self._next_progress or synchronizer.finished:
                self._report()

    def _report(self) -> None:
        self.publish(self._progress, self.progress(self._law.agent + 1, self._law.step))
        self._next_progress = time.monotonic() + PROGRESS_PERIOD
