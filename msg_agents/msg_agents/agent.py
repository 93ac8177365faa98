"""The agent node: one row of the MJLS on topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msg_agents_interfaces.msg import AgentState as AgentStateMsg
from rclpy.publisher import Publisher

from msg_agents.checkpoint import Checkpoint
from msg_agents.health import Health, Pace
from msg_agents.network import RECORDER
from msg_agents.node import OTHER_RUN, NetworkNode, agent_name, longest_heard, state_topic, truth_topic
from msg_agents.qos import STREAM
from msg_agents.synchronizer import WINDOW, Synchronizer
from msg_analysis.bags.cdr import ActiveGraph, StateCodec, StateFrame, with_state
from msg_analysis.errors import InputError
from msg_analysis.model.agent import agent_law
from msg_analysis.model.payload import all_finite
from msg_analysis.model.protocols import ProtocolError
from msg_analysis.model.record import RunRecord
from msg_analysis.model.step import Wiring

if TYPE_CHECKING:
    from msg_agents.group import AgentGroup

NOT_FINITE = "a state that is not finite"


class Agent(NetworkNode):
    """Moves numbers between topics, the synchronizer and the law.

    Others hear ``state``. Where that is not the whole truth, because of broadcast noise or a protocol that keeps
    something to itself, the truth goes to ``truth``, for the log.

    Parameters
    ----------
    record : of the run
    model : its step model, or wiring
    agent : index from 0
    peers : every other agent that it hears or is heard by, ascending
    colleagues : the agents of its process, itself included
    readers : names of the nodes, besides the other agents, that must read the states before the run starts
    checkpoints : directory that keeps what it has published, from which it goes on if it has been there before
    group : to which it belongs
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        agent: int,
        peers: Sequence[int],
        colleagues: Collection[int],
        readers: Sequence[str],
        checkpoints: Path | None,
        group: AgentGroup,
    ) -> None:
        super().__init__(agent_name(agent), record=record)
        experiment = record.experiment
        self._law = agent_law(record, model, agent)
        self._codec = StateCodec(self.run, agent + 1, experiment.width, experiment.step_length)
        self._frame = StateFrame(self.run, experiment.run.replicas, longest_heard(record))
        self._whole = StateFrame(self.run, experiment.width, longest_heard(record))
        self._published = Checkpoint(checkpoints and checkpoints / f"{agent_name(agent)}.states", self._whole.size)
        self._take_over()
        self._group = group
        self._turns = group.turns
        self._synchronizer: Synchronizer[bytes] = Synchronizer(
            agent=agent,
            steps=experiment.steps,
            inputs=[self._law.neighbours(mode) for mode in range(model.modes)],
            peers=peers,
            start=self._law.step,
        )
        near = set(peers).intersection(colleagues)
        self._far = [j for j in peers if j not in near]
        self._near = [j for j in peers if j in near]
        self._listeners: list[Callable[[int, int, bytes], None]] = []
        self._expected = [*map(agent_name, self._far), *readers]
        self._next_progress = 0.0
        self._pace = Pace()
        self._states = self.create_publisher(AgentStateMsg, state_topic(agent), STREAM)
        self._truth: Publisher | None = None
        if experiment.truth:
            self._truth = self.create_publisher(AgentStateMsg, truth_topic(agent), STREAM)
            self._awaits_truth = [name for name in readers if name == RECORDER]  # others may do with what all hear
        for j in self._far:
            self.create_subscription(AgentStateMsg, state_topic(j), self._receiver(j), STREAM, raw=True)

    def meet(self, colleagues: Mapping[int, Agent]) -> None:
        """Get to know the agents of the same process, by index, so as to hand them the state directly."""
        self._listeners = [colleagues[j].hear for j in self._near]

    def found(self) -> bool:
        """See NetworkNode."""
        return self.has_readers(self._states, self._expected) and (
            self._truth is None or self.has_readers(self._truth, self._awaits_truth)
        )

    def awaited(self) -> list[str]:
        """See NetworkNode."""
        missing = self.missing_readers(self._states, self._expected)
        if self._truth is not None:
            missing += self.missing_readers(self._truth, self._awaits_truth)
        return missing

    def begin(self) -> None:
        """Publish x(0), or, after another process, all that may have been under way when that one went."""
        if self._law.step:
            self.send_again(0)
            self._ask_again()
        else:
            self._publish_state(0)
        self._report()
        self._turns.join(self)

    def _take_over(self) -> None:
        """Go on where a process before this one has been, if there was one."""
        published = self._published.read()
        if published:
            step, message = published[-1]
            frame = self._whole.unwrap(message)
            if frame is None or frame[:2] != (self._law.agent + 1, step):
                raise InputError(
                    f"--checkpoint: what is kept for {self.get_name()} is of another run than the run record: remove "
                    "it, or give another directory"
                )
            self._law.resume(step, frame[3])

    def _publish_state(self, mode: int) -> None:
        law = self._law
        message = self._codec.wrap(law.step, mode, law.state, law.heard)
        self._published.write(law.step, message)
        self._send(law.step, law.state, message)

    def _send(self, step: int, state: bytes, message: bytes) -> None:
        """Send a state: as it is, for the log, and as others hear it."""
        if self._truth is not None:
            self.publish(self._truth, message)
            whole, state = state, self._law.published(step, state)
            message = with_state(message, state, len(whole))
        self.publish(self._states, message)
        for hear in self._listeners:
            hear(self._law.agent, step, state)

    def send_again(self, since: int) -> None:
        """Send what was sent from a step on, as far as it is kept: the truth, from which follows what others hear."""
        for step, message in self._published.read(since):
            frame = self._whole.unwrap(message)
            assert frame is not None, "of our own making"
            self._send(step, frame[3], message)

    def _ask_again(self) -> None:
        """Ask every peer of another process for what it sent since the last step at which it can have been behind."""
        since = max(0, self._law.step - WINDOW - 1)
        for j in self._far:
            self._group.ask_again(j, since)

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
        ask = self._turns.ask
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
                ask(self)

        return receive

    def hear(self, peer: int, step: int, state: bytes) -> None:
        """Take x_peer(step) from an agent of the same process."""
        if not self._synchronizer.offer(peer, step, state) and self._synchronizer.ready():
            self._turns.ask(self)

    def learn(self, graph: ActiveGraph) -> str | None:
        """Take note of a sojourn; None, or why not."""
        reason = self._synchronizer.learn(graph.sequence, graph.mode - 1, graph.first_step, graph.last_step)
        if not reason and self._synchronizer.ready():
            self._turns.ask(self)
        return reason

    def advance(self) -> None:
        """Make every step that can be made."""
        try:
            self._advance()
        except ProtocolError as error:
            self._group.fail(error)

    def _advance(self) -> None:
        synchronizer, law = self._synchronizer, self._law
        while synchronizer.ready():
            mode, heard = synchronizer.inputs()
            law.advance(mode, heard)
            synchronizer.advance()
            self._publish_state(mode + 1)
            if time.monotonic() >= self._next_progress or synchronizer.finished:
                self._report()

    def _report(self) -> None:
        self._group.report(self._law.agent, self._law.step)
        self._next_progress = time.monotonic() + self._group.progress_period
