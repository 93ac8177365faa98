"""An agent of a network in lockstep in another middleware: Cyclone DDS and plain Python, without ROS 2.

    python cyclone_agent.py RUN_RECORD AGENT

It does what docs/wire.md asks of an agent of your own; only the arithmetic of the step comes from msg_analysis. The
other nodes are started one by one (docs/wire.md says how), in the same ROS_DOMAIN_ID.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from cyclone_messages import AgentState, Header, Node, Progress, StateBatch, Time, state_topic
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.util import duration

from msg_analysis.arithmetic.reproducible import SECOND, StepClock
from msg_analysis.messages import messages, topics
from msg_analysis.messages.acceptance import genuine, sign
from msg_analysis.messages.messages import StateCodec
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.run_record import RunRecord

WINDOW = 64  # steps that an agent may be ahead of any that it exchanges states with
KEPT = 6000  # steps that are sent again to an agent that was killed and has come back
REPORT_PERIOD = 0.2  # s
PATIENCE = 120.0  # s for the other nodes to come


class CycloneAgent:
    """One agent of a run in lockstep; ``number`` counts from 1."""

    def __init__(self, record: RunRecord, number: int, domain: int) -> None:
        self._record, self._number, self._me = record, number, number - 1
        model = record.model
        self._law = agent_law(record, model, self._me)
        self._steps = record.experiment.steps
        self._clock = StepClock(record.experiment.step_length)
        self._codec = StateCodec(record.run.bytes, number, record.experiment.width, record.experiment.step_length)
        hears, heard_by = model.listens()[self._me], model.listens()[:, self._me]
        self._hearers = {f"agent_{j + 1}" for j in np.flatnonzero(heard_by) if j != self._me}
        self._peers = [int(j) for j in np.flatnonzero(hears | heard_by) if j != self._me]
        self._states: dict[int, dict[int, bytes]] = {j: {} for j in self._peers}  # by agent and step
        self._newest = dict.fromkeys(self._peers, -1)
        self._graphs: deque[tuple[int, int]] = deque()  # mode and last step of the holding periods to come
        self._next_holding = 0
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=KEPT)  # step and mode of what can be asked for again
        self._reported, self._reported_at = -1, float("-inf")
        self._ended = False
        self._node = Node(f"agent_{number}", domain)
        for topic in (state_topic(number), "states", "progress"):
            self._node.write(topic)
        for topic in ("graph", "resend", "end", *(state_topic(j + 1) for j in self._peers)):
            self._node.read(topic)

    def run(self) -> None:
        """Take part in the run, to its end."""
        self._meet()
        self._publish(0)
        self._report()
        wakes = WaitSet(self._node.participant)
        for reader in self._node.readers.values():
            wakes.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))
        while not self._ended:
            wakes.wait(duration(seconds=REPORT_PERIOD))
            self._take_all()
            while self._ready():
                self._step()
            if time.monotonic() >= self._reported_at + REPORT_PERIOD or self._stands_still():
                self._report()

    def _meet(self) -> None:
        """Announce the name as soon as all that it reads is there, and wait until all that read it are."""
        deadline = time.monotonic() + PATIENCE
        node = self._node
        while lacking := set(node.without_writer()) - {"resend"}:  # agents write that when they have something to ask
            _pause(deadline, "the writers of " + ", ".join(sorted(lacking)))
        node.announce()
        own = state_topic(self._number)
        while not (
            node.readers_of(own) >= self._hearers
            and "recorder" in node.readers_of("states")
            and "switcher" in node.readers_of("progress")
        ):
            _pause(deadline, ", ".join(sorted(self._hearers)) + ", recorder, switcher")

    def _take_all(self) -> None:
        readers = self._node.readers
        for graph in self._valid(readers["graph"]):
            if graph.sequence == self._next_holding:
                self._next_holding += 1
                self._graphs.append((graph.mode - 1, graph.last_step))
        for j in self._peers:
            for state in self._valid(readers[state_topic(j + 1)]):
                self._newest[j] = max(self._newest[j], state.step)
                if state.step >= self._needed(j):
                    self._states[j][state.step] = np.array(state.state).tobytes()
        for request in self._valid(readers["resend"]):
            if request.agent in (0, self._number) and self._is_genuine(request, topics.RESEND):
                for step, message in list(self._sent):
                    if step >= request.step:
                        self._send(message)
        for end in self._valid(readers["end"]):
            self._ended |= self._is_genuine(end, topics.END)

    def _valid(self, reader: Any) -> Iterable[Any]:
        """The messages of this run, not the news that a writer has left."""
        run = list(self._record.run.bytes)
        return (m for m in reader.take(N=1000) if hasattr(m, "run") and list(m.run) == run)

    def _ready(self) -> bool:
        """Whether the next step can be made: its graph and its inputs are known, and no peer is too far behind."""
        step = self._law.step
        if step == self._steps or not self._graphs or any(newest + WINDOW < step for newest in self._newest.values()):
            return False
        return all(self._needed(j) in self._states[j] for j in self._law.neighbours(self._graphs[0][0]))

    def _needed(self, j: int) -> int:
        """Step of the value of agent j that the next step uses: an older one with a delay, or if one was lost."""
        law = self._law
        return law.air.needed(j, law.step) if law.air else law.step

    def _step(self) -> None:
        step, (mode, last) = self._law.step, self._graphs[0]
        self._law.advance(mode, [self._states[j][self._needed(j)] for j in self._law.neighbours(mode)])
        for j, states in self._states.items():
            for old in [k for k in states if k < self._needed(j)]:
                del states[old]
        if last == step:
            self._graphs.popleft()
        self._publish(mode + 1)

    def _publish(self, mode: int) -> None:
        law = self._law
        message = self._codec.wrap(law.step, mode, law.state, law.heard)
        self._sent.append((law.step, message))
        self._send(message)

    def _send(self, message: bytes) -> None:
        """Send a state to the agents, and, in a batch, to the recorder."""
        state = messages.AgentState.decode(message)
        header = _header(state.stamp, "")
        run, heard, values = list(state.run), list(state.heard), state.state.tolist()
        self._node.writers[state_topic(self._number)].write(
            AgentState(header, run, state.agent, state.step, state.mode, heard, values)
        )
        self._node.writers["states"].write(StateBatch(run, [len(message)], list(message)))

    def _stands_still(self) -> bool:
        """Whether it is at the end, or has used up the known graphs: the switcher waits for its report."""
        return self._reported < self._law.step and (self._law.step == self._steps or not self._graphs)

    def _report(self) -> None:
        step = self._reported = self._law.step
        self._reported_at = time.monotonic()
        message = messages.Progress(self._clock.nanoseconds(step), self._record.run.bytes, self._number, step)
        signed = sign(message, topics.PROGRESS, self._record.key)
        header = _header(signed.stamp, signed.frame_id)
        self._node.writers["progress"].write(Progress(header, list(signed.run), signed.agent, signed.step))

    def _is_genuine(self, message: Progress, topic: topics.Topic) -> bool:
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        run, frame_id = bytes(message.run), message.header.frame_id
        return genuine(messages.Progress(stamp, run, message.agent, message.step, frame_id), topic, self._record.key)


def _header(stamp: int, frame_id: str) -> Header:
    return Header(Time(stamp // SECOND, stamp % SECOND), frame_id)


def _pause(deadline: float, awaited: str) -> None:
    if time.monotonic() > deadline:
        sys.exit(f"error: after {PATIENCE:g} s not all are there: {awaited}")
    time.sleep(0.02)


def main() -> None:
    """Run one agent."""
    try:
        file, number = Path(sys.argv[1]), int(sys.argv[2])
    except (IndexError, ValueError):
        sys.exit("usage: cyclone_agent.py RUN_RECORD AGENT")
    record = RunRecord.from_json(file.read_text(encoding="utf-8"), str(file))
    if record.experiment.run.pace != "lockstep" or record.experiment.truth:
        sys.exit(f"error: {file}: expected a run in lockstep whose agents publish their true states")
    CycloneAgent(record, number, int(os.environ.get("ROS_DOMAIN_ID", "0"))).run()


if __name__ == "__main__":
    main()
