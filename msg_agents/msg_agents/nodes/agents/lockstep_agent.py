"""The agent in lockstep: it makes a step as soon as it has all inputs of the step."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from msg_agents.nodes.agents.agent import NOT_FINITE, Agent
from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.network_node import state_topic, why_not
from msg_agents.stepping.synchronizer import WINDOW, Synchronizer
from msg_analysis.model.arithmetic.payload import all_finite
from msg_analysis.model.experiment.protocol_binding import ProtocolError
from msg_analysis.wire.messages import ActiveGraph


class LockstepAgent(Agent):
    """Connects topics, synchronizer and law; options as in Agent."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._turns = self._group.turns
        self._synchronizer: Synchronizer[bytes] = Synchronizer(
            agent=self._law.agent,
            steps=self.record.experiment.steps,
            inputs=self._inputs,
            peers=self._peers,
            start=self._law.step,
        )

    def begin(self) -> None:
        """See Agent."""
        super().begin()
        self._turns.join(self)

    def _ask_again(self) -> None:
        """Ask the peers in other processes for their states of the last WINDOW + 1 steps: none is further behind."""
        since = max(0, self._law.step - WINDOW - 1)
        for j in self._far:
            self._group.ask_again(j, since)

    def health(self) -> Health:
        """See NetworkNode. A stalled agent says what it waits for, and asks for it again from time to time."""
        step, pace = self._law.step, self._pace
        overdue = pace.look(step)
        values = {"step": str(step), "steps per second": f"{pace.rate:.1f}"}
        if self._synchronizer.finished:
            return Health("has made all steps", values=values)
        if not pace.stalled:
            return Health(f"at step {step}", values=values)
        waiting = self._synchronizer.waiting_for()
        if overdue and step == 0 and self.get_name() in self.namesakes():
            self._group.fail(self.clash([self.get_name()], pace.stalled))  # the others have started without this one
        elif overdue:
            self.get_logger().warning(f"no step for {pace.stalled:.0f} s at step {step}: waiting for {waiting}")
            self._ask_again()
        return Health(f"at step {step}, waiting for {waiting}", waiting=True, values=values | {"waiting for": waiting})

    def _receiver(self, peer: int) -> Callable[[bytes], None]:
        """The callback for a peer's states (hot path)."""
        unwrap = self._frame.unwrap
        offer = self._synchronizer.offer
        ready = self._synchronizer.ready
        ask = self._turns.ask
        topic, replicas = state_topic(peer), self.record.experiment.run.replicas

        def receive(data: bytes) -> None:
            frame = unwrap(data)
            if frame is None or frame[0] != peer + 1:
                self.refuse(why_not(data, self.record, peer, replicas), topic)
                return
            state = frame[3]
            reason = offer(peer, frame[1], state) if all_finite(state) else NOT_FINITE
            if reason:
                self.refuse(reason, topic)
            elif ready():
                ask(self)

        return receive

    def hear(self, peer: int, step: int, value: bytes) -> None:
        """See Agent."""
        if not self._synchronizer.offer(peer, step, value) and self._synchronizer.ready():
            self._turns.ask(self)

    def learn(self, graph: ActiveGraph) -> str | None:
        """See Agent."""
        reason = self._synchronizer.learn(graph.sequence, graph.mode - 1, graph.first_step, graph.last_step)
        if not reason and self._synchronizer.ready():
            self._turns.ask(self)
        return reason

    def advance(self) -> None:
        """Make every step that can be made."""
        try:
            self._advance()
        except ProtocolError as error:
            if not self.done.done():
                traceback.print_exception(error, file=sys.stderr)  # in full in the log of the process
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
