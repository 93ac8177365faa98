# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The agent in lockstep: it makes a step as soon as it has all inputs of the step."""

from __future__ import annotations

import time
from typing import Any

from msg_agents.nodes.agent import Agent
from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.ros import after
from msg_agents.stepping.state_receiver import DelayedSynchronizer
from msg_agents.stepping.synchronizer import LOCKSTEP_WINDOW, Synchronizer
from msg_analysis.errors import InputError
from msg_analysis.experiment.protocols import ProtocolError
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.messages import ActiveGraph
from msg_analysis.model.reception import AgentAir


class LockstepAgent(Agent):
    """Connects topics, synchronizer and law; options as in Agent."""

    reads_batches = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._turns = self._group.turns
        self._will_report = False  # whether ``_report_later`` will be called
        air, options = self._law.air, self._options()
        self._synchronizer: Synchronizer[bytes]
        if air and air.looks_back:
            self._require_kept_values(air)
            self._synchronizer = DelayedSynchronizer(needed=air.needed, delay=air.delay, **options)
        else:
            self._synchronizer = Synchronizer(**options)

    def _require_kept_values(self, air: AgentAir) -> None:
        """InputError if the agent comes back, and its peers have no longer a value that it was holding."""
        step, kept = self._law.step, self._published.capacity - 2 * LOCKSTEP_WINDOW  # they may be behind, or ahead
        oldest = min((air.needed(j, step) for row in self._inputs for j in row), default=step)
        if self.resumed and oldest < step - kept:
            raise InputError(
                f"{self.get_name()}: cannot come back at step {step}: it held a value of step {oldest}, and agents "
                f"keep {self._published.capacity} states: lower noise.delay, noise.burst, noise.loss, or run.replicas"
            )

    def begin(self) -> None:
        """See Agent."""
        super().begin()
        self._turns.join(self)

    def _missed_since(self) -> int:
        """See Agent. What is used from one step before the window on: no peer is further behind."""
        first, air = max(0, self._law.step - LOCKSTEP_WINDOW - 1), self._law.air
        return air.oldest_needed(first, self._peers) if air else first

    def health(self) -> Health:
        """See NetworkNode. A stalled agent says what it waits for, and asks for it again from time to time."""
        step, stall = self._law.step, self._stall
        overdue = stall.update(step)
        if step > self._reported or stall.stalled:
            self._report_if_due()  # a channel that follows the graph opens the link that this agent waits for
        values = {"step": str(step), "steps per second": f"{stall.rate:.1f}"}
        if self._synchronizer.finished:
            return Health("has made all steps", values=values)
        if not stall.stalled:
            return Health(f"at step {step}", values=values)
        waiting = self._synchronizer.waiting_for()
        if overdue and step == 0 and self.get_name() in self.duplicate_names():
            self._group.fail(
                self.duplicate_name_error([self.get_name()], stall.stalled)
            )  # the others have started without this one
        elif overdue:
            self.get_logger().warning(f"no step for {stall.stalled:.0f} s at step {step}: waiting for {waiting}")
            self._request_states(self._synchronizer.lacking())
        return Health(f"at step {step}, waiting for {waiting}", waiting=True, values=values | {"waiting for": waiting})

    def hear(self, peer: int, step: int, mode: int, state: bytes, message: bytes) -> str | None:  # noqa: ARG002
        """See Agent."""
        reason = self._synchronizer.offer(peer, step, state)
        if reason == Refusal.CONTRADICTION:
            self._group.record_contradiction(message, self._synchronizer.known(peer, step))
        if not reason and self._synchronizer.ready():
            self._turns.ask(self)
        return reason

    def _limit_steps(self, last: int) -> None:
        """See Agent."""
        self._synchronizer.end_at(last)

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
            self._fail(error)

    def _advance(self) -> None:
        synchronizer, law = self._synchronizer, self._law
        while synchronizer.ready():
            mode, heard = synchronizer.inputs()
            law.advance(mode, heard)
            synchronizer.advance()
            self._publish_state(mode + 1)
            if time.monotonic() >= self._next_progress or synchronizer.finished:
                self._report()
        # It may have used up all published sojourns since its last report, and the switcher waits for the next one.
        if synchronizer.awaits_graph and law.step > self._reported and not self._will_report:
            self._will_report = True
            after(self, max(0.0, self._next_progress - time.monotonic()), self._report_later)

    def _report_later(self) -> None:
        self._will_report = False
        if self._law.step > self._reported:
            self._report()
