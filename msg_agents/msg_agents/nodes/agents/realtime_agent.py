"""The agent in real time: it makes a step when its time has come, with the newest that it has heard."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from msg_agents_interfaces.msg import Progress as ProgressMsg

from msg_agents.nodes.agents.agent import NOT_FINITE, Agent
from msg_agents.nodes.diagnostics import Health
from msg_agents.nodes.network_node import EPOCH_TOPIC, NOT_AN_AGENT, OTHER_RUN, state_topic, why_not
from msg_agents.nodes.ros.qos import LATCHED
from msg_agents.nodes.ros.timers import DueTimer
from msg_agents.stepping.newest_values import NOTHING, Newest
from msg_agents.stepping.realtime_schedule import MARGIN, Schedule
from msg_analysis.model.arithmetic.payload import all_finite
from msg_analysis.model.arithmetic.step_clock import SECOND
from msg_analysis.model.step.air import LOST
from msg_analysis.model.step.phases import phases
from msg_analysis.wire.messages import ActiveGraph, stamp_ns

AT_ONCE = 64
"""Late steps that are made before the middleware gets its turn: messages, timers, signals."""

OTHER_EPOCH = "another epoch than the one of this run"
Value = tuple[bytes, int]  # a state, and the simulated time [ns] at which it was made


class RealtimeAgent(Agent):
    """Moves numbers between topics and the law, by a timer on the clock of the node. Parameters: see Agent."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        experiment = self.record.experiment
        self._phase = float(phases(experiment)[self._law.agent])
        self._speed = experiment.run.speed
        self._dt = experiment.step_length
        self._schedule: Schedule | None = None
        self._timer = DueTimer(self, self._advance)
        self._newest: Newest[Value] = Newest(
            agent=self._law.agent,
            steps=experiment.steps,
            inputs=self._inputs,
            peers=self._peers,
            reach=self._reach,
            start=self._law.step,
        )
        self._made = stamp_ns(self._resumed) if self._resumed else 0  # simulated time [ns] of the newest state
        self._margin = round(MARGIN * SECOND * self._speed)  # the same of others may be so much ahead of our clock
        self._late = 0  # most since the last look [ns of simulated time]
        self._looked = 0  # what the clock said when it was last asked why nothing happens
        self._missed = self._missed_before = 0  # steps made later than the next one was due

    def _reach(self) -> int:
        """The newest step that anybody can have reached: before the epoch nobody can say."""
        return self._schedule.reach(self._timer.now()) if self._schedule else self.record.experiment.steps

    def host(self, agents: Sequence[Agent]) -> None:
        """See Agent: the epoch."""

        def receive(data: bytes) -> None:
            progress = self.decode_progress(data, EPOCH_TOPIC)
            if progress is None:
                return
            if progress.agent != NOT_AN_AGENT:
                self.refuse(OTHER_RUN, EPOCH_TOPIC)
                return
            for agent in agents:
                assert isinstance(agent, RealtimeAgent)
                agent.start(progress.stamp)

        self.create_subscription(ProgressMsg, EPOCH_TOPIC, receive, LATCHED, raw=True)

    def start(self, epoch: int) -> None:
        """Simulated time is 0 when the clock says ``epoch`` [ns].

        Parameters
        ----------
        epoch
            time of the clock [ns]
        """
        if self._schedule:
            if self._schedule.epoch != epoch:
                self.refuse(OTHER_EPOCH, EPOCH_TOPIC)
            return
        self._schedule = Schedule(epoch=epoch, speed=self._speed, step_length=self._dt, phase=self._phase)
        self._newest.review()
        # Who takes over is late already: within a period everybody else will have said where he is.
        self._set_timer(self._timer.now())

    def _set_timer(self, now: int) -> None:
        assert self._schedule is not None
        if not self._newest.finished:
            self._timer.set(self._schedule.clock_time(self._schedule.next_step(now, after=self._law.step)))

    def _advance(self) -> None:
        """Make every step that is due: this is the hot path."""
        schedule, newest, law = self._schedule, self._newest, self._law
        assert schedule is not None
        now = self._timer.now()
        simulated = schedule.simulated(now)
        for _ in range(AT_ONCE):
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
        """Make a step; ``now`` is simulated time [ns]."""
        law = self._law
        newest = max((value[1] for _, value in inputs if value), default=0)
        # News from others can outrun the news of the time (``/clock``, or clocks of hosts that disagree). What came out
        # of something is later than it all the same, so that the log can be read in the order of its stamps.
        self._made = max(now, self._made + 1, min(newest, now + self._margin) + 1)
        own = law.state
        law.advance(mode, [value[0] if value else own for _, value in inputs])
        steps = [LOST if step == NOTHING else step for step, _ in inputs]
        message = self._codec.wrap(law.step, mode + 1, law.state, steps, self._made)
        self._published.write(law.step, message)
        self._send(law.step, law.state, message)

    def _send(self, step: int, state: bytes, message: bytes) -> None:
        """See Agent. What is heard is the truth: there is no noise on the air in real time."""
        self.publish(self._states, message)
        for hear in self._listeners:
            hear(self._law.agent, step, (state, stamp_ns(message)))

    def send_again(self, since: int) -> None:  # noqa: ARG002  only the newest value is of use to anybody
        """See Agent."""
        self._repeat(self._law.step)

    def _ask_again(self) -> None:
        """See Agent."""
        for j in self._far:
            self._group.ask_again(j, self._law.step)

    def _receiver(self, peer: int) -> Callable[[bytes], None]:
        """See Agent."""
        unwrap = self._frame.unwrap
        offer = self._newest.offer
        topic, replicas = state_topic(peer), self.record.experiment.run.replicas

        def receive(data: bytes) -> None:
            frame = unwrap(data)
            if frame is None or frame[0] != peer + 1:
                self.refuse(why_not(data, self.record, peer, replicas), topic)
                return
            state = frame[3]
            reason = offer(peer, frame[1], (state, stamp_ns(data))) if all_finite(state) else NOT_FINITE
            if reason:
                self.refuse(reason, topic)

        return receive

    def hear(self, peer: int, step: int, value: Value) -> None:
        """See Agent."""
        self._newest.offer(peer, step, value)

    def learn(self, graph: ActiveGraph) -> str | None:
        """See Agent."""
        if not 1 <= graph.mode <= len(self._inputs):
            return OTHER_RUN
        return self._newest.learn(graph.sequence, graph.mode - 1, graph.first_step, graph.last_step)

    def health(self) -> Health:
        """See NetworkNode. Whoever is late says so; whoever does not get on at all says what he waits for."""
        step, pace = self._law.step, self._pace
        overdue = pace.look(step)
        missed, late = self._missed - self._missed_before, self._late / self._speed / 1e6
        self._missed_before, self._late = self._missed, 0
        values = {
            "step": str(step),
            "steps per second": f"{pace.rate:.1f}",
            "latest step [ms]": f"{late:.3f}",
            "deadlines missed": str(self._missed),
            "oldest value of a neighbour [steps]": str(max(self._newest.behind.values(), default=0)),
        }
        if self._newest.finished:
            return Health("has made all steps", values=values)
        waiting = self._waiting_for()
        if overdue and waiting:
            self.get_logger().warning(f"no step for {pace.stalled:.0f} s at step {step}: waiting for {waiting}")
        if pace.stalled and waiting:
            return Health(
                f"at step {step}, waiting for {waiting}", waiting=True, values=values | {"waiting for": waiting}
            )
        message = f"at step {step}, late by {late:.1f} ms" + (f", {missed} deadlines missed" if missed else "")
        return Health(message, waiting=missed > 0, values=values)

    def _waiting_for(self) -> str | None:
        """What keeps the agent from a step that is due, or its clock from getting there; None if it is only early."""
        now = self._timer.now()
        if not now:
            return "the time on /clock"
        if self._schedule is None:
            return "the epoch, which the switcher publishes when all agents have started"
        if self._schedule.simulated(now) < self._schedule.due(self._law.step):
            stood, self._looked = self._looked == now, now
            return f"its clock, which stands at {now / 1e9:g} s" if stood else None
        return self._newest.waiting_for()
