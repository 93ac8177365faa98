# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The agents of both paces: in lockstep, a step as soon as all its inputs are there; in real time, when it is due."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from msg_agents.nodes.agent import Agent
from msg_agents.nodes.base import CLOCK_BOUND, Health
from msg_agents.nodes.ros import DueTimer, after
from msg_agents.nodes.switcher import EPOCH_DELAY
from msg_agents.stepping.monitoring import STALL_TIME
from msg_agents.stepping.newest_values import CLOCK_MARGIN, NewestReceived, NewestValues, Schedule
from msg_agents.stepping.synchronizer import LOCKSTEP_WINDOW, NOTHING, Synchronizer
from msg_analysis.arithmetic.reproducible import SECOND
from msg_analysis.errors import InputError
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal
from msg_analysis.messages.messages import ActiveGraph, stamp_ns
from msg_analysis.model.reception import LOST, AgentAir
from msg_analysis.model.step_model import phases


class LockstepAgent(Agent):
    """Connects topics, synchronizer and law; options as in Agent."""

    reads_batches = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._turns = self._group.turns
        self._will_report = False  # whether ``_report_later`` will be called
        self._next_request = 0.0  # when to ask for missing states again [s of the monotonic clock]
        reception, options = self._law.air, self._options
        if reception and reception.looks_back:
            self._require_stored_values(reception)
            options |= {"needed": reception.needed, "delay": reception.delay}
        self.values: Synchronizer[bytes] = Synchronizer(**options)

    def _require_stored_values(self, reception: AgentAir) -> None:
        """InputError if the agent comes back, and its peers have no longer a value that it was holding."""
        step, stored = self._law.step, self._published.capacity - 2 * LOCKSTEP_WINDOW  # they may be behind, or ahead
        oldest = min((reception.needed(j, step) for row in self._inputs for j in row), default=step)
        if self.resumed and oldest < step - stored:
            raise InputError(
                f"{self.get_name()}: cannot come back at step {step}: it held a value of step {oldest}, and agents "
                f"keep {self._published.capacity} states: lower noise.delay, noise.burst, noise.loss, or run.replicas"
            )

    def begin(self) -> None:
        """See Agent."""
        super().begin()
        self._turns.join(self)

    def rejoin(self) -> bool:
        """See Agent. It may have been waiting for the recorder."""
        there = super().rejoin()
        self._turns.ask(self)
        return there

    def _first_missed(self) -> int:
        """See Agent. What is used from one step before the window on: no peer is further behind."""
        first, reception = max(0, self._law.step - LOCKSTEP_WINDOW - 1), self._law.air
        return reception.oldest_needed(first, self._peers) if reception else first

    def health(self) -> Health:
        """See NetworkNode. A stalled agent says what it waits for, and asks for it again every few seconds."""
        step, stall = self._law.step, self._stall
        overdue = stall.update(step)
        if step > self._reported or stall.stalled:
            self._report_if_due()  # a channel that follows the graph opens the link that this agent waits for
        values = {"step": str(step), "steps per second": f"{stall.rate:.1f}"}
        if self.values.finished:
            return Health("has made all steps", values=values)
        if not stall.stalled:
            return Health(f"at step {step}", values=values)
        waiting = "the recorder" if self._group.paused else self.values.waiting_for()
        if overdue and step == 0 and self.get_name() in self.duplicate_names():
            self._group.fail(self.duplicate_name_error([self.get_name()], stall.stalled))  # others have started
        elif overdue:
            self.get_logger().warning(f"no step for {stall.stalled:.0f} s at step {step}: waiting for {waiting}")
        if stall.stalled >= STALL_TIME and time.monotonic() >= self._next_request:
            self._next_request = time.monotonic() + STALL_TIME
            self._request_states(self.values.lacking())
        return Health(f"at step {step}, waiting for {waiting}", waiting=True, values=values | {"waiting for": waiting})

    def receive(self, peer: int, step: int, mode: int, state: bytes, message: bytes) -> str | None:  # noqa: ARG002
        """See Agent."""
        reason = self.values.offer(peer, step, state)
        if reason == Refusal.CONTRADICTION:
            self._group.record_contradiction(message, self.values.known(peer, step))
        return self._go_on(reason)

    def learn(self, graph: ActiveGraph) -> str | None:
        """See Agent."""
        return self._go_on(self.values.learn(graph.sequence, graph.mode - 1, graph.first_step, graph.last_step))

    def _go_on(self, reason: str | None) -> str | None:
        if not reason and self.values.ready():
            self._turns.ask(self)
        return reason

    def _make_steps(self) -> None:
        synchronizer, law = self.values, self._law
        while not self._group.paused and synchronizer.ready():
            mode, values = synchronizer.inputs()
            law.advance(mode, values)
            synchronizer.advance()
            self._publish_state(mode + 1)
            if time.monotonic() >= self._next_progress or synchronizer.finished:
                self._report()
        # It may have used all published holding periods since its last report, for whose successor the switcher waits.
        if synchronizer.awaits_graph and law.step > self._reported and not self._will_report:
            self._will_report = True
            after(self, max(0.0, self._next_progress - time.monotonic()), self._report_later)

    def _report_later(self) -> None:
        self._will_report = False
        if self._law.step > self._reported:
            self._report()


MOST_AT_ONCE = 8  # late steps in a row before the executor gets its turn: messages, timers, signals

Value = tuple[bytes, int]  # a state, and the simulated time [ns] at which it was made


class RealtimeAgent(Agent):
    """An agent that steps by a timer on the clock of its node; parameters as in ``Agent``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        experiment = self.record.experiment
        if experiment.run.delivery != "reliable":
            self.state_qos = topics.PASSIVE_NEWEST  # only the newest value is of use
        self._phase = float(phases(experiment)[self._law.agent])
        self._speed = experiment.run.speed
        self._dt = experiment.step_length
        self._schedule: Schedule | None = None
        self._timer = DueTimer(self, self.advance)
        reception, options = self._law.air, self._options | {"reach": self._reach}
        self.values: NewestValues[Value]
        if reception and (reception.loss or reception.delay):
            holds = experiment.noise.holds
            self.values = NewestReceived(delay=reception.delay, lost=reception.lost, holds=holds, **options)
        else:
            self.values = NewestValues(**options)
        self._made = stamp_ns(self._resumed) if self._resumed else 0  # simulated time [ns] of the newest state
        # The stamps of others may be so much ahead of our clock.
        self._margin = round(CLOCK_MARGIN * SECOND * self._speed)
        self._common: Schedule | None = None  # simulated time without a phase
        self._ahead_at_most = math.inf  # ns by which our clock is ahead of the switcher's at most
        self._late = self._graph_late = 0  # largest lateness since the last report [ns of simulated time]
        self._looked = 0  # time of the clock at the last call of ``_waiting_for`` [ns]
        self._missed = self._missed_before = 0  # steps made later than the next one was due

    def _reach(self) -> int:
        """Newest step that any agent can have reached by now; no limit before the epoch is known."""
        return self._schedule.reach(self._timer.now()) if self._schedule else self.record.experiment.steps

    def create_shared(self, agents: Sequence[Agent]) -> None:
        """Subscribe to the epoch, for all agents of the process."""

        def receive(data: bytes) -> None:
            progress = self.decode_progress(data, topics.EPOCH)
            if progress is None:
                return
            for agent in agents:
                assert isinstance(agent, RealtimeAgent)
                agent.start(progress.stamp)

        self.subscribe(topics.EPOCH, receive)

    def start(self, epoch: int) -> None:
        """Set the epoch, the time of the clock [ns] at which simulated time is 0; another one later is refused."""
        if self._schedule:
            if self._schedule.epoch != epoch:
                self.refuse(Refusal.OTHER_EPOCH, topics.EPOCH.name)
            return
        self._schedule = Schedule(epoch=epoch, speed=self._speed, step_length=self._dt, phase=self._phase)
        self._common = Schedule(epoch=epoch, speed=self._speed, step_length=self._dt)
        self._bound_clock(epoch - EPOCH_DELAY)
        self.values.review()
        if self._program:
            self._program.started(self._schedule.clock_time(0))
        # After a takeover steps are overdue; by the time of the next step all others have published their state.
        self._set_timer(self._timer.now())

    def _bound_clock(self, sent: int) -> None:
        """A message has come that the switcher sent at this time of its clock [ns], or later."""
        self._ahead_at_most = min(self._ahead_at_most, self._timer.now() - sent)

    def _set_timer(self, now: int) -> None:
        assert self._schedule is not None
        if not self.values.finished:
            self._timer.set(self._schedule.clock_time(self._schedule.next_step(now, after=self._law.step)))

    def _make_steps(self) -> None:
        """Hot path."""
        schedule, newest, law = self._schedule, self.values, self._law
        assert schedule is not None
        now = self._timer.now()
        simulated = schedule.simulated(now)
        for _ in range(MOST_AT_ONCE):
            due = schedule.due(law.step)
            if due > simulated or not newest.ready():
                self._set_timer(now)
                break
            mode, inputs = newest.inputs()
            self._step(mode, inputs, simulated)
            newest.advance()
            self._late = max(self._late, self._made - due)
            self._missed += schedule.due(law.step) < self._made
        else:
            self._timer.set(now, now)
        if time.monotonic() >= self._next_progress or newest.finished:
            self._report()

    def _step(self, mode: int, inputs: Sequence[tuple[int, Value | None]], now: int) -> None:
        """Make a step at simulated time ``now`` [ns]."""
        law = self._law
        newest = max((value[1] for _, value in inputs if value), default=0)
        # A message can arrive before our clock shows its stamp (``/clock`` is late, or clocks of hosts disagree). The
        # new state is stamped later than its inputs all the same (up to the margin): the log is in causal order.
        self._made = max(now, self._made + 1, min(newest, now + self._margin) + 1)
        law.advance(mode, [value[0] if value else b"" for _, value in inputs], [step for step, _ in inputs])
        steps = [LOST if step == NOTHING else step for step, _ in inputs]
        self._store_and_send(mode + 1, self._codec.wrap(law.step, mode + 1, law.state, steps, self._made))

    def _first_missed(self) -> int:
        """See Agent. Only the newest value is of use."""
        return self._law.step

    def receive(self, peer: int, step: int, mode: int, state: bytes, message: bytes) -> str | None:  # noqa: ARG002
        """See Agent."""
        reason = self.values.offer(peer, step, (state, stamp_ns(message)))
        if reason == Refusal.CONTRADICTION:
            self._group.record_contradiction(message, self.values.known(peer)[0])
        return reason

    def learn(self, graph: ActiveGraph) -> str | None:
        """See Agent."""
        if self._schedule:  # those before the epoch is known are early, or of a run that this agent comes back to
            # After the first step of this agent that should have used it.
            late = self._schedule.simulated(self._timer.now()) - self._schedule.due(graph.first_step)
            self._graph_late = max(self._graph_late, late)
        if self._common and graph.first_step:  # the first one comes before its time
            self._bound_clock(self._common.clock_time(graph.first_step))
        return self.values.learn(graph.mode - 1, graph.first_step)

    def health(self) -> Health:
        """How late the agent is, or what it waits for."""
        step, stall = self._law.step, self._stall
        overdue = stall.update(step)
        if stall.stalled:
            self._report_if_due()
        missed, late = self._missed - self._missed_before, self._late / self._speed / 1e6
        graph_late = self._graph_late / self._speed / 1e6
        self._missed_before, self._late, self._graph_late = self._missed, 0, 0
        values = {
            "step": str(step),
            "steps per second": f"{stall.rate:.1f}",
            "largest lateness [ms]": f"{late:.3f}",
            "largest lateness of a graph [ms]": f"{graph_late:.3f}",
            "deadlines missed": str(self._missed),
            "oldest value of a neighbour [steps]": str(max(self.values.behind.values(), default=0)),
        }
        if math.isfinite(self._ahead_at_most):
            values[CLOCK_BOUND] = f"{self._ahead_at_most / 1e6:.6f}"
        if self.values.finished:
            return Health("has made all steps", values=values)
        waiting = self._waiting_for()
        if self._schedule and self._program and (words := self._program.waiting_for()):
            return Health(words, waiting=True, values=values)
        if overdue and waiting:
            self.get_logger().warning(f"no step for {stall.stalled:.0f} s at step {step}: waiting for {waiting}")
        if stall.stalled and waiting:
            values["waiting for"] = waiting
            return Health(f"at step {step}, waiting for {waiting}", waiting=True, values=values)
        message = f"at step {step}, late by {late:.1f} ms" + (f", {missed} deadlines missed" if missed else "")
        return Health(message, waiting=missed > 0, values=values)

    def _waiting_for(self) -> str | None:
        """What keeps the agent from a due step, or its clock from reaching it; None if the step is not yet due."""
        now = self._timer.now()
        if not now:
            return "the time on /clock"
        if self._schedule is None:
            return "the epoch, which the switcher publishes when all agents have started"
        if self._schedule.simulated(now) < self._schedule.due(self._law.step):
            stopped, self._looked = self._looked == now, now
            return f"its clock, which has stopped at {now / 1e9:g} s" if stopped else None
        return self.values.waiting_for()
