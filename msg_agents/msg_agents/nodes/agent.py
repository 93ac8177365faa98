# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The agent node: one row of the MJLS on topics. What depends on the pace: ``paced_agents``."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from msg_agents.nodes.base import NetworkNode
from msg_agents.nodes.ros import after, state_messages
from msg_agents.process_layout import RECORDER
from msg_agents.recovery import Checkpoint, entry_size, published_size
from msg_agents.stepping.monitoring import StallDetector
from msg_agents.stepping.synchronizer import AgentInputs
from msg_analysis.arithmetic.update_law import from_payload
from msg_analysis.errors import InputError
from msg_analysis.experiment.protocols import ProtocolError
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import state_frame, state_receiver
from msg_analysis.messages.messages import ActiveGraph, StateCodec, with_state
from msg_analysis.messages.topics import Qos, agent_node_name
from msg_analysis.model.reception import AgentAir
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring

if TYPE_CHECKING:
    from msg_agents.nodes.agent_group import AgentGroup

RETURN_TIME = 2.0  # s for which states are not repeated yet, because a reader is missing
RETURN_POLL = 0.02  # s
PASSIVE_GRACE = 0.3  # s that a reader with best effort has for the last state before its writer leaves
ANSWER_PERIOD = 0.5  # s between two repetitions of states for peers


class StepLaw(Protocol):
    """What an agent does in a step: an ``AgentLaw``, or what a user has written."""

    agent: int  # index from 0
    step: int
    state: bytes
    heard: tuple[int, ...]

    @property
    def air(self) -> AgentAir | None:
        """See AgentLaw."""

    def resume(self, step: int, state: bytes) -> None:
        """See AgentLaw."""

    def neighbours(self, mode: int) -> list[int]:
        """See AgentLaw."""

    def published(self, step: int, state: bytes) -> bytes:
        """See AgentLaw."""

    def advance(self, mode: int, heard: list[bytes], steps: Sequence[int] | None = None) -> bytes:
        """See AgentLaw."""


class Program(Protocol):
    """A program of a user around an agent."""

    def missing(self) -> list[str]:
        """What must be there before the run starts, beside its nodes."""

    def started(self, first: int) -> None:
        """In real time: the first step is due when the clock of the node says ``first`` [ns]."""

    def waiting_for(self) -> str | None:
        """What it lacks in the middle of the run, in words."""


class Agent(NetworkNode):
    """Connects topics and law; the subclass for the pace decides when to step and with which inputs."""

    # Other agents read ``state``. Where that is not the exact state (broadcast noise, or a protocol that publishes only
    # a part of it), the exact one is published on ``truth``, for the log and the live node.
    state_qos: Qos | None = None  # of its subscriptions to the states of others; None: that of the topic
    reads_batches = False  # whether it may receive them in the batches of their processes instead
    values: AgentInputs[Any]  # what it has received and what its next step uses, as the pace wants it

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        law: StepLaw,
        peers: Sequence[int],  # every other agent that it exchanges states with at any time, ascending
        local_agents: Collection[int],  # agents of its process, itself included
        readers: Sequence[str],  # other nodes that must read the states before the run starts
        checkpoints: Path | None,  # directory of the published states, from which it resumes after a restart
        group: AgentGroup,
        program: Program | None = None,
    ) -> None:
        agent = law.agent
        super().__init__(agent_node_name(agent), record=record)
        experiment = record.experiment
        self._law = law
        self._last = experiment.steps
        self._codec = StateCodec(self.run, agent + 1, experiment.width, experiment.step_length)
        self._frame = state_frame(record, whole=False)
        self._whole = state_frame(record, whole=True)
        self._beside = published_size(record)
        self._published = Checkpoint(
            checkpoints and checkpoints / f"{agent_node_name(agent)}.states", entry_size(record)
        )
        self._resumed = self._take_over()
        self._group = group
        self._program = program
        self._inputs = [self._law.neighbours(mode) for mode in range(model.modes)]
        self._peers = list(peers)
        self._options: dict[str, Any] = {
            "agent": agent,
            "steps": experiment.steps,
            "inputs": self._inputs,
            "peers": self._peers,
            "start": self._law.step,
        }
        local = set(peers).intersection(local_agents)
        self.remote = [j for j in peers if j not in local]
        self._local = [j for j in peers if j in local]
        self._listeners: list[Callable[[int, int, int, bytes, bytes], str | None]] = []
        self._peer_names = list(map(agent_node_name, self.remote))
        # The recorder reads the batches of the process instead, and in the middle of a run none of these is awaited.
        self._others = [name for name in readers if name != RECORDER and self._resumed is None]
        self._next_progress = 0.0
        self._reported = -1  # step of the last report
        self._stall = StallDetector()
        self._remote_states: list[Subscription] = []
        self._last_sent = 0.0  # time at which the last state was sent [s of the monotonic clock]
        self._repeat_from: int | None = None  # step from which on states are to be repeated
        self._answered = -ANSWER_PERIOD  # time at which they were repeated last [s of the monotonic clock]
        self._states = self.publisher_of(topics.STATE, agent)
        self._exact: Publisher | None = self.publisher_of(topics.TRUTH, agent) if experiment.truth else None
        self._pose: Callable[[float], None] | None = None
        if experiment.run.publish:
            poses, (_, pose) = self.publisher_of(topics.POSE, agent), state_messages(self, "pose", experiment.run.frame)
            self._pose = lambda x: poses.publish(pose(x))

    @property
    def number(self) -> int:
        """Its number, from 1."""
        return self._law.agent + 1

    def connect(self, local_agents: Mapping[int, Agent]) -> None:
        """Connect to the peers in this process (by index) by direct calls."""
        self._listeners = [local_agents[j].receive for j in self._local]

    def subscribe_to_remote(self) -> None:
        """Connect to the peers in other processes by their topics."""
        for j in self.remote:
            refuse = partial(self.refuse, topic=topics.STATE.of(j))
            take = state_receiver(self.record, j, self._frame, self.receive, refuse, possible=True)
            self._remote_states.append(self.subscribe(topics.STATE, take, agent=j, qos=self.state_qos))

    def create_shared(self, agents: Sequence[Agent]) -> None:
        """Create what a process needs only once. Called on its first agent, with all its agents."""

    def discovered_all(self) -> bool:
        """See NetworkNode. One that comes back will ask for messages at once, so it must be ready for them."""
        if self.resumed and not (
            all(states.get_publisher_count() for states in self._remote_states)
            and self._group.links.batches_discovered()
        ):
            return False
        expected = self._awaited() + self._others
        there = self.has_readers(self._states, expected) and not self._group.missing_recorder()
        return there and not (self._program and self._program.missing())

    def missing_nodes(self) -> list[str]:
        """See NetworkNode."""
        missing = self.missing_readers(self._states, self._awaited() + self._others) + self._group.missing_recorder()
        return missing + (self._program.missing() if self._program else [])

    def _awaited(self) -> list[str]:
        """Names of the peers that must read its topic: not those that its batches reach."""
        reached = self._group.links.reached()
        return [name for name in self._peer_names if name not in reached] if reached else self._peer_names

    def finish(self, *, complete: bool, deadline: float) -> None:
        """See NetworkNode. After a complete part, it waits only for readers outside the run: the others have all."""
        self._group.send_batches()
        if not complete and self.context.ok():  # it has failed: its last states show how
            self._group.wait_for_recorder(deadline)
        for writer in (self._states, self._exact) if complete else ():
            if writer is None:
                continue
            if self.has_other_readers(writer):
                writer.wait_for_all_acked(Duration(seconds=max(0.0, deadline - time.monotonic())))
            if self.has_other_readers(writer, reliable=False):  # it forgets what comes after the news that we have left
                time.sleep(max(0.0, min(deadline, self._last_sent + PASSIVE_GRACE) - time.monotonic()))

    def begin(self) -> None:
        """Publish x(0); after a takeover, repeat what others may have missed, and ask the peers to repeat theirs."""
        if self._published.found:
            # All stored states, for the recorder and for readers outside the run; peers have what is older.
            self._repeat(0, peers_since=0 if self.has_other_readers(self._states) else self._first_missed())
            self._request_states(self.remote)
        if not self._law.step:
            self._publish_state(0)
        self._report()

    def rejoin(self) -> bool:
        """See NetworkNode. All stored states go to the recorder again, and what peers may lack to them."""
        if self._group.missing_recorder():
            return False
        self._repeat(0, peers_since=self._first_missed())
        self._request_states(self.remote)
        return True

    def _take_over(self) -> bytes | None:
        """Resume from the last state that an earlier process published; its message, or None without one."""
        if not self._published.found or not (published := self._published.read()):
            return None
        step, entry = published[-1]
        message, _ = self._parts(entry)
        frame = self._whole.unwrap(message)
        if frame is None or frame[:2] != (self._law.agent + 1, step):
            raise InputError(
                f"--checkpoint: the file of {self.get_name()} belongs to another run: remove it, or "
                "give another directory"
            )
        self._law.resume(step, frame[3])
        return message

    def _publish_state(self, mode: int) -> None:
        law = self._law
        self._store_and_send(mode, self._codec.wrap(law.step, mode, law.state, law.heard))

    def _store_and_send(self, mode: int, message: bytes) -> None:
        """Publish the newest state, when it is in the checkpoint."""
        law = self._law
        value = law.published(law.step, law.state) if self._exact is not None else b""
        self._published.write(law.step, message + value)
        self._send(law.step, mode, law.state, message, value)
        if self._pose is not None:
            self._pose(float(from_payload(value or law.state)[0]))

    def _parts(self, entry: bytes) -> tuple[bytes, bytes]:
        """An entry of the checkpoint: the message, and what is published of its state if that is not the state."""
        length = len(entry) - self._beside
        return entry[:length], entry[length:]

    def _send(self, step: int, mode: int, state: bytes, message: bytes, value: bytes, *, to_peers: bool = True) -> None:
        """Publish a state as others receive it, and the exact one; without ``to_peers``, to the recorder only."""
        if self._exact is not None:
            if to_peers:
                self.publish(self._exact, message)
            assert self._group.exact_states is not None
            self._group.exact_states.add(message)
            message, state = with_state(message, value, len(state)), value
        if to_peers:
            self.publish(self._states, message)
        self._group.states.add(message)
        for receive in self._listeners if to_peers else ():
            receive(self._law.agent, step, mode, state, message)
        if step == self._last:
            self._last_sent = time.monotonic()
            self._group.send_batches()

    @property
    def resumed(self) -> bool:
        """See NetworkNode. It goes on from a state that an earlier process published."""
        return self._resumed is not None

    def resend(self, since: int) -> None:
        """Repeat the states from step ``since`` on for a peer that may have missed them, once all readers are there."""
        # One that has come back, and asks, may not have been matched yet. Requests are latched, and may be old.
        since = max(since, self._first_missed())
        if self._repeat_from is not None:  # in a dense network after a stall, many ask: they are answered together
            self._repeat_from = min(self._repeat_from, since)
            return
        self._repeat_from = since
        self._repeat_when_ready(time.monotonic() + RETURN_TIME)

    def _repeat_when_ready(self, deadline: float) -> None:
        now = time.monotonic()
        too_soon = now < self._answered + ANSWER_PERIOD
        if too_soon or (now < deadline and not self.has_readers(self._states, self._awaited())):
            after(self, RETURN_POLL, partial(self._repeat_when_ready, deadline))
            return
        self._answered = now
        since, self._repeat_from = self._repeat_from, None
        assert since is not None
        self._repeat(since)

    def _repeat(self, since: int, peers_since: int = 0) -> None:
        """Repeat the stored states from step ``since`` on; those before ``peers_since`` go to the recorder only."""
        for step, entry in self._published.read(since):
            message, value = self._parts(entry)
            frame = self._whole.unwrap(message)
            assert frame is not None, "written by this software"
            self._send(step, frame[2], frame[3], message, value, to_peers=step >= peers_since)
        self._group.send_batches()

    def _request_states(self, agents: Sequence[int]) -> None:
        """Ask those of these agents that are in other processes for states that may have been missed."""
        for j in agents:
            if j not in self._local:
                self._group.request_states(j, self._first_missed())

    def _first_missed(self) -> int:
        """The first step whose state a peer may still need after a restart, of this agent or of itself."""
        raise NotImplementedError

    def receive(self, peer: int, step: int, mode: int, state: bytes, message: bytes) -> str | None:
        """Take x_peer(step), from a topic or a direct call; the reason if refused, else None. ``peer``: from 0."""
        raise NotImplementedError

    def learn(self, graph: ActiveGraph) -> str | None:
        """Take a holding period of the graph; the reason if it is refused, else None."""
        raise NotImplementedError

    def end_at(self, step: int) -> None:
        """Make no step after this one: the run ends early. An agent that is beyond it stays where it is."""
        self._last = max(step, self._law.step)
        self.values.end_at(self._last)
        if self._law.step >= step:
            self._last_sent = time.monotonic()
            self._group.send_batches()
            self._report()

    def advance(self) -> None:
        """Make every step that can be made now; a protocol that fails ends the run."""
        try:
            self._make_steps()
        except ProtocolError as error:
            if not self.done.done():
                traceback.print_exception(error, file=sys.stderr)  # in full in the log of the process
            self._group.fail(error)

    def _make_steps(self) -> None:
        raise NotImplementedError

    def _report(self) -> None:
        self._reported = self._law.step
        self._group.report(self._law.agent, self._reported)
        self._next_progress = time.monotonic() + self._group.progress_period

    def _report_if_due(self) -> None:
        """Report, unless that was just done; once more where nothing is new."""
        # In one of some 600 networks of 90 processes, the switcher was not given the last reports of four.
        if time.monotonic() >= self._next_progress:
            self._report()
