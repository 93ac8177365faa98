# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The agents of a process: states pass directly between them, and in batches (messages with many) to the recorder."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from msg_agents.discovery.rtps import PREFIX_SIZE, has_profile_for
from msg_agents.nodes.agent import Agent, Program, StepLaw
from msg_agents.nodes.base import NOT_AN_AGENT, NetworkNode
from msg_agents.nodes.paced_agents import LockstepAgent, RealtimeAgent
from msg_agents.nodes.ros import every
from msg_agents.process_layout import RECORDER
from msg_agents.run.supervisor import SEND_PERIOD
from msg_agents.stepping.synchronizer import TurnQueue
from msg_analysis.messages import topics
from msg_analysis.messages.acceptance import Refusal, fault_of, state_frame, why_refused
from msg_analysis.messages.cdr import CdrError, decode_batch, encode_batch
from msg_analysis.messages.messages import with_state
from msg_analysis.messages.topics import STATE, STATES, Topic, agent_node_name
from msg_analysis.model.agent_law import agent_law
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring

# Bytes after which a batch is sent. Before the agents wait for a recorder that has stopped, the middleware keeps 680
# batches for it by our profiles for one machine, and 5,000 by others: 40 MB in either case. One fits into a datagram.
BATCH_SIZE, SMALL_BATCH_SIZE = 60_000, 2**13
BATCH_TIME = 0.1  # s of wall time after which a batch is sent with the next state, however small it is
LOOK_PERIOD = 0.5  # s between two looks whether the recorder is there
ONLY_TOPICS = "MSG_AGENTS_ONLY_TOPICS"  # variable that turns this off where it is set, for comparison
FEWEST = 16  # agents elsewhere that a process must need to read batches: fewer topics cost little, and ROS shows them
FRESH = 0.02  # s for which what was found out about other processes is not looked up again


class StateBatches:
    """Collects the messages of a kind of states (``topic``: STATES or TRUTHS), and sends them from ``node``."""

    def __init__(self, node: NetworkNode, topic: Topic) -> None:
        self._node = node
        self.publisher: Publisher = node.publisher_of(topic)
        self._messages: list[bytes] = []
        self._size, self._due = 0, 0.0
        self._found = False
        self._most = 0  # readers that it had when the recorder was there
        bounded = has_profile_for(self.publisher.topic_name)
        self._full = BATCH_SIZE if bounded else SMALL_BATCH_SIZE
        every(node, SEND_PERIOD, self.send)

    def add(self, message: bytes) -> None:
        """Send a message, later and with others. Hot path."""
        if not self._messages:
            self._due = time.monotonic() + BATCH_TIME
        self._messages.append(message)
        self._size += len(message)
        if self._size >= self._full or time.monotonic() >= self._due:
            self.send()

    def send(self) -> None:
        """Send what is there now."""
        if self._messages:
            batch = encode_batch(self._node.run, self._messages)
            self._messages.clear()
            self._size = 0
            self._node.publish(self.publisher, batch)

    def recorder_found(self) -> bool:
        """Whether the recorder has been discovered."""
        self._found = self._found or self._node.has_readers(self.publisher, [RECORDER])
        return self._found

    def recorder_there(self) -> bool:
        """Whether the recorder, once found, is still there: its lease for this process has not ended."""
        count = self.publisher.get_subscription_count()
        if count < self._most and not self._node.has_readers(self.publisher, [RECORDER]):
            return False  # when it is back, its name may come later
        self._most = count
        return True


def reads_most(remote: int, others: int) -> bool:
    """Whether a process that needs ``remote`` of ``others`` agents in other processes is to read the batches of all."""
    # It reads at most twice as many states as it needs, in as many messages as there are processes.
    return remote >= FEWEST and 2 * remote > others and ONLY_TOPICS not in os.environ


class BatchLinks:
    """Of one process, on the node ``host``: whose batches it reads, and which processes read those it publishes."""

    # Processes are distinguished by the GUIDs of their endpoints: nodes do not publish which agents they run with.
    def __init__(self, host: NetworkNode, publisher: Publisher, agents: Iterable[int]) -> None:
        self._host = host
        self._publisher = publisher
        self._others = [i for i in range(host.record.experiment.agents) if i not in set(agents)]
        self._names = [STATE.of(agent) for agent in range(host.record.experiment.agents)]
        self._frame = state_frame(host.record, whole=False)
        self._graphs = len(host.record.experiment.graph_list)
        self._listeners: Mapping[int, Sequence[Agent]] = {}  # of this process, by the agent that they hear
        self._subscription: Subscription | None = None
        self.read = False  # whether another process has ever been found to read the batches of this one
        self._reached: frozenset[str] = frozenset()
        self._looked = -FRESH

    def listen(self, listeners: Mapping[int, Sequence[Agent]]) -> bool:
        """Read the states of these agents (indices from 0) in batches, if that pays; otherwise False."""
        if not reads_most(len(listeners), len(self._others)):
            return False
        self._listeners = listeners
        self._subscription = self._host.subscribe(STATES, self._receive)
        return True

    def reached(self) -> frozenset[str]:
        """Names of the agents of other processes whose process reads the batches of this one."""
        now = time.monotonic()
        if len(self._others) >= FEWEST and now >= self._looked + FRESH:
            self._looked = now
            self._reached = self._find_reached()
            self.read = self.read or bool(self._reached)
        return self._reached

    def _find_reached(self) -> frozenset[str]:
        readers = self._host.get_subscriptions_info_by_topic(self._publisher.topic_name)
        processes = {bytes(r.endpoint_gid[:PREFIX_SIZE]) for r in readers if r.node_name != RECORDER}
        if not processes or self._host.missing_readers(self._publisher, []):  # they have not been matched yet
            return frozenset()
        return frozenset(agent_node_name(i) for i in self._others if self._runs_in(i, processes))

    def batches_discovered(self) -> bool:
        """Whether all processes whose batches are to be read, if any, have been discovered."""
        if self._subscription is None:
            return True
        writers = self._host.get_publishers_info_by_topic(self._publisher.topic_name)
        processes = {bytes(w.endpoint_gid[:PREFIX_SIZE]) for w in writers}
        matched = self._subscription.get_publisher_count() >= len(writers)
        return matched and all(self._runs_in(i, processes) for i in self._listeners)

    def _runs_in(self, agent: int, processes: set[bytes]) -> bool:
        """Whether an agent has been discovered, in these processes only: a killed one may still be known."""
        writers = self._host.get_publishers_info_by_topic(self._host.resolve_topic_name(self._names[agent]))
        own = {bytes(w.endpoint_gid[:PREFIX_SIZE]) for w in writers if w.node_name == agent_node_name(agent)}
        return bool(own) and own <= processes

    def _receive(self, data: bytes) -> None:
        try:
            run, sizes, messages = decode_batch(data)
        except CdrError:
            self._host.refuse(Refusal.UNDECODABLE, STATES.name)
            return
        if run != self._host.run:
            self._host.refuse(Refusal.OTHER_RUN, STATES.name)
            return
        start = 0
        for size in sizes.tolist():
            self._take(messages[start : start + size])
            start += size

    def _take(self, message: bytes) -> None:
        """A state. Hot path."""
        found = self._frame.unwrap(message)
        if found is None or not 1 <= found[0] <= len(self._names):
            self._host.refuse(why_refused(message, self._host.record, None, self._frame), STATES.name)
            return
        number, step, mode, state = found
        listeners = self._listeners.get(number - 1)
        if not listeners:  # of this process, or of no interest to it
            return
        fault = fault_of(step, mode, state, self._graphs)
        for listener in listeners:
            if reason := fault or listener.receive(number - 1, step, mode, state, message):
                listener.refuse(reason, self._names[number - 1])


AGENTS: dict[str, type[Agent]] = {"lockstep": LockstepAgent, "realtime": RealtimeAgent}  # by pace
PROGRESS_PERIOD = 0.2  # s of wall time between two Progress messages of an agent, in a small network
MOST_REPORTS = 250.0  # Progress messages a second from a whole network: the switcher reads all of them


class AgentGroup:
    """Agents as nodes of one process: states pass directly between them, and on topics to all other nodes."""

    # Every endpoint is announced to every process. So what agents can share exists once per group, on the node of its
    # first agent: graph, progress, end, resend.
    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        agents: Sequence[int],  # indices from 0, at least one
        readers: Sequence[str],  # other nodes that must read the states before the run starts
        checkpoints: Path | None = None,  # directory of the published states, from which agents resume
        law: Callable[[RunRecord, Wiring, int], StepLaw] = agent_law,  # of an agent (index from 0)
        program: Program | None = None,  # of a user
    ) -> None:
        self.turns = TurnQueue(len(agents), self._defer, self._end_turns)
        self.progress_period = max(PROGRESS_PERIOD, model.agents / MOST_REPORTS)
        listens = model.listens()
        exchanges = listens | listens.T
        self._agents: dict[int, Agent] = {}
        kind = AGENTS[record.experiment.run.pace]
        for i in agents:
            self._agents[i] = kind(
                record=record,
                model=model,
                law=law(record, model, i),
                peers=[int(j) for j in exchanges[i].nonzero()[0]],
                local_agents=agents,
                readers=readers,
                checkpoints=checkpoints,
                group=self,
                program=program,
            )
        self.nodes = list(self._agents.values())  # in the order of ``agents``
        self._host = self.nodes[0]
        self.states = StateBatches(self._host, topics.STATES)  # as other agents receive them
        self.links = BatchLinks(self._host, self.states.publisher, agents)
        listeners: dict[int, list[Agent]] = {}
        for agent in self.nodes:
            agent.connect(self._agents)
            for j in agent.remote:
                listeners.setdefault(j, []).append(agent)
        if not (self._host.reads_batches and self.links.listen(listeners)):
            for agent in self.nodes:
                agent.subscribe_to_remote()
        self._host.create_shared(self.nodes)
        self._progress = self._host.publisher_of(topics.PROGRESS)
        self._awaits_recorder = RECORDER in readers
        exact = record.experiment.truth  # whether the exact states are others
        self.exact_states = StateBatches(self._host, topics.TRUTHS) if exact else None
        self._batches = [each for each in (self.states, self.exact_states) if each]
        self._resend: Publisher | None = None
        self._sending = False  # whether ``_send_states`` will be called
        self.paused = False  # whether the recorder has gone: agents in lockstep wait for it
        if self._awaits_recorder:
            every(self._host, LOOK_PERIOD, self._look_for_recorder)
        self._asked: dict[int, int] = {}  # agents (from 0) that are to be asked for their states from a step on
        if any(agent.resumed for agent in self.nodes):  # which will ask: in time to be discovered with the rest
            self._resend = self._host.publisher_of(topics.RESEND)
        self._host.subscribe(topics.GRAPH, self._receive_graph)
        self._host.subscribe(topics.RESEND, self._receive_resend)
        if record.until:
            self._host.subscribe(topics.STOP, self._receive_stop)
        self._host.finish_at_end(self.nodes)

    def _look_for_recorder(self) -> None:
        """Make no steps while it is gone, which it is when it was stopped for too long; then repeat what it missed."""
        gone = not all(batches.recorder_there() for batches in self._batches)
        if gone == self.paused:
            return
        self.paused = gone
        for agent in () if gone else self.nodes:
            agent.rejoin()

    def _end_turns(self) -> None:
        if self.links.read and not self._sending:  # other processes wait for these states
            self._sending = True
            self._defer(self._send_states)  # after what has come meanwhile, which may let others step

    def _send_states(self) -> None:
        self._sending = False
        self.states.send()

    def _defer(self, callback: Callable[[], None]) -> None:
        self._host.executor.create_task(callback)

    def fail(self, error: Exception) -> None:
        """End the process with the error of an agent."""
        for agent in self.nodes:
            agent.fail(error)

    def record_contradiction(self, message: bytes, state: bytes) -> None:
        """Send the recorder both states of one step that an agent has received: this message, and another ``state``."""
        # One of them is forged, and nobody can know which: with both in the bag, the step counts as missing.
        self.states.add(with_state(message, state))
        self.states.add(message)

    def send_batches(self) -> None:
        """Send to the recorder at once what has been collected for it."""
        for batches in self._batches:
            batches.send()

    def wait_for_recorder(self, deadline: float) -> None:
        """Wait until the recorder has all that was sent to it, or until ``deadline`` [s, monotonic]."""
        for batches in self._batches:
            batches.publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline - time.monotonic())))

    def missing_recorder(self) -> list[str]:
        """The recorder, if it is awaited and has not been discovered."""
        missing = self._awaits_recorder and not all(batches.recorder_found() for batches in self._batches)
        return [RECORDER] if missing else []

    def report(self, agent: int, step: int) -> None:
        """Tell the switcher which step an agent (index from 0) has reached."""
        self._host.publish(self._progress, self._host.progress(topics.PROGRESS, agent + 1, step))

    def request_states(self, agent: int, step: int) -> None:
        """Ask an agent of another process (index from 0) for its states from a step on, once for all that need it."""
        if not self._asked:
            self._defer(self._send_requests)
        self._asked[agent] = min(step, self._asked.get(agent, step))

    def _send_requests(self) -> None:
        asked, self._asked = self._asked, {}
        if self._resend is None:  # rarely needed; latched, so a late discovery only takes its time
            self._resend = self._host.publisher_of(topics.RESEND)
        if reads_most(len(asked), self._host.record.experiment.agents - len(self.nodes)):
            self._host.publish(self._resend, self._host.progress(topics.RESEND, NOT_AN_AGENT, min(asked.values())))
            return
        for agent, step in asked.items():
            self._host.publish(self._resend, self._host.progress(topics.RESEND, agent + 1, step))

    def _receive_resend(self, data: bytes) -> None:
        request = self._host.decode_progress(data, topics.RESEND)
        if request is None:
            return
        for agent in self.nodes:
            if request.agent in (NOT_AN_AGENT, agent.number):
                agent.resend(request.step)

    def _receive_stop(self, data: bytes) -> None:
        stop = self._host.decode_progress(data, topics.STOP)
        if stop is not None:
            for agent in self.nodes:
                agent.end_at(stop.step)

    def _receive_graph(self, data: bytes) -> None:
        self._host.rules.forget(min(agent.values.step for agent in self.nodes))
        graph = self._host.accepted(self._host.rules.graph(data), topics.GRAPH)
        if graph is None:
            return
        # Agents that take over are at different steps: what is new to one may be known to another.
        for reason in {agent.learn(graph) for agent in self.nodes}:
            if reason:
                self._host.refuse(reason, topics.GRAPH.name)
